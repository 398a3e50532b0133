// Distances of an arm from itself and its surroundings, where its joints are placed.
//
// For any direction v, v.w / |v| is a lower bound of the distance of two shapes, where w is the support point of their
// difference; it does not rely on convergence, so every proof of clearance rests on it.
#pragma once
#include <memory>
#include <numeric>
#include <optional>

#include "collision_model.hpp"
#include "gjk.hpp"
#include "loop_bounds.hpp"
#include "spans.hpp"
#include "vectors.hpp"

namespace armctl {

constexpr double GJK_RELATIVE_GAP = 1e-9;  // GJK stops where its bounds are so near to each other, relatively or in m
constexpr double GJK_GAP_M = 1e-7;
constexpr double NO_DIRECTION_M2 = 1e-20;  // the square of the length of a vector without a direction, m^2
constexpr double OVERLAP_M = -1e-12;       // an upper bound for points and hulls without a radius that overlap, m
constexpr double WITNESS_GAP = 1e-10;      // relative: the direction of a distance is less accurate than the distance
constexpr double PARTED_M = 1e-3;          // between geoms that are displaced until they are apart
constexpr int MAX_DEPTH_STEPS = 20;
constexpr double DEPTH_GAP_M = 1e-9;
constexpr int MAX_BOX_STEPS = 8;        // of GJK with a box of points: then its points are tried
constexpr double FIRST_REACH_M = 0.02;  // of the search for the nearest pair among many
constexpr double REACH_GROWTH = 4.0;

constexpr double INFINITE_M = 1e300;  // more than any distance
constexpr double STRICTLY_M = 1e-9;   // A distance is strictly above a clearance if it is greater by this

// An upper bound at or below zero means overlap.
struct DistanceBounds {
    double lower;  // m, rigorous
    double upper;
};

// When a search for a distance may stop: the lower bound reaches `enough`, the upper one falls to `touching`, or, unless it
// should be exact, the distance is known to be between the two.
struct DistanceGoal {
    double enough;
    double touching;
    bool is_exact = false;
};

// A pair, or `no_pair`, and its distance.
struct PairDistance {
    size_t pair;
    double distance;  // m
};

// A pair, its distance, m, which is negative if it overlaps, and the derivatives (n,) by the positions of the joints.
struct NearPair {
    size_t pair;
    double distance;
    Numbers gradient;
};

// One object for each thread: it holds the scratch memory of its queries.
class CollisionScene {
public:
    explicit CollisionScene(std::shared_ptr<const CollisionModel> model)
        : model_(std::move(model)), frames_(model_->frames.size()), centers_(model_->geoms.size()),
          motions_(model_->geoms.size(), model_->frames.size()), every_pair_(model_->pairs.size()) {
        std::iota(every_pair_.begin(), every_pair_.end(), size_t{0});
        for (size_t g = 0; g < centers_.size(); ++g) { centers_[g] = frames_[0].pose * model_->geoms[g].center; }
        if (model_->closure) { loops_.emplace(model_->closure); }
    }

    const CollisionModel& model() const { return *model_; }
    // What stands for no pair.
    size_t no_pair() const { return model_->pairs.size(); }

    // The positions of all joints, (m,), at q (n,); closed loops that do not close there are where they last do on the way.
    void find_positions(Vector q, Result all) {
        if (!loops_) {
            model_->positions(q, all);
            return;
        }
        loops_->close(q);
        copy(loops_->positions(), all);
    }

    // The derivatives by the n of what has derivatives (m,) by all joints, where `find_positions` has found them last.
    Numbers reduced_gradient(Vector all) const {
        const Mat& ratio = loops_ ? loops_->ratio() : model_->ratio();
        Numbers gradient(model_->n());
        for (size_t j = 0; j < gradient.size(); ++j) {
            for (size_t i = 0; i < all.size(); ++i) { gradient[j] += all[i] * ratio(i, j); }
        }
        return gradient;
    }

    // The closed loops; none in a tree.
    std::optional<BoundedLoops>& loops() { return loops_; }

    // Places all frames and bounding spheres at the positions of all joints, (m,) rad.
    void place(Vector positions) {
        place_frames(positions);
        for (const size_t g : model_->moving) { centers_[g] = frames_[model_->geoms[g].frame].pose * model_->geoms[g].center; }
    }

