#include "collision_scene.hpp"

#include <algorithm>
#include <cmath>

namespace armctl {

namespace {

// GJK stops where its bounds are so near to each other, relatively or in m.
constexpr double GJK_RELATIVE_GAP = 1e-9;
constexpr double GJK_GAP_M = 1e-7;
// The square of the length of a vector without a direction, m^2.
constexpr double NO_DIRECTION_M2 = 1e-20;
// An upper bound for points and hulls without a radius that overlap, m.
constexpr double OVERLAP_M = -1e-12;

// R = rotation by an angle about a unit axis, by Rodrigues' formula.
Rotation rotation_about(Vec3 axis, double angle) {
    const double sine = std::sin(angle);
    const double cosine = std::cos(angle);
    const double u = 1.0 - cosine;
    const auto [x, y, z] = axis;
    return {{cosine + x * x * u, y * x * u + z * sine, z * x * u - y * sine},
            {x * y * u - z * sine, cosine + y * y * u, z * y * u + x * sine},
            {x * z * u + y * sine, y * z * u - x * sine, cosine + z * z * u}};
}

}  // namespace

CollisionScene::CollisionScene(std::shared_ptr<const CollisionModel> model)
    : model_(std::move(model)), memory_(model_->pairs.size()), last_hit_(model_->pairs.size()), frames_(model_->frames.size()),
      spheres_(model_->spheres.size()), motions_(model_->spheres.size() * model_->depth),
      near_gradients_(model_->pairs.size() * model_->joints()) {}

void CollisionScene::forget() {
    std::fill(memory_.begin(), memory_.end(), PairMemory{});
    last_hit_ = no_pair();
}

void CollisionScene::place_frames(Vector positions) {
    for (size_t i = 1; i < frames_.size(); ++i) {
        const MovingFrame& moving = model_->frames[i];
        const Pose& parent = frames_[moving.parent].pose;
        PlacedFrame& placed = frames_[i];
        placed.anchor = parent * moving.anchor;
        placed.axis = parent.rotation * moving.axis;
        const double displacement = positions[moving.joint] - moving.reference;
        if (moving.slides) {
            placed.pose.rotation = parent.rotation;
            placed.pose.translation = parent.translation + displacement * placed.axis;
        } else {
            const Rotation turn = rotation_about(moving.axis, displacement);
            placed.pose = parent * Pose{turn, moving.anchor - turn * moving.anchor};
        }
    }
}

void CollisionScene::place(Vector positions) {
    place_frames(positions);
    for (size_t i = 0; i < spheres_.size(); ++i) {
        spheres_[i].center = frames_[model_->sphere_frames[i]].pose * model_->spheres[i].center;
        spheres_[i].has_motion = false;
    }
}

// Change the joints from the base outward: joint j then turns the geom about its axis at the center of the interval, and a
// point at the distance r from the axis moves by at most delta[j] r.
void CollisionScene::bound_motions(size_t sphere, Vector delta) {
    PlacedSphere& placed = spheres_[sphere];
    placed.has_motion = true;
    const double radius = model_->spheres[sphere].radius;
    double total = 0.0;
    size_t walk = model_->sphere_frames[sphere];
    while (walk > 0) {
        const MovingFrame& moving = model_->frames[walk];
        motion(sphere, moving.depth) = total;
        const double step = delta[moving.joint];
        if (moving.slides) {
            total += step;
        } else if (step > 0.0) {
            const Vec3 lever = cross(placed.center - frames_[walk].anchor, frames_[walk].axis);
            total += step * (norm(lever) + radius);
        }
        walk = moving.parent;
    }
    motion(sphere, 0) = total;
}

double CollisionScene::relative_motion(size_t a, size_t b, size_t common, Vector delta) {
    for (const size_t sphere : {b, a}) {
        if (!spheres_[sphere].has_motion) { bound_motions(sphere, delta); }
    }
    const size_t common_depth = model_->frames[common].depth;
    return motion(a, common_depth) + motion(b, common_depth);
}

// To first order, and a remainder: joint j moves a point x along n by at most delta r, and by
// delta |n . (w x (x - o))| + delta r (turns before it + delta / 2): the turns of the joints nearer to the base tilt the
// direction, and the arc leaves its tangent.
double CollisionScene::motion_along(size_t geom, size_t common, Vec3 normal, Vector delta) const {
    const double radius = model_->spheres[geom].radius;
    // Of the hinges nearer to the base than the joint in hand; the walk goes from the geom to the base.
    double turns = 0.0;
    for (size_t walk = model_->geoms[geom].frame; walk != common; walk = model_->frames[walk].parent) {
        if (!model_->frames[walk].slides) { turns += delta[model_->frames[walk].joint]; }
    }
    double total = 0.0;
    for (size_t walk = model_->geoms[geom].frame; walk != common; walk = model_->frames[walk].parent) {
        const MovingFrame& moving = model_->frames[walk];
        const double step = delta[moving.joint];
        if (step <= 0.0) { continue; }
        const Vec3 axis = frames_[walk].axis;
        const double along_axis = dot(axis, normal);
        if (moving.slides) {
            total += step * std::min(1.0, std::abs(along_axis) + turns);
            continue;
        }
        turns -= step;
        const Vec3 velocity = cross(axis, spheres_[geom].center - frames_[walk].anchor);
        const double reach = norm(velocity) + radius;
        const double tangential = std::abs(dot(normal, velocity)) + radius * std::sqrt(std::max(0.0, 1.0 - along_axis * along_axis));
        total += step * std::min(reach, tangential + reach * (turns + 0.5 * step));
    }
    return total;
}

double CollisionScene::separating_motion(size_t p, Vector delta) const {
    const GeomPair& pair = model_->pairs[p];
    const Vec3 direction = memory_[p].direction;
    const double scale = 1.0 / norm(direction);
    const Vec3 normal = frames_[model_->geoms[pair.a].frame].pose.rotation * (scale * direction);
    return motion_along(pair.a, pair.common, normal, delta) + motion_along(pair.b, pair.common, normal, delta);
}

double CollisionScene::gap(size_t a, size_t b) const {
    const Vec3 center = spheres_[b].center;
    const double radius = model_->spheres[b].radius;
    if (a < model_->geoms.size()) {
        const Geom& first = model_->geoms[a];
        if (first.kind == ShapeKind::plane) { return dot(first.normal(), center) - first.offset - radius; }
        if (first.kind == ShapeKind::box && first.frame == 0) {
            const Vec3 inside = first.axes.inverse_times(center - first.position);
            const Vec3 outside = {std::max(std::abs(inside.x) - first.size.x, 0.0), std::max(std::abs(inside.y) - first.size.y, 0.0),
                                  std::max(std::abs(inside.z) - first.size.z, 0.0)};
            return norm(outside) - radius;
        }
    }
    return norm(spheres_[a].center - center) - model_->spheres[a].radius - radius;
}

// The direction that the last query found, or else from center to center, in the frame of the first geom.
Vec3 CollisionScene::first_direction(size_t p) const {
    const Vec3 last = memory_[p].direction;
    if (dot(last, last) > NO_DIRECTION_M2) { return last; }
    const GeomPair& pair = model_->pairs[p];
    const Vec3 between = spheres_[pair.a].center - spheres_[pair.b].center;
    if (dot(between, between) < NO_DIRECTION_M2) { return {1.0, 0.0, 0.0}; }
    return frames_[model_->geoms[pair.a].frame].pose.rotation.inverse_times(between);
}

// The farthest point of a geom in a direction of its frame. A search among vertices starts at `vertex`, and notes its result.
Vec3 CollisionScene::support_point(const Geom& geom, Vec3 direction, size_t& vertex) const {
    if (!geom.has_vertices()) { return round_support_point(geom, direction); }
    vertex = model_->vertices.farthest(geom, direction, vertex);
    return model_->vertices.positions[vertex];
}

// The support point of the difference of both geoms against a direction, in the frame of the first.
SupportPoint CollisionScene::difference_support(size_t p, Vec3 direction, const Pose& relative) {
    const GeomPair& pair = model_->pairs[p];
    PairMemory& memory = memory_[p];
    const Vec3 first = support_point(model_->geoms[pair.a], -direction, memory.vertex_a);
    const Vec3 second = support_point(model_->geoms[pair.b], relative.rotation.inverse_times(direction), memory.vertex_b);
    return {first - relative * second, first};
}

double CollisionScene::plane_distance(size_t p) {
    const Geom& plane = model_->geoms[model_->pairs[p].a];
    const Geom& other = model_->geoms[model_->pairs[p].b];
    const Pose& pose = frames_[other.frame].pose;
    const Vec3 normal = plane.normal();
    const Vec3 down = pose.rotation.inverse_times(-normal);
    const Vec3 lowest = support_point(other, down, memory_[p].vertex_b);
    const Vec3 origin = pose.translation;
    const double height = -dot(down, lowest) + normal.x * origin.x + normal.y * origin.y + normal.z * origin.z;
    return height - plane.offset - other.inflation;
}

// GJK in the frame of the first geom.
DistanceBounds CollisionScene::distance(size_t p, const DistanceGoal& goal) {
    const Geom& first = model_->geoms[model_->pairs[p].a];
    const Geom& second = model_->geoms[model_->pairs[p].b];
    if (first.kind == ShapeKind::plane) {
        const double height = plane_distance(p);
        return {height, height};
    }
    const Pose relative = frames_[second.frame].pose.seen_from(frames_[first.frame].pose);
    const double inflation = first.inflation + second.inflation;
    Vec3 v = first_direction(p);
    DistanceBounds bounds{-INFINITE_M, INFINITE_M};
    Simplex simplex;
    for (int step = 0; step < MAX_GJK_STEPS; ++step) {
        const double square = dot(v, v);
        const double length = std::sqrt(square);
        const SupportPoint support = difference_support(p, v, relative);
        const double projection = dot(v, support.difference);
        if (projection / length - inflation > bounds.lower) {
            bounds.lower = projection / length - inflation;
            memory_[p].direction = v;
            if (bounds.lower >= goal.enough) { return bounds; }
        }
        if (simplex.size() > 0) {
            bounds.upper = std::min(bounds.upper, length - inflation);
            const bool is_between = bounds.lower > goal.touching && bounds.upper < goal.enough;
            const bool is_decided = bounds.upper <= goal.touching || (!goal.is_exact && is_between);
            const bool has_converged = square - projection <= GJK_RELATIVE_GAP * square || bounds.upper - bounds.lower < GJK_GAP_M;
            if (is_decided || has_converged) { return bounds; }
        }
        if (simplex.contains(support.difference)) {  // no progress
            bounds.upper = std::min(bounds.upper, length - inflation);
            return bounds;
        }
        simplex.add(support);
        const std::optional<Vec3> closest = simplex.reduce_to_closest_point();
        if (!closest || dot(*closest, *closest) < OVERLAP_M2) {  // the hulls overlap, not only their inflated shapes
            return {bounds.lower, std::min(-inflation, OVERLAP_M)};
        }
        v = *closest;
    }
    return bounds;
}

bool CollisionScene::touches(size_t p, double clearance) {
    if (gap(model_->pairs[p].a, model_->pairs[p].b) > clearance) { return false; }
    return distance(p, {.enough = clearance + STRICTLY_M, .touching = clearance}).lower <= clearance;
}

size_t CollisionScene::first_hit(Vector positions, double clearance) {
    place(positions);
    if (last_hit_ != no_pair() && touches(last_hit_, clearance)) { return last_hit_; }
    for (const GroupPair& group : model_->groups) {
        if (gap(group.a, group.b) > clearance) { continue; }
        for (size_t p = group.first_pair; p < group.last_pair; ++p) {
            if (touches(p, clearance)) {
                expect_hit(p);
                return p;
            }
        }
    }
    return no_pair();
}

void CollisionScene::all_hits(Vector positions, double clearance, std::span<std::int64_t> hits) {
    place(positions);
    for (const GroupPair& group : model_->groups) {
        const bool is_far = gap(group.a, group.b) > clearance;
        for (size_t p = group.first_pair; p < group.last_pair; ++p) { hits[p] = !is_far && touches(p, clearance); }
    }
}

PairDistance CollisionScene::nearest_pair(Vector positions) {
    place(positions);
    PairDistance nearest{no_pair(), INFINITE_M};
    for (const GroupPair& group : model_->groups) {
        if (gap(group.a, group.b) > nearest.distance) { continue; }
        for (size_t p = group.first_pair; p < group.last_pair; ++p) {
            if (gap(model_->pairs[p].a, model_->pairs[p].b) > nearest.distance) { continue; }
            const double upper = distance(p, {.enough = nearest.distance, .touching = -INFINITE_M, .is_exact = true}).upper;
            if (upper < nearest.distance) { nearest = {p, upper}; }
        }
    }
    return nearest;
}

double CollisionScene::tilt(const KeptAxis& keep) const {
    const Vec3 axis = frames_[keep.frame].pose.rotation * keep.axis;
    return std::atan2(norm(cross(axis, keep.direction)), dot(axis, keep.direction));
}

KeptAxis CollisionScene::kept_axis(size_t frame, Vec3 direction, double within) const {
    return {frame, frames_[frame].pose.rotation.inverse_times(direction), direction, within};
}

}  // namespace armctl
