// The part of the GJK algorithm that does not depend on the shapes: the point of a simplex that is closest to the origin.
//
// Source: E. G. Gilbert, D. W. Johnson, S. S. Keerthi, "A fast procedure for computing the distance between complex objects in
// three-dimensional space", IEEE J. Robotics and Automation 4 (1988).
#pragma once
#include <array>
#include <optional>

#include "vectors.hpp"

namespace armctl {

constexpr int MAX_GJK_STEPS = 60;
// The square of a distance between hulls that overlap, m^2.
constexpr double OVERLAP_M2 = 1e-18;

// A support point of the difference of two shapes.
struct SupportPoint {
    Vec3 difference;
    Vec3 on_first;  // the point of the first shape that belongs to it
};

class Simplex {
public:
    size_t size() const { return size_; }

    // Whether a point is one of the vertices.
    bool contains(Vec3 point) const;

    // At most four vertices.
    void add(const SupportPoint& vertex) { vertices_[size_++] = vertex; }

    // The point closest to the origin; the simplex is reduced to the vertices of the face that contains it. Nothing if the
    // origin is inside.
    std::optional<Vec3> reduce_to_closest_point();

    // The point of the first shape that belongs to the point closest to the origin.
    Vec3 witness_on_first() const;

private:
    Vec3 closest_on_segment();
    Vec3 closest_on_triangle();
    std::optional<Vec3> closest_on_tetrahedron();
    Vec3 keep_vertex(size_t i);
    Vec3 keep_edge(size_t i, size_t j, double share);

    std::array<SupportPoint, 4> vertices_;
    size_t size_ = 0;
};

}  // namespace armctl
