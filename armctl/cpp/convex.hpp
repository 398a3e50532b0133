// Convex shapes and their support points: the point of a shape that is farthest in a direction.
#pragma once
#include <cstdint>
#include <vector>

#include "vectors.hpp"

namespace armctl {

enum class ShapeKind : std::int64_t { hull, box, cylinder, ellipsoid, plane };

// A shape in its frame. Spheres, capsules and meshes are hulls of their vertices, inflated by a radius.
struct Geom {
    ShapeKind kind = ShapeKind::hull;
    size_t frame = 0;
    double inflation = 0.0;  // m
    Vec3 position;
    Rotation axes;
    Vec3 size;  // half sizes of a box or an ellipsoid; radius and half length of a cylinder
    // Of a hull and a box.
    size_t first_vertex = 0;
    size_t last_vertex = 0;
    // Of an ellipsoid: its axes times its half sizes.
    Rotation semi_axes;
    // Of a plane, which is where dot(normal, x) = offset. Planes stand still.
    double offset = 0.0;

    bool has_vertices() const { return kind == ShapeKind::hull || kind == ShapeKind::box; }
    Vec3 normal() const { return axes.z; }
};

// The vertices of all hulls, and for large hulls the edges between them.
struct Vertices {
    static constexpr size_t NONE = static_cast<size_t>(-1);

    std::vector<Vec3> positions;
    std::vector<size_t> first_neighbors;  // one more than vertices
    std::vector<size_t> neighbors;

    // The vertex of a hull that is farthest in a direction; the search of a large hull climbs over its edges from a start.
    size_t farthest(const Geom& hull, Vec3 direction, size_t start) const;
};

// The point of a cylinder or an ellipsoid that is farthest in a direction.
Vec3 round_support_point(const Geom& geom, Vec3 direction);

struct BoundingSphere {
    Vec3 center;
    double radius = 0.0;
};

}  // namespace armctl
