// A region in which a tip stays during a whole motion, and how far joints can take the tip towards its limits.
//
// The limits of lengths and angles are half-spaces of a point or of a unit vector that moves with the tip. A constraint manifold of a tip
// with a thickness: L. Jaillet, J. M. Porta, "Path planning under kinematic constraints by rapidly exploring manifolds", IEEE Trans.
// Robotics 29(1), 2013, plan on one; here a proof covers each line and each motion between samples.
#pragma once
#include "collision_scene.hpp"
#include "region.hpp"

namespace armctl {

// An axis that keeps its direction.
struct KeptAxis {
    Vec3 axis;            // in the world at the reference configuration
    Vec3 direction;       // in the world
    double within = 0.0;  // rad
};

// normal . x >= offset, where x is a point or a unit vector that moves with a frame.
struct HalfSpace {
    Vec3 normal;  // of the world
    Vec3 moving;  // x in the world at the reference configuration
    bool is_point = false;
    double offset = 0.0;  // m, or a sine
};

// Half-spaces of which one must hold: two of an angle whose range is wider than half a turn, else one.
struct RegionLimit {
    std::vector<HalfSpace> either;
    double thickness = 0.0;  // m or rad, between this limit and the one across; may be infinite
};

// What joints do in an interval: (m,) each, from the middle to an end along the tangent, and by how much they leave the middle at most.
struct JointMotions {
    Vector tangent;
    Vector delta;
};

// A region of one part, and the frame that carries the tip.
class KeptRegion {
public:
    // The tip has a pose where its frame is placed so.
    KeptRegion(const Region& region, size_t frame, const Pose& placed, const Pose& tip) : frame_(frame) {
        const Pose in_frame = tip.seen_from(placed);
        const Rotation& F = region.frame.rotation;
        Vec3 point = in_frame.translation;
        Vec3 origin = region.offset.translation;
        if (region.turns_freely()) {
            if (region.cone < std::numbers::pi) {
                const Vec3 axis = placed.rotation.inverse_times(axis_of(tip.rotation, region.axis));
                axis_ = KeptAxis{axis, F * axis_of(region.offset.rotation, region.axis), region.cone};
            }
        } else {
            const Rotation axes = in_frame.rotation * transposed(region.offset.rotation);
            point -= axes * region.offset.translation;
            origin = {};
            add_angles(region, axes);
        }
        add_lengths(region, point, F.inverse_times(region.frame.translation) + origin);
    }

    size_t frame() const { return frame_; }
    const std::optional<KeptAxis>& axis() const { return axis_; }
    const std::vector<RegionLimit>& limits() const { return limits_; }

    // The least thickness in any direction, m or rad; of a cone its angle to one side, twice.
    double thickness() const {
        double least = axis_ ? 2.0 * axis_->within : std::numeric_limits<double>::infinity();
        for (const RegionLimit& limit : limits_) { least = std::min(least, limit.thickness); }
        return least;
    }

    // The following are evaluated where the joints of a scene are placed.

    // The angle between the axis and the direction that it should keep, rad.
    double tilt(const CollisionScene& scene) const {
        const Vec3 axis = placed_axis(scene);
        return std::atan2(norm(cross(axis, axis_->direction)), dot(axis, axis_->direction));
    }

    // The axis that keeps its direction, in the world.
    Vec3 placed_axis(const CollisionScene& scene) const { return scene.frame(frame_).pose.rotation * axis_->axis; }

    // How far a point or a vector is inside a half-space, m or a sine; negative if it is outside.
    double inside(const CollisionScene& scene, const HalfSpace& space) const {
        return dot(space.normal, placed(scene, space)) - space.offset;
    }

    // The half-space of a limit in which the tip is farther inside.
    const HalfSpace& best_of(const CollisionScene& scene, const RegionLimit& limit) const {
        return *std::ranges::max_element(limit.either, {}, [&](const HalfSpace& space) { return inside(scene, space); });
    }

    // Whether the tip is in the region.
    bool contains_tip(const CollisionScene& scene) const {
        if (axis_ && tilt(scene) > axis_->within) { return false; }
        return std::ranges::all_of(limits_, [&](const RegionLimit& limit) { return inside(scene, best_of(scene, limit)) >= 0.0; });
    }

    // How fast each joint (m,) takes the tip into a half-space.
    Numbers gradient(const CollisionScene& scene, const HalfSpace& space) const {
        Numbers all(scene.model().joints());
        const Vec3 x = placed(scene, space);
        for (size_t walk = frame_; walk > 0; walk = scene.model().frames[walk].parent) {
            all[scene.model().frames[walk].joint] = dot(velocity(scene, space, walk, x), space.normal);
        }
        return all;
    }

    // How fast each joint (m,) turns the kept axis towards its direction.
    Numbers tilt_decrease(const CollisionScene& scene) const {
        const Vec3 axis = placed_axis(scene);
        Vec3 rotation = cross(axis, axis_->direction);
        if (dot(rotation, rotation) < UPSIDE_DOWN) {  // any rotation across the axis
            rotation = {axis.y - axis.z, axis.z - axis.x, axis.x - axis.y};
        }
        Numbers all(scene.model().joints());
        for (size_t walk = frame_; walk > 0; walk = scene.model().frames[walk].parent) {
            const MovingFrame& moving = scene.model().frames[walk];
            if (!moving.slides) { all[moving.joint] = dot(scene.frame(walk).axis, rotation) / norm(rotation); }
        }
        return all;
    }

