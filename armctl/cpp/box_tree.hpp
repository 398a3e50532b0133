// A tree of axis-aligned boxes around many items that stand still: what is far from a place is skipped as a whole.
//
// Items are sorted along a space-filling curve, and each node has those in a half of the cell of the node above it. Source: T. Karras,
// "Maximizing parallelism in the construction of BVHs, octrees, and k-d trees", High-Performance Graphics 2012.
#pragma once
#include <algorithm>
#include <array>
#include <bit>
#include <vector>

#include "vectors.hpp"

namespace armctl {

constexpr size_t LEAF_ITEMS = 8;
constexpr int CURVE_BITS = 10;  // of the cell of an item on the curve, for each axis
constexpr int ITEM_BITS = 32;
constexpr size_t MAX_DEPTH = 64;       // of a tree that divides its items in halves, and more
constexpr double MIN_EXTENT_M = 1e-9;  // of the items: all of them are in one cell if they are closer together

// An axis-aligned box.
struct AlignedBox {
    Vec3 low;
    Vec3 high;

    static AlignedBox around(Vec3 center, double radius) {
        return {center - Vec3{radius, radius, radius}, center + Vec3{radius, radius, radius}};
    }

    void include(const AlignedBox& other) {
        low = {std::min(low.x, other.low.x), std::min(low.y, other.low.y), std::min(low.z, other.low.z)};
        high = {std::max(high.x, other.high.x), std::max(high.y, other.high.y), std::max(high.z, other.high.z)};
    }

    Vec3 center() const { return 0.5 * (low + high); }
    // Half of its diagonal, m.
    double radius() const { return 0.5 * norm(high - low); }

    // The square of the distance of a point from it, m^2.
    double squared_distance(Vec3 point) const {
        const Vec3 outside = {beyond(point.x, low.x, high.x), beyond(point.y, low.y, high.y), beyond(point.z, low.z, high.z)};
        return dot(outside, outside);
    }

    // Its corner that is farthest in a direction.
    Vec3 farthest(Vec3 direction) const {
        return {direction.x > 0.0 ? high.x : low.x, direction.y > 0.0 ? high.y : low.y, direction.z > 0.0 ? high.z : low.z};
    }

private:
    // How far a number is outside an interval.
    static double beyond(double number, double low, double high) { return std::max(std::max(low - number, number - high), 0.0); }
};

class BoxTree {
public:
    BoxTree() = default;

    // Of some number of items: `center_of(i)` and `bounds_of(i)` of each.
    template <class CenterOf, class BoundsOf>
    BoxTree(size_t items, CenterOf center_of, BoundsOf bounds_of) {
        if (items == 0) { return; }
        const std::vector<std::uint64_t> keys = sorted_keys(items, center_of);
        order_.reserve(items);
        for (const std::uint64_t key : keys) { order_.push_back(static_cast<std::uint32_t>(key)); }
        nodes_.reserve(4 * (items / LEAF_ITEMS + 1));
        build(keys, bounds_of, 0, items);
    }

    // The items in the order in which leaves have them.
    const std::vector<std::uint32_t>& order() const { return order_; }
    const AlignedBox& bounds() const { return nodes_.front().bounds; }

    // Visits the items near a place first, by their position in the order. `is_far(bounds)` says that the items in there do not matter;
    // `visit(position)` whether to stop.
    template <class IsFar, class Visit>
    void search(Vec3 from, IsFar is_far, Visit visit) const {
        std::array<std::uint32_t, MAX_DEPTH> waiting;
        size_t count = 0;
        if (!nodes_.empty()) { waiting[count++] = 0; }
        while (count > 0) {
            const std::uint32_t index = waiting[--count];
            const Node& node = nodes_[index];
            if (is_far(node.bounds)) { continue; }
            if (node.second == 0) {
                for (std::uint32_t i = node.begin; i < node.end; ++i) {
                    if (visit(i)) { return; }
                }
                continue;
            }
            std::uint32_t near = index + 1;
            std::uint32_t far = node.second;
            if (nodes_[far].bounds.squared_distance(from) < nodes_[near].bounds.squared_distance(from)) { std::swap(near, far); }
            waiting[count++] = far;
            waiting[count++] = near;
        }
    }

private:
    struct Node {
        AlignedBox bounds;
        std::uint32_t begin;
        std::uint32_t end;
        std::uint32_t second;  // its second child; the first one follows it. 0 for a leaf
    };

