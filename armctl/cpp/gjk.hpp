// The part of the GJK algorithm that does not depend on the shapes: the point of a simplex that is closest to the origin.
//
// Source: E. G. Gilbert, D. W. Johnson, S. S. Keerthi, "A fast procedure for computing the distance between complex objects in
// three-dimensional space", IEEE J. Robotics and Automation 4 (1988).
#pragma once
#include <algorithm>
#include <limits>
#include <optional>

#include "vectors.hpp"

namespace armctl {

constexpr int MAX_GJK_STEPS = 60;
constexpr double OVERLAP_M2 = 1e-18;  // the square of a distance between hulls that overlap, m^2

// A support point of the difference of two shapes.
struct SupportPoint {
    Vec3 difference;
    Vec3 on_first;  // the point of the first shape that belongs to it
};

class Simplex {
public:
    size_t size() const { return size_; }

    // At most four vertices.
    void add(const SupportPoint& vertex) { vertices_[size_++] = vertex; }

    // The point closest to the origin; the simplex is reduced to the vertices of the face that contains it. Nothing if the
    // origin is inside.
    //
    // The closest point of all points a_1 w_1 + a_2 w_2 + ... with a sum of weights of 1 belongs to the simplex if no weight is
    // negative. Otherwise it is on a face without a vertex of negative weight.
    std::optional<Vec3> reduce_to_closest_point() {
        const std::array<double, 4> shares = signed_shares();
        double total = 0.0;
        bool is_inside = true;
        for (size_t k = 0; k < size_; ++k) {
            total += shares[k];
            is_inside = is_inside && shares[k] > 0.0;
        }
        if (is_inside && size_ == 4) { return std::nullopt; }
        if (is_inside) {
            Vec3 point;
            for (size_t k = 0; k < size_; ++k) {
                weights_[k] = shares[k] / total;
                point += weights_[k] * vertices_[k].difference;
            }
            return point;
        }
        Simplex nearest;
        Vec3 closest;
        double least = std::numeric_limits<double>::max();
        for (size_t opposite = 0; opposite < size_; ++opposite) {
            if (shares[opposite] > 0.0) { continue; }
            Simplex face = *this;
            face.vertices_[opposite] = vertices_[--face.size_];
            const Vec3 point = *face.reduce_to_closest_point();  // a face has at most three vertices
            if (dot(point, point) < least) {
                least = dot(point, point);
                closest = point;
                nearest = face;
            }
        }
        *this = nearest;
        return closest;
    }

    // The point of the first shape that belongs to the point closest to the origin, after the simplex has been reduced.
    Vec3 witness_on_first() const {
        Vec3 point;
        for (size_t k = 0; k < size_; ++k) { point += weights_[k] * vertices_[k].on_first; }
        return point;
    }

private:
    // Numbers in the ratio of the weights: lengths, areas or volumes of the parts into which the closest point divides the simplex,
    // negative or zero where it is beyond the face opposite to a vertex.
    std::array<double, 4> signed_shares() const {
        if (size_ == 1) { return {1.0}; }
        const Vec3 a = vertices_[0].difference;
        const Vec3 b = vertices_[1].difference;
        if (size_ == 2) { return {dot(b, b - a), -dot(a, b - a)}; }
        const Vec3 c = vertices_[2].difference;
        const Vec3 normal = cross(b - a, c - a);
        if (size_ == 3) { return {dot(b, cross(c - b, normal)), dot(c, cross(a - c, normal)), dot(a, cross(b - a, normal))}; }
        const Vec3 d = vertices_[3].difference;
        const double volume = dot(normal, d - a);
        return {volume * dot(b, cross(c - b, d - b)), -volume * dot(a, cross(c - a, d - a)), volume * dot(a, cross(b - a, d - a)),
                -volume * dot(a, normal)};
    }

    std::array<SupportPoint, 4> vertices_;
    std::array<double, 3> weights_{};  // of the vertices in the closest point
    size_t size_ = 0;
};

}  // namespace armctl
