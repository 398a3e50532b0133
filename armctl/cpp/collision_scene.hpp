// Distances of an arm from itself and its surroundings, where its joints are placed.
//
// For any direction v, v.w / |v| is a lower bound of the distance of two shapes, where w is the support point of their
// difference; it does not rely on convergence, so every proof of clearance rests on it.
#pragma once
#include <memory>
#include <optional>
#include <vector>

#include "collision_model.hpp"
#include "gjk.hpp"
#include "spans.hpp"
#include "vectors.hpp"

namespace armctl {

// More than any distance.
constexpr double INFINITE_M = 1e300;
// A distance is strictly above a clearance if it is greater by this.
constexpr double STRICTLY_M = 1e-9;

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

// An axis that keeps its direction.
struct KeptAxis {
    size_t frame = 0;
    Vec3 axis;            // in the world at the reference configuration
    Vec3 direction;       // in the world
    double within = 0.0;  // rad
};

// One object for each thread: it holds the scratch memory of its queries, and what they found starts the next ones.
class CollisionScene {
public:
    explicit CollisionScene(std::shared_ptr<const CollisionModel> model);

    const CollisionModel& model() const { return *model_; }
    // What stands for no pair.
    size_t no_pair() const { return model_->pairs.size(); }

    // Forgets what earlier queries found; later results then do not depend on them.
    void forget();

    // Places all frames and bounding spheres at the positions of all joints, (m,) rad.
    void place(Vector positions);
    void place_frames(Vector positions);

    // A pair that is not farther apart than the clearance, or `no_pair`. Places the joints.
    size_t first_hit(Vector positions, double clearance);
    // The next `first_hit` begins with this pair.
    void expect_hit(size_t pair) { last_hit_ = pair; }
    // Marks every such pair, (K,). Places the joints.
    void all_hits(Vector positions, double clearance, std::span<std::int64_t> hits);
    // The pair that is nearest to touching; a distance at or below zero says that it overlaps. Places the joints.
    PairDistance nearest_pair(Vector positions);
    // How far the second geom of a pair must move to part from the first: the least over the model's directions. Places the
    // joints.
    double overlap_depth(Vector positions, size_t pair);

    // The pairs that joints, moving by at most delta (m,), can bring nearer by more than a share of what is free, which is
    // their distance less their clearance (K,). Places
    // the joints.
    void find_near_pairs(Vector positions, Vector delta, double share, Vector clearances);
    // What it found; distances are negative where pairs overlap.
    const std::vector<PairDistance>& near_pairs() const { return near_pairs_; }
    // (m,) the derivative of the distance of a near pair by each joint.
    Vector near_gradient(size_t index) const;

    // The following are evaluated where the joints are placed.

    // Whether a pair is not farther apart than the clearance.
    bool touches(size_t pair, double clearance);
    DistanceBounds distance(size_t pair, const DistanceGoal& goal);
    // A lower bound of the distance of two bounding spheres, of geoms or of groups; of a box or a plane and a sphere.
    double gap(size_t a, size_t b) const;
    // Bounds how far any point of one geom or group moves as the other sees it, while joint j moves by at most delta[j].
    double relative_motion(size_t a, size_t b, size_t common, Vector delta);
    // Bounds it along the direction that separates a pair.
    double separating_motion(size_t pair, Vector delta) const;
    // The angle between the axis and the direction that it should keep, rad.
    double tilt(const KeptAxis& keep) const;

    // The axis that has a direction of the world where the joints are placed.
    KeptAxis kept_axis(size_t frame, Vec3 direction, double within) const;

    struct PlacedFrame {
        Pose pose;
        Vec3 anchor;  // of its joint, in the world
        Vec3 axis;
    };
    const PlacedFrame& frame(size_t index) const { return frames_[index]; }

private:
    // What the last query of a pair found.
    struct PairMemory {
        Vec3 direction;  // in the frame of the first geom
        size_t vertex_a = Vertices::NONE;
        size_t vertex_b = Vertices::NONE;
    };

    struct PlacedSphere {
        Vec3 center;
        bool has_motion = false;
    };

    // The nearest points of a pair, or points at the same distance along the direction from the first to the second.
    struct Witness {
        double distance;
        Vec3 direction;
        Vec3 on_first;
        Vec3 on_second;
    };

    Vec3 first_direction(size_t pair) const;
    Vec3 support_point(const Geom& geom, Vec3 direction, size_t& vertex) const;
    SupportPoint difference_support(size_t pair, Vec3 direction, const Pose& relative);
    double plane_distance(size_t pair);
    void bound_motions(size_t sphere, Vector delta);
    double& motion(size_t sphere, size_t depth) { return motions_[sphere * model_->depth + depth]; }
    double motion_along(size_t geom, size_t common, Vec3 normal, Vector delta) const;
    Vec3 farthest_point(const Geom& geom, Vec3 direction) const;
    double depth_along(size_t pair, Vec3 direction) const;
    Witness witness(size_t pair);
    std::optional<Witness> witness_apart(size_t pair, Vec3 displacement);
    Witness witness_overlapping(size_t pair);
    void write_distance_gradient(size_t pair, const Witness& witness, Result gradient) const;

    std::shared_ptr<const CollisionModel> model_;
    std::vector<PairMemory> memory_;
    size_t last_hit_ = 0;
    std::vector<PlacedFrame> frames_;
    std::vector<PlacedSphere> spheres_;
    std::vector<double> motions_;  // of each sphere, relative to its ancestor of each depth
    std::vector<PairDistance> near_pairs_;
    std::vector<double> near_gradients_;
};

}  // namespace armctl
