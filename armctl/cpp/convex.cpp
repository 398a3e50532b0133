#include "convex.hpp"

#include <algorithm>

namespace armctl {

namespace {

// Larger hulls are searched by hill climbing.
constexpr size_t LARGE_HULL_VERTICES = 24;
// Shorter vectors have no direction.
constexpr double MIN_LENGTH_M = 1e-12;
// The sphere is then within 2 % of the smallest one.
constexpr int BOUNDING_SPHERE_STEPS = 60;

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

BoundingSphere bounding_sphere(std::span<const BoundingSphere> spheres) {
    Vec3 low = spheres[0].center;
    Vec3 high = low;
    for (const BoundingSphere& sphere : spheres) {
        low = {std::min(low.x, sphere.center.x), std::min(low.y, sphere.center.y), std::min(low.z, sphere.center.z)};
        high = {std::max(high.x, sphere.center.x), std::max(high.y, sphere.center.y), std::max(high.z, sphere.center.z)};
    }
    Vec3 center = 0.5 * (low + high);
    const auto reach = [&center](const BoundingSphere& sphere) { return norm(sphere.center - center) + sphere.radius; };
    const auto reaches_less = [&reach](const BoundingSphere& a, const BoundingSphere& b) { return reach(a) < reach(b); };
    for (int step = 0; step < BOUNDING_SPHERE_STEPS; ++step) {
        const Vec3 way = std::max_element(spheres.begin(), spheres.end(), reaches_less)->center - center;
        const double steps = step + 2;
        center += {way.x / steps, way.y / steps, way.z / steps};
    }
    return {center, reach(*std::max_element(spheres.begin(), spheres.end(), reaches_less))};
}

}  // namespace armctl