    void place_frames(Vector positions) {
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

    // A pair that is not farther apart than the clearance, or `no_pair`. Places the joints.
    size_t first_hit(Vector positions, double clearance) {
        place(positions);
        for (const size_t p : pairs_within([&](size_t) { return clearance; })) {
            if (touches(p, clearance)) { return p; }
        }
        return no_pair();
    }

    // Marks every such pair, (K,). Places the joints.
    void all_hits(Vector positions, double clearance, std::span<std::int64_t> hits) {
        place(positions);
        std::ranges::fill(hits, 0);
        for (const size_t p : pairs_within([&](size_t) { return clearance; })) { hits[p] = touches(p, clearance); }
    }

    // The pair that is nearest to touching; a distance at or below zero says that it overlaps. Places the joints.
    PairDistance nearest_pair(Vector positions) {
        place(positions);
        PairDistance nearest{no_pair(), INFINITE_M};
        if (!model_->standing) {
            find_nearer(every_pair_, nearest);
            return nearest;
        }
        find_nearer(model_->standing->other_pairs, nearest);
        double reach = FIRST_REACH_M;
        while (true) {
            const std::vector<size_t>& near = pairs_within([&](size_t) { return reach; });
            find_nearer(near, nearest);
            if (nearest.distance <= reach || near.size() == no_pair()) { return nearest; }
            reach *= REACH_GROWTH;
        }
    }

    // The pairs of which `gap` may be at most `reach(b)` of their second geom, m, in ascending order, and perhaps others. The result is
    // overwritten by the next call.
    template <class Reach>
    const std::vector<size_t>& pairs_within(Reach reach) {
        if (!model_->standing) { return every_pair_; }
        const StandingGeoms& standing = *model_->standing;
        near_pairs_.assign(standing.other_pairs.begin(), standing.other_pairs.end());
        for (const size_t b : model_->moving) {
            const std::vector<std::uint32_t>& of_geom = standing.pairs[b];
            if (of_geom.empty()) { continue; }
            const double farthest = model_->geoms[b].radius + standing.max_margin + reach(b) + STRICTLY_M;
            if (farthest < 0.0) { continue; }
            const double square = farthest * farthest;
            standing.tree.search(
                centers_[b], [&](const AlignedBox& bounds) { return bounds.squared_distance(centers_[b]) > square; },
                [&](size_t position) {
                    if (of_geom[position] != StandingGeoms::NO_PAIR) { near_pairs_.push_back(of_geom[position]); }
                    return false;
                });
        }
        std::ranges::sort(near_pairs_);
        return near_pairs_;
    }

    // As `pairs_within`, for what a motion that was bounded may bring to a clearance.
    const std::vector<size_t>& pairs_in_motion(double clearance) {
        return pairs_within([&](size_t b) { return clearance + motions_(b, 0); });
    }

    // The pairs that joints, moving by at most delta (m,), can bring nearer by more than a share of what is free, which is their
    // distance less their clearance (K,). Places the joints.
    std::vector<NearPair> near_pairs(Vector positions, Vector delta, double share, Vector clearances) {
        std::vector<NearPair> near;
        place(positions);
        bound_motions(delta);
        const double largest = clearances.empty() ? 0.0 : *std::ranges::max_element(clearances);
        for (const size_t p : pairs_within([&](size_t b) { return largest + motions_(b, 0) / share; })) {
            const double pair_motion = relative_motion(p);
            if (share * (gap(p) - clearances[p]) >= pair_motion) { continue; }
            const double enough = clearances[p] + pair_motion / share;
            if (distance(p, {.enough = enough, .touching = -INFINITE_M}).lower >= enough) { continue; }
            const Witness nearest = witness(p);
            const Numbers gradient = distance_gradient(p, nearest);
            double approach = 0.0;
            for (size_t j = 0; j < gradient.size(); ++j) { approach += std::abs(gradient[j]) * delta[j]; }
            if (share * (nearest.distance - clearances[p]) < approach) {
                near.push_back({p, nearest.distance, reduced_gradient(gradient)});
            }
        }
        return near;
    }

    // Marks the points (N, 3) that are not farther than a margin from some geoms, planes and points excepted. Places the joints.
    void mark_points(Vector positions, const std::vector<size_t>& geoms, Matrix points, double margin, std::span<std::int64_t> marks) {
        place(positions);
        for (size_t i = 0; i < points.rows; ++i) {
            const Vec3 point = vec3(points.row(i));
            const Geom ball = ball_at(point, 0.0);
            marks[i] = std::ranges::any_of(geoms, [&](size_t g) {
                const Geom& geom = model_->geoms[g];
                if (norm(point - centers_[g]) > geom.radius + margin) { return false; }
                const GeomPair pair{ball, geom, point, centers_[g], 0.0};
                return distance(pair, frames_[geom.frame].pose, {.enough = margin + STRICTLY_M, .touching = margin}).lower <= margin;
            });
        }
    }

    // The following are evaluated where the joints are placed.

    // Whether a pair is not farther apart than the clearance.
    bool touches(size_t p, double clearance) const {
        if (gap(p) > clearance) { return false; }
        return distance(p, {.enough = clearance + STRICTLY_M, .touching = clearance}).lower <= clearance;
    }

    DistanceBounds distance(size_t p, const DistanceGoal& goal) const {
        const GeomPair pair = geoms_of(p);
        if (pair.first.kind == ShapeKind::plane) {
            const double height = plane_witness(pair).distance;
            return {height, height};
        }
        if (pair.first.cloud) { return nearest_point(p, goal).bounds; }
        return distance(pair, frames_[pair.second.frame].pose.seen_from(frames_[pair.first.frame].pose), goal);
    }

    // A lower bound of the distance of a pair: of two bounding spheres, or of a box or a plane and a sphere.
    double gap(size_t p) const {
        const CollisionPair& pair = model_->pairs[p];
        const Geom& first = model_->geoms[pair.a];
        const Vec3 center = centers_[pair.b];
        const double radius = model_->geoms[pair.b].radius;
        if (first.kind == ShapeKind::plane) { return dot(first.normal(), center) - first.offset - radius - pair.margin; }
        if (first.cloud) {
            const double reach = first.cloud->radius() + radius + pair.margin;
            return first.cloud->distance(first.axes.inverse_times(center - first.position)) - reach;
        }
        if (first.kind == ShapeKind::box && first.frame == 0) {
            const Vec3 inside = first.axes.inverse_times(center - first.position);
            const Vec3 outside = {std::max(std::abs(inside.x) - first.size.x, 0.0), std::max(std::abs(inside.y) - first.size.y, 0.0),
                                  std::max(std::abs(inside.z) - first.size.z, 0.0)};
            return norm(outside) - radius - pair.margin;
        }
        return norm(centers_[pair.a] - center) - first.radius - radius - pair.margin;
    }

    // Bounds how far any point of each geom moves as the frames above it see it, while joint j moves by at most delta[j].
    //
    // Change the joints from the base outward: joint j then turns the geom about its axis at the center of the interval, and a
    // point at the distance r from the axis moves by at most delta[j] r.
    void bound_motions(Vector delta) {
        for (const size_t geom : model_->moving) {
            double total = 0.0;
            size_t walk = model_->geoms[geom].frame;
            for (; walk > 0; walk = model_->frames[walk].parent) {
                motions_(geom, walk) = total;
                const MovingFrame& moving = model_->frames[walk];
                const double step = delta[moving.joint];
                if (moving.slides) {
                    total += step;
                } else if (step > 0.0) {
                    const Vec3 lever = cross(centers_[geom] - frames_[walk].anchor, frames_[walk].axis);
                    total += step * (norm(lever) + model_->geoms[geom].radius);
                }
            }
            motions_(geom, 0) = total;
        }
    }

    // The bounded motion of any point of one geom of a pair as the other sees it.
    double relative_motion(size_t p) const {
        const CollisionPair& pair = model_->pairs[p];
        return motions_(pair.a, pair.common) + motions_(pair.b, pair.common);
    }

    struct PlacedFrame {
        Pose pose;
        Vec3 anchor;  // of its joint, in the world
        Vec3 axis;
    };
    const PlacedFrame& frame(size_t index) const { return frames_[index]; }

private:
    // The distance of a pair, its direction from the first to the second, and a point on the line through the nearest points.
    struct Witness {
        double distance;
        Vec3 direction;
        Vec3 point;
    };

    // The geoms of a pair, or one point of a cloud and a geom, in the world.
    struct GeomPair {
        const Geom& first;
        const Geom& second;
        Vec3 first_center;
        Vec3 second_center;
        double margin;

        // By how much the distance is less than that of the vertices: the radii and the margin of the contacts.
        double inflation() const { return first.inflation + second.inflation + margin; }
    };

    GeomPair geoms_of(size_t p) const {
        const CollisionPair& pair = model_->pairs[p];
        return {model_->geoms[pair.a], model_->geoms[pair.b], centers_[pair.a], centers_[pair.b], pair.margin};
    }

    // The same with a ball instead of the first geom.
    GeomPair with_ball(size_t p, const Geom& ball) const {
        const CollisionPair& pair = model_->pairs[p];
        return {ball, model_->geoms[pair.b], ball.position, centers_[pair.b], pair.margin};
    }

    // Keeps the pair that is nearest to touching, of some and the one at hand.
    void find_nearer(const std::vector<size_t>& pairs, PairDistance& nearest) const {
        for (const size_t p : pairs) {
            if (gap(p) > nearest.distance) { continue; }
            const double upper = distance(p, {.enough = nearest.distance, .touching = -INFINITE_M, .is_exact = true}).upper;
            if (upper < nearest.distance) { nearest = {p, upper}; }
        }
    }

    DistanceBounds distance(const GeomPair& pair, const Pose& relative, const DistanceGoal& goal) const {
        const double inflation = pair.inflation();
        DistanceBounds bounds{-INFINITE_M, INFINITE_M};
        Simplex simplex;
        const auto is_decided = [&](Vec3 v, Vec3 support) {
            const double square = dot(v, v);
            const double length = std::sqrt(square);
            const double projection = dot(v, support);
            bounds.lower = std::max(bounds.lower, projection / length - inflation);
            if (bounds.lower >= goal.enough) { return true; }
            if (simplex.size() == 0) { return false; }
            bounds.upper = std::min(bounds.upper, length - inflation);
            const bool is_between = bounds.lower > goal.touching && bounds.upper < goal.enough;
            const bool has_converged = square - projection <= GJK_RELATIVE_GAP * square || bounds.upper - bounds.lower < GJK_GAP_M;
            return bounds.upper <= goal.touching || (!goal.is_exact && is_between) || has_converged;
        };
        if (!closest_point(pair, relative, simplex, is_decided)) { bounds.upper = std::min(-inflation, OVERLAP_M); }
        return bounds;
    }

    // The distance of a cloud from a geom, and the point to which the upper bound belongs.
    struct NearestPoint {
        DistanceBounds bounds;
        size_t point = 0;
    };

    // The least distance of all points of a cloud. What is farther than the goal needs to know is skipped: boxes of the tree, by the
    // bounding sphere of the geom, or by a direction that separates them.
    NearestPoint nearest_point(size_t p, const DistanceGoal& goal) const {
        const Geom& first = model_->geoms[model_->pairs[p].a];
        const Geom& second = model_->geoms[model_->pairs[p].b];
        const PointCloud& cloud = *first.cloud;
        const Vec3 center = first.axes.inverse_times(centers_[model_->pairs[p].b] - first.position);
        const Pose relative = frames_[second.frame].pose.seen_from(first.pose());
        const double inflation = cloud.radius() + second.inflation + model_->pairs[p].margin;
        const double reach = cloud.radius() + second.radius + model_->pairs[p].margin;
        NearestPoint nearest{{INFINITE_M, INFINITE_M}};
        // Of points that are so far away, only this is to be known.
        const auto enough = [&]() {
            if (goal.is_exact) { return std::min(goal.enough, nearest.bounds.upper); }
            return nearest.bounds.upper < goal.enough ? std::min(goal.enough, goal.touching + STRICTLY_M) : goal.enough;
        };
        const auto is_skipped = [&](double lower) {
            if (lower < enough()) { return false; }
            nearest.bounds.lower = std::min(nearest.bounds.lower, lower);
            return true;
        };
        const auto is_far = [&](const AlignedBox& bounds) {
            if (is_skipped(std::sqrt(bounds.squared_distance(center)) - reach)) { return true; }
            if (bounds.radius() > second.radius) { return false; }
            return is_skipped(box_gap(bounds, second, relative, center, enough() + inflation) - inflation);
        };
        const auto visit = [&](size_t i) {
            const Vec3 point = cloud.points()[i];
            if (is_skipped(norm(point - center) - reach)) { return false; }
            const Geom ball = ball_at(point, cloud.radius());
            const GeomPair pair{ball, second, point, center, model_->pairs[p].margin};
            const DistanceBounds bounds =
                distance(pair, relative, {.enough = enough(), .touching = goal.touching, .is_exact = goal.is_exact});
            nearest.bounds.lower = std::min(nearest.bounds.lower, bounds.lower);
            if (bounds.upper < nearest.bounds.upper) {
                nearest.bounds.upper = bounds.upper;
                nearest.point = i;
            }
            return nearest.bounds.upper <= goal.touching;
        };
        cloud.tree().search(center, is_far, visit);
        return nearest;
    }

    // A lower bound of the distance of a box and a geom without its radius: the best one that GJK finds until it is enough, or until
    // the two are known to be nearer.
    double box_gap(const AlignedBox& bounds, const Geom& geom, const Pose& relative, Vec3 center, double enough) const {
        double lower = -INFINITE_M;
        Simplex simplex;
        Vec3 v = bounds.center() - center;
        if (dot(v, v) < NO_DIRECTION_M2) { return lower; }
        size_t vertex = Vertices::NONE;
        for (int step = 0; step < MAX_BOX_STEPS; ++step) {
            const Vec3 on_box = bounds.farthest(-v);
            const Vec3 on_geom = relative * support_point(geom, relative.rotation.inverse_times(v), vertex);
            const double length = norm(v);
            lower = std::max(lower, dot(v, on_box - on_geom) / length);
            if (lower >= enough || (simplex.size() > 0 && length < enough)) { break; }
            simplex.add({on_box - on_geom, on_box});
            const std::optional<Vec3> closest = simplex.reduce_to_closest_point();
            if (!closest || dot(*closest, *closest) < OVERLAP_M2) { break; }
            v = *closest;
        }
        return lower;
    }

    // The direction from center to center, in the frame of the first geom.
    Vec3 first_direction(const GeomPair& pair) const {
        const Vec3 between = pair.first_center - pair.second_center;
        if (dot(between, between) < NO_DIRECTION_M2) { return {1.0, 0.0, 0.0}; }
        return frames_[pair.first.frame].pose.rotation.inverse_times(between);
    }

    // The farthest point of a geom in a direction of its frame. A search among vertices starts at `vertex`, and notes its result.
    Vec3 support_point(const Geom& geom, Vec3 direction, size_t& vertex) const {
        if (!geom.has_vertices()) { return round_support_point(geom, direction); }
        vertex = model_->vertices.farthest(geom, direction, vertex);
        return model_->vertices.positions[vertex];
    }

    // GJK in the frame of the first geom, until a function of the closest point and of the support point against it says that
    // this is enough, or there is no progress. Nothing where the hulls overlap, not only their inflated shapes.
    template <class IsDecided>
    std::optional<Vec3> closest_point(const GeomPair& pair, const Pose& relative, Simplex& simplex, IsDecided is_decided) const {
        Vec3 v = first_direction(pair);
        size_t vertex_a = Vertices::NONE;
        size_t vertex_b = Vertices::NONE;
        for (int step = 0; step < MAX_GJK_STEPS; ++step) {
            const Vec3 on_first = support_point(pair.first, -v, vertex_a);
            const Vec3 on_second = support_point(pair.second, relative.rotation.inverse_times(v), vertex_b);
            const SupportPoint support{on_first - relative * on_second, on_first};
            if (is_decided(v, support.difference)) { break; }
            simplex.add(support);
            const std::optional<Vec3> closest = simplex.reduce_to_closest_point();
            if (!closest || dot(*closest, *closest) < OVERLAP_M2) { return std::nullopt; }
            const bool is_nearer = step == 0 || dot(*closest, *closest) < dot(v, v);
            v = *closest;
            if (!is_nearer) { break; }
        }
        return v;
    }

    // The point of a geom, in the world, that is farthest in a direction of the world.
    Vec3 farthest_point(const Geom& geom, Vec3 direction) const {
        const Pose& pose = frames_[geom.frame].pose;
        size_t vertex = Vertices::NONE;
        const Vec3 point = support_point(geom, pose.rotation.inverse_times(direction), vertex);
        return pose * point + geom.inflation * direction;
    }

    // How far the second geom of a pair must move along a direction of the world to part from the first.
    double depth_along(const GeomPair& pair, Vec3 direction) const {
        const Vec3 lowest = farthest_point(pair.second, -direction);
        return dot(direction, farthest_point(pair.first, direction) - lowest);
    }

    // Of a pair of a plane and another geom.
    Witness plane_witness(const GeomPair& pair) const {
        const Geom& plane = pair.first;
        const Vec3 lowest = farthest_point(pair.second, -plane.normal());
        return {dot(plane.normal(), lowest) - plane.offset - pair.margin, plane.normal(), lowest};
    }

    Witness witness(size_t p) const {
        const GeomPair pair = geoms_of(p);
        if (!pair.first.cloud) { return witness(pair); }
        const size_t nearest = nearest_point(p, {.enough = INFINITE_M, .touching = -INFINITE_M, .is_exact = true}).point;
        const Geom ball = ball_at(pair.first.pose() * pair.first.cloud->points()[nearest], pair.first.cloud->radius());
        return witness(with_ball(p, ball));
    }

    Witness witness(const GeomPair& pair) const {
        if (pair.first.kind == ShapeKind::plane) { return plane_witness(pair); }
        std::optional<Witness> found = witness_apart(pair, {});
        if (!found) { return witness_overlapping(pair); }
        found->distance -= pair.inflation();
        return *found;
    }

    // The witness of a pair without its radii and margin, the second geom displaced in the world; nothing where it overlaps.
    std::optional<Witness> witness_apart(const GeomPair& pair, Vec3 displacement) const {
        const Pose& pose = frames_[pair.first.frame].pose;
        Pose relative = frames_[pair.second.frame].pose.seen_from(pose);
        relative.translation += pose.rotation.inverse_times(displacement);
        Simplex simplex;
        const auto has_converged = [&](Vec3 v, Vec3 support) {
            return simplex.size() > 0 && dot(v, v) - dot(v, support) <= WITNESS_GAP * dot(v, v);
        };
        const std::optional<Vec3> v = closest_point(pair, relative, simplex, has_converged);
        if (!v) { return std::nullopt; }
        const double length = norm(*v);
        const Vec3 direction = pose.rotation * Vec3{-v->x / length, -v->y / length, -v->z / length};
        return Witness{length, direction, pose * simplex.witness_on_first()};
    }

    // The direction in which an overlapping pair parts soonest, improved from a lattice: displace the second geom along a
    // direction n until the pair is just apart. Along the direction m of the shortest distance it parts no later than along n: with
    // the displacement s and the distance d, the depth along m is s n.m - d <= s - d.
    Witness witness_overlapping(const GeomPair& pair) const {
        const double radii = pair.first.inflation + pair.second.inflation;
        double depth = INFINITE_M;
        Witness best{};
        for (const Vec3 direction : model_->directions) {
            const double along = depth_along(pair, direction) - radii;
            if (along < depth) {
                depth = along;
                best.direction = direction;
            }
        }
        best.point = farthest_point(pair.first, best.direction);
        for (int step = 0; step < MAX_DEPTH_STEPS; ++step) {
            const Vec3 displacement = (depth + PARTED_M) * best.direction;
            const std::optional<Witness> apart = witness_apart(pair, displacement);
            if (!apart) {  // by rounding
                break;
            }
            best.direction = apart->direction;
            best.point = apart->point;
            const double along = dot(displacement, best.direction) - apart->distance;
            const bool has_converged = along > depth - DEPTH_GAP_M;
            depth = along;
            if (has_converged) { break; }
        }
        best.distance = -depth - pair.inflation();
        return best;
    }

    // How fast the nearest points move apart along the direction when a joint moves, (m,).
    Numbers distance_gradient(size_t p, const Witness& witness) const {
        const CollisionPair& pair = model_->pairs[p];
        Numbers gradient(model_->joints());
        for (const bool is_first : {true, false}) {
            const double sign = is_first ? -1.0 : 1.0;
            for (size_t walk = model_->geoms[is_first ? pair.a : pair.b].frame; walk != pair.common; walk = model_->frames[walk].parent) {
                const MovingFrame& moving = model_->frames[walk];
                const PlacedFrame& placed = frames_[walk];
                const Vec3 velocity = moving.slides ? placed.axis : cross(placed.axis, witness.point - placed.anchor);
                gradient[moving.joint] += sign * dot(velocity, witness.direction);
            }
        }
        return gradient;
    }

    std::shared_ptr<const CollisionModel> model_;
    std::vector<PlacedFrame> frames_;
    std::vector<Vec3> centers_;  // of the bounding spheres of the geoms
    Mat motions_;                // of each geom, as each frame above it sees it
    std::vector<size_t> every_pair_;
    std::vector<size_t> near_pairs_;  // of the last search among many
    std::optional<BoundedLoops> loops_;
};

}  // namespace armctl