    // Bounds the angle by which the kept axis turns while joint j moves by at most delta[j]. Change the joints from the base outward:
    // hinge j then turns the axis u on a circle of radius |a_j x u|.
    double turn(const CollisionScene& scene, Vector delta) const {
        const Vec3 axis = placed_axis(scene);
        double turn = 0.0;
        for (size_t walk = frame_; walk > 0; walk = scene.model().frames[walk].parent) {
            const MovingFrame& moving = scene.model().frames[walk];
            if (!moving.slides) { turn += delta[moving.joint] * norm(cross(scene.frame(walk).axis, axis)); }
        }
        return turn;
    }

    // Bounds by how much `inside` decreases in an interval.
    //
    // Taylor's formula: the tangent, what the joints do beside it, and half of the second derivatives times the products of the
    // deltas. The second derivative by a hinge i and a joint k beyond it is a_i x (dx/dq_k), and zero by a slide i; |dx/dq_k| of a hinge
    // is the distance of x from its axis, which joints beyond k change by no more than they move x. The whole motion of x is the other
    // bound: change the joints from the base outward, and joint k moves x by its distance in the middle times delta_k.
    double decrease(const CollisionScene& scene, const HalfSpace& space, const JointMotions& motions) const {
        const Vec3 x = placed(scene, space);
        double along = 0.0;
        double beside = 0.0;
        double curved = 0.0;
        double moved = 0.0;
        double beyond = 0.0;  // the sum of delta_k |dx/dq_k| of joints farther out
        for (size_t walk = frame_; walk > 0; walk = scene.model().frames[walk].parent) {
            const MovingFrame& moving = scene.model().frames[walk];
            const Vec3 by_joint = velocity(scene, space, walk, x);
            const double delta = motions.delta[moving.joint];
            const double tangent = motions.tangent[moving.joint];
            const double slope = dot(by_joint, space.normal);
            const double lever = norm(by_joint);
            along += slope * tangent;
            beside += std::abs(slope) * std::max(delta - std::abs(tangent), 0.0);
            const double farthest = moving.slides ? lever : lever + moved;
            if (!moving.slides) { curved += delta * (0.5 * delta * farthest + beyond); }
            beyond += delta * farthest;
            moved += delta * lever;
        }
        return std::min(std::abs(along) + beside + curved, moved);
    }

private:
    static constexpr double UPSIDE_DOWN = 1e-16;  // the square of a sine: the axis is upside down

    Vec3 placed(const CollisionScene& scene, const HalfSpace& space) const {
        const Pose& pose = scene.frame(frame_).pose;
        return space.is_point ? pose * space.moving : pose.rotation * space.moving;
    }

    // The derivative of x by the joint of a frame.
    static Vec3 velocity(const CollisionScene& scene, const HalfSpace& space, size_t frame, Vec3 x) {
        const CollisionScene::PlacedFrame& joint = scene.frame(frame);
        if (scene.model().frames[frame].slides) { return space.is_point ? joint.axis : Vec3{}; }
        return cross(joint.axis, space.is_point ? x - joint.anchor : x);
    }

    void add(const HalfSpace& space, double thickness) { limits_.push_back({{space}, thickness}); }

    void add_lengths(const Region& region, Vec3 point, Vec3 origin) {
        const Rotation& F = region.frame.rotation;
        const std::array<Vec3, 3> axes{F.x, F.y, F.z};
        const std::array<double, 3> origins{origin.x, origin.y, origin.z};
        for (size_t k = 0; k < 3; ++k) {
            const auto [low, high] = region.lengths[k];
            if (std::isfinite(low)) { add({axes[k], point, true, low + origins[k]}, high - low); }
            if (std::isfinite(high)) { add({-axes[k], point, true, -high - origins[k]}, high - low); }
        }
    }

    // With D the displacement from the frame: sin(yaw - low) cos(pitch) = Dyx cos(low) - Dxx sin(low), -Dzx = sin(pitch), and
    // sin(roll - low) cos(pitch) = Dzy cos(low) - Dzz sin(low).
    void add_angles(const Region& region, const Rotation& axes) {
        const Rotation& F = region.frame.rotation;
        const auto [roll_low, roll_high] = region.angles[0];
        add_turn(region.angles[0], {F.z, std::cos(roll_low) * axes.y - std::sin(roll_low) * axes.z},
                 {F.z, std::sin(roll_high) * axes.z - std::cos(roll_high) * axes.y});
        const auto [pitch_low, pitch_high] = region.angles[1];
        constexpr double quarter_turn = 0.5 * std::numbers::pi;
        if (pitch_low > -quarter_turn) { add({-F.z, axes.x, false, std::sin(pitch_low)}, pitch_high - pitch_low); }
        if (pitch_high < quarter_turn) { add({F.z, axes.x, false, -std::sin(pitch_high)}, pitch_high - pitch_low); }
        const auto [yaw_low, yaw_high] = region.angles[2];
        add_turn(region.angles[2], {std::cos(yaw_low) * F.y - std::sin(yaw_low) * F.x, axes.x},
                 {std::sin(yaw_high) * F.x - std::cos(yaw_high) * F.y, axes.x});
    }

    void add_turn(Bounds bounds, const HalfSpace& above_low, const HalfSpace& below_high) {
        const double width = bounds.high - bounds.low;
        if (width >= 2.0 * std::numbers::pi) { return; }
        if (width > std::numbers::pi) {
            limits_.push_back({{above_low, below_high}, width});
        } else {
            add(above_low, width);
            add(below_high, width);
        }
    }

    size_t frame_;
    std::optional<KeptAxis> axis_;
    std::vector<RegionLimit> limits_;
};

}  // namespace armctl
