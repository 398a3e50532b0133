// Points that stand, each with a radius around it: a cloud, as a depth camera gives it.
#pragma once
#include <limits>

#include "box_tree.hpp"
#include "errors.hpp"

namespace armctl {

// Immutable: models share it.
class PointCloud {
public:
    // From points (N, 3) m in the frame of the cloud, at least one.
    PointCloud(Matrix points, double radius) : radius_(radius) {
        if (points.rows == 0) { throw InputError("points: the cloud is empty"); }
        const auto point = [&](size_t i) { return vec3(points.row(i)); };
        tree_ = BoxTree(points.rows, point, [&](size_t i) { return AlignedBox{point(i), point(i)}; });
        points_.reserve(points.rows);
        for (const std::uint32_t item : tree_.order()) { points_.push_back(point(item)); }
    }

    double radius() const { return radius_; }
    const BoxTree& tree() const { return tree_; }
    // In the order of the tree.
    const std::vector<Vec3>& points() const { return points_; }

    // The distance of a place from the nearest point, m.
    double distance(Vec3 place) const {
        double least = std::numeric_limits<double>::infinity();
        tree_.search(
            place, [&](const AlignedBox& bounds) { return bounds.squared_distance(place) >= least; },
            [&](size_t i) {
                const Vec3 between = points_[i] - place;
                least = std::min(least, dot(between, between));
                return false;
            });
        return std::sqrt(least);
    }

private:
    double radius_;
    BoxTree tree_;
    std::vector<Vec3> points_;
};

}  // namespace armctl
