// Convex shapes and their support points: the point of a shape that is farthest in a direction.
#pragma once
#include <memory>

#include "point_cloud.hpp"

namespace armctl {

constexpr size_t LARGE_HULL_VERTICES = 24;  // larger hulls are searched by hill climbing
constexpr double MIN_LENGTH_M = 1e-12;      // shorter vectors have no direction

// Points are not convex: their distance is that of the nearest one.
enum class ShapeKind : std::int64_t { hull, box, cylinder, ellipsoid, plane, points };

// A shape in its frame. Spheres, capsules and meshes are hulls of their vertices, inflated by a radius.
struct Geom {
    ShapeKind kind = ShapeKind::hull;
    size_t frame = 0;
    double inflation = 0.0;  // m, the radius of a sphere or a capsule
    Vec3 position{};
    Rotation axes{};
    Vec3 size{};    // half sizes of a box or an ellipsoid; radius and half length of a cylinder
    Vec3 center{};  // of a sphere around it
    double radius = 0.0;
    // Of a hull and a box.
    size_t first_vertex = 0;
    size_t last_vertex = 0;
    // Of an ellipsoid: its axes times its half sizes.
    Rotation semi_axes{};
    // Of a plane, which is where dot(normal, x) = offset. Planes stand still.
    double offset = 0.0;
    // Of points, which stand still in the frame of `position` and `axes`.
    std::shared_ptr<const PointCloud> cloud{};

    Pose pose() const { return {axes, position}; }
    bool has_vertices() const { return kind == ShapeKind::hull || kind == ShapeKind::box; }
    Vec3 normal() const { return axes.z; }
};

// The vertices of all hulls, and for large hulls the edges between them.
struct Vertices {
    static constexpr size_t NONE = static_cast<size_t>(-1);

    std::vector<Vec3> positions;
    std::vector<size_t> first_neighbors;  // one more than vertices
    std::vector<size_t> neighbors;

    // Adds vertices behind these.
    void append(const Vertices& more) {
        const size_t vertex = positions.size();
        const size_t edge = neighbors.size();
        positions.insert(positions.end(), more.positions.begin(), more.positions.end());
        for (size_t i = 1; i < more.first_neighbors.size(); ++i) { first_neighbors.push_back(edge + more.first_neighbors[i]); }
        for (const size_t neighbor : more.neighbors) { neighbors.push_back(vertex + neighbor); }
    }

    // The vertex of a hull that is farthest in a direction; the search of a large hull climbs over its edges from a start.
    size_t farthest(const Geom& hull, Vec3 direction, size_t start) const {
        const bool is_large = hull.last_vertex - hull.first_vertex > LARGE_HULL_VERTICES;
        size_t best = is_large && hull.first_vertex <= start && start < hull.last_vertex ? start : hull.first_vertex;
        double farthest = dot(positions[best], direction);
        const auto compare = [&](size_t vertex) {
            const double value = dot(positions[vertex], direction);
            if (value > farthest) {
                farthest = value;
                best = vertex;
            }
        };
        if (!is_large) {
            for (size_t i = hull.first_vertex + 1; i < hull.last_vertex; ++i) { compare(i); }
            return best;
        }
        while (true) {
            const size_t current = best;
            for (size_t edge = first_neighbors[current]; edge < first_neighbors[current + 1]; ++edge) { compare(neighbors[edge]); }
            if (best == current) { return best; }
        }
    }
};

// A place in the world as a geom, inflated by a radius.
inline Geom ball_at(Vec3 place, double radius) {
    return {.kind = ShapeKind::ellipsoid,
            .inflation = radius,
            .position = place,
            .center = place,
            .radius = radius,
            .semi_axes = {Vec3{}, Vec3{}, Vec3{}}};
}

// The point of a cylinder or an ellipsoid that is farthest in a direction.
inline Vec3 round_support_point(const Geom& geom, Vec3 direction) {
    if (geom.kind == ShapeKind::cylinder) {
        const Vec3 axis = geom.axes.z;
        const double along = dot(direction, axis);
        const double half_length = along > 0.0 ? geom.size.y : -geom.size.y;
        const Vec3 radial = direction - along * axis;
        const double length = norm(radial);
        const double scale = length > MIN_LENGTH_M ? geom.size.x / length : 0.0;
        return geom.position + half_length * axis + scale * radial;
    }
    const Vec3 on_unit_sphere = geom.semi_axes.inverse_times(direction);
    const double length = norm(on_unit_sphere);
    const double scale = length > MIN_LENGTH_M ? 1.0 / length : 0.0;
    return geom.position + scale * (geom.semi_axes * on_unit_sphere);
}

}  // namespace armctl