    // The cells of the items on the curve in the upper half of the numbers, and the items in the lower half, sorted.
    template <class CenterOf>
    static std::vector<std::uint64_t> sorted_keys(size_t items, CenterOf center_of) {
        AlignedBox all = {center_of(0), center_of(0)};
        for (size_t i = 1; i < items; ++i) { all.include({center_of(i), center_of(i)}); }
        const Vec3 extent = all.high - all.low;
        const double largest = std::max({extent.x, extent.y, extent.z, MIN_EXTENT_M});
        const double scale = static_cast<double>((1 << CURVE_BITS) - 1) / largest;
        std::vector<std::uint64_t> keys(items);
        for (size_t i = 0; i < items; ++i) {
            const Vec3 place = scale * (center_of(i) - all.low);
            keys[i] = (spread(place.x) | spread(place.y) << 1 | spread(place.z) << 2) << ITEM_BITS | i;
        }
        // By radix, a digit of the cells after another.
        constexpr size_t DIGITS = size_t{1} << CURVE_BITS;
        std::vector<std::uint64_t> sorted(items);
        std::vector<size_t> starts(DIGITS);
        for (int shift = ITEM_BITS; shift < ITEM_BITS + 3 * CURVE_BITS; shift += CURVE_BITS) {
            const auto digit = [&](std::uint64_t key) { return key >> shift & (DIGITS - 1); };
            std::ranges::fill(starts, 0);
            for (const std::uint64_t key : keys) { ++starts[digit(key)]; }
            size_t start = 0;
            for (size_t& each : starts) {
                const size_t items_with_digit = each;
                each = start;
                start += items_with_digit;
            }
            for (const std::uint64_t key : keys) { sorted[starts[digit(key)]++] = key; }
            keys.swap(sorted);
        }
        return keys;
    }

    // The bits of a number below 2^10, each third place apart.
    static std::uint64_t spread(double number) {
        std::uint64_t bits = static_cast<std::uint64_t>(std::max(number, 0.0)) & 0x3ff;
        bits = (bits | bits << 16) & 0x030000ff;
        bits = (bits | bits << 8) & 0x0300f00f;
        bits = (bits | bits << 4) & 0x030c30c3;
        return (bits | bits << 2) & 0x09249249;
    }

    // Where items are divided: where the highest bit changes in which their cells differ, or in the middle.
    static size_t division(const std::vector<std::uint64_t>& keys, size_t begin, size_t end) {
        const std::uint64_t different = (keys[begin] ^ keys[end - 1]) >> ITEM_BITS;
        if (different == 0) { return begin + (end - begin) / 2; }
        const std::uint64_t bit = std::bit_floor(different) << ITEM_BITS;
        const auto has_bit = [&](std::uint64_t key) { return (key & bit) == 0; };
        const auto first = keys.begin() + static_cast<std::ptrdiff_t>(begin);
        const auto last = keys.begin() + static_cast<std::ptrdiff_t>(end);
        return static_cast<size_t>(std::partition_point(first, last, has_bit) - keys.begin());
    }

    template <class BoundsOf>
    std::uint32_t build(const std::vector<std::uint64_t>& keys, const BoundsOf& bounds_of, size_t begin, size_t end) {
        const auto index = static_cast<std::uint32_t>(nodes_.size());
        nodes_.push_back({bounds_of(order_[begin]), static_cast<std::uint32_t>(begin), static_cast<std::uint32_t>(end), 0});
        if (end - begin <= LEAF_ITEMS) {
            for (size_t i = begin + 1; i < end; ++i) { nodes_[index].bounds.include(bounds_of(order_[i])); }
            return index;
        }
        const size_t middle = division(keys, begin, end);
        const std::uint32_t first = build(keys, bounds_of, begin, middle);
        const std::uint32_t second = build(keys, bounds_of, middle, end);
        nodes_[index].second = second;
        nodes_[index].bounds = nodes_[first].bounds;
        nodes_[index].bounds.include(nodes_[second].bounds);
        return index;
    }

    std::vector<std::uint32_t> order_;
    std::vector<Node> nodes_;
};

}  // namespace armctl
