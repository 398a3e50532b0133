// Pairs that are close: exact distances, negative where they overlap, and how they change with the joints.
#include <algorithm>
#include <cmath>

#include "collision_scene.hpp"

namespace armctl {

namespace {

// Relative: the direction of a distance is less accurate than the distance.
constexpr double WITNESS_GAP = 1e-10;
// Between geoms that are displaced until they are apart.
constexpr double PARTED_M = 1e-3;
constexpr int MAX_DEPTH_STEPS = 20;
constexpr double DEPTH_GAP_M = 1e-9;

}  // namespace

void CollisionScene::find_near_pairs(Vector positions, Vector delta, double share, Vector clearances) {
    near_pairs_.clear();
    place(positions);
    const size_t joints = model_->joints();
    for (const GroupPair& group : model_->groups) {
        const double group_motion = relative_motion(group.a, group.b, group.common, delta);
        const double group_gap = gap(group.a, group.b);
        for (size_t p = group.first_pair; p < group.last_pair; ++p) {
            if (share * (group_gap - clearances[p]) >= group_motion) { continue; }
            const GeomPair& pair = model_->pairs[p];
            const double pair_motion = relative_motion(pair.a, pair.b, pair.common, delta);
            if (share * (gap(pair.a, pair.b) - clearances[p]) >= pair_motion) { continue; }
            const double enough = clearances[p] + pair_motion / share;
            if (distance(p, {.enough = enough, .touching = -INFINITE_M}).lower >= enough) { continue; }
            const Witness nearest = witness(p);
            const Result gradient(near_gradients_.data() + near_pairs_.size() * joints, joints);
            write_distance_gradient(p, nearest, gradient);
            double approach = 0.0;
            for (size_t j = 0; j < joints; ++j) { approach += std::abs(gradient[j]) * delta[j]; }
            if (share * (nearest.distance - clearances[p]) < approach) { near_pairs_.push_back({p, nearest.distance}); }
        }
    }
}

Vector CollisionScene::near_gradient(size_t index) const { return {near_gradients_.data() + index * model_->joints(), model_->joints()}; }

double CollisionScene::overlap_depth(Vector positions, size_t pair) {
    place_frames(positions);
    double least = INFINITE_M;
    for (const Vec3 direction : model_->directions) { least = std::min(least, depth_along(pair, direction)); }
    return least;
}

// How far the second geom of a pair must move along a direction of the world to part from the first; a plane has its own.
double CollisionScene::depth_along(size_t p, Vec3 direction) const {
    const Geom& first = model_->geoms[model_->pairs[p].a];
    const Geom& second = model_->geoms[model_->pairs[p].b];
    double top;
    if (first.kind == ShapeKind::plane) {
        direction = first.normal();
        top = first.offset;
    } else {
        top = dot(direction, farthest_point(first, direction));
    }
    const Vec3 lowest = farthest_point(second, -direction);
    return top - direction.x * lowest.x - direction.y * lowest.y - direction.z * lowest.z;
}

// The point of a geom, in the world, that is farthest in a direction of the world.
Vec3 CollisionScene::farthest_point(const Geom& geom, Vec3 direction) const {
    const Pose& pose = frames_[geom.frame].pose;
    size_t vertex = Vertices::NONE;
    const Vec3 point = support_point(geom, pose.rotation.inverse_times(direction), vertex);
    return pose * point + geom.inflation * direction;
}

CollisionScene::Witness CollisionScene::witness(size_t p) {
    const Geom& first = model_->geoms[model_->pairs[p].a];
    const Geom& second = model_->geoms[model_->pairs[p].b];
    if (first.kind == ShapeKind::plane) {
        const Vec3 lowest = farthest_point(second, -first.normal());
        return {dot(first.normal(), lowest) - first.offset, first.normal(), lowest, lowest};
    }
    std::optional<Witness> found = witness_apart(p, {});
    if (!found) { return witness_overlapping(p); }
    found->distance = found->distance - first.inflation - second.inflation;
    return *found;
}

// The witness of a pair without its radii, the second geom displaced in the world; nothing where it overlaps. GJK as in
// `distance`.
std::optional<CollisionScene::Witness> CollisionScene::witness_apart(size_t p, Vec3 displacement) {
    const Pose& pose = frames_[model_->geoms[model_->pairs[p].a].frame].pose;
    Pose relative = frames_[model_->geoms[model_->pairs[p].b].frame].pose.seen_from(pose);
    relative.translation += pose.rotation.inverse_times(displacement);
    Vec3 v = first_direction(p);
    Simplex simplex;
    for (int step = 0; step < MAX_GJK_STEPS; ++step) {
        const SupportPoint support = difference_support(p, v, relative);
        const double square = dot(v, v);
        const bool has_converged = simplex.size() > 0 && square - dot(v, support.difference) <= WITNESS_GAP * square;
        if (has_converged || simplex.contains(support.difference)) { break; }
        simplex.add(support);
        const std::optional<Vec3> closest = simplex.reduce_to_closest_point();
        if (!closest || dot(*closest, *closest) < OVERLAP_M2) { return std::nullopt; }
        v = *closest;
    }
    const double length = norm(v);
    const Vec3 on_first = pose * simplex.witness_on_first();
    const Vec3 direction = pose.rotation * Vec3{-v.x / length, -v.y / length, -v.z / length};
    return Witness{length, direction, on_first, on_first};  // the other point is along the direction
}

// The direction in which an overlapping pair parts soonest, improved from a lattice: displace the second geom along a
// direction n until the pair is just apart. Along the direction m of the shortest distance it parts no later than along n: with
// the displacement s and the distance d, the depth along m is s n.m - d <= s - d.
CollisionScene::Witness CollisionScene::witness_overlapping(size_t p) {
    const Geom& first = model_->geoms[model_->pairs[p].a];
    const double inflation = first.inflation + model_->geoms[model_->pairs[p].b].inflation;
    double depth = INFINITE_M;
    Witness best{};
    for (const Vec3 direction : model_->directions) {
        const double along = depth_along(p, direction) - inflation;
        if (along < depth) {
            depth = along;
            best.direction = direction;
        }
    }
    best.on_first = farthest_point(first, best.direction);
    best.on_second = best.on_first;
    for (int step = 0; step < MAX_DEPTH_STEPS; ++step) {
        const Vec3 displacement = (depth + PARTED_M) * best.direction;
        const std::optional<Witness> apart = witness_apart(p, displacement);
        if (!apart) {  // by rounding
            break;
        }
        best.direction = apart->direction;
        best.on_first = apart->on_first;
        best.on_second = apart->on_first - displacement;
        const double along = dot(displacement, best.direction) - apart->distance;
        const bool has_converged = along > depth - DEPTH_GAP_M;
        depth = along;
        if (has_converged) { break; }
    }
    best.distance = -depth - inflation;
    return best;
}

// How fast the nearest points move apart along the direction when a joint moves.
void CollisionScene::write_distance_gradient(size_t p, const Witness& witness, Result gradient) const {
    const GeomPair& pair = model_->pairs[p];
    std::fill(gradient.begin(), gradient.end(), 0.0);
    for (const bool is_first : {true, false}) {
        const Vec3 point = is_first ? witness.on_first : witness.on_second;
        const double sign = is_first ? -1.0 : 1.0;
        for (size_t walk = model_->geoms[is_first ? pair.a : pair.b].frame; walk != pair.common; walk = model_->frames[walk].parent) {
            const MovingFrame& moving = model_->frames[walk];
            const PlacedFrame& placed = frames_[walk];
            const Vec3 velocity = moving.slides ? placed.axis : cross(placed.axis, point - placed.anchor);
            gradient[moving.joint] += sign * dot(velocity, witness.direction);
        }
    }
}

}  // namespace armctl
