#include "convex.hpp"

namespace armctl {

namespace {

// Larger hulls are searched by hill climbing.
constexpr size_t LARGE_HULL_VERTICES = 24;
// Shorter vectors have no direction.
constexpr double MIN_LENGTH_M = 1e-12;

}  // namespace

size_t Vertices::farthest(const Geom& hull, Vec3 direction, size_t start) const {
    if (hull.last_vertex - hull.first_vertex <= LARGE_HULL_VERTICES) {
        size_t best = hull.first_vertex;
        double farthest = dot(positions[best], direction);
        for (size_t i = hull.first_vertex + 1; i < hull.last_vertex; ++i) {
            const double value = dot(positions[i], direction);
            if (value > farthest) {
                farthest = value;
                best = i;
            }
        }
        return best;
    }
    size_t best = hull.first_vertex <= start && start < hull.last_vertex ? start : hull.first_vertex;
    double farthest = dot(positions[best], direction);
    while (true) {
        const size_t current = best;
        for (size_t edge = first_neighbors[current]; edge < first_neighbors[current + 1]; ++edge) {
            const double value = dot(positions[neighbors[edge]], direction);
            if (value > farthest) {
                farthest = value;
                best = neighbors[edge];
            }
        }
        if (best == current) { return best; }
    }
}

Vec3 round_support_point(const Geom& geom, Vec3 direction) {
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
