// The chain of an arm from its base to the tip, as inverse kinematics sees it.
//
// Lengths are in units of the arm's reach, so that one set of constants fits an arm of three centimetres and one of three
// metres. The chain has k joints and n unknowns; n is less than k if joints follow others.
#pragma once
#include <limits>
#include <numbers>
#include <optional>

#include "errors.hpp"
#include "linear_algebra.hpp"
#include "vectors.hpp"

namespace armctl {

// How the axes of some joints are related.
enum class AxesRelation { meet, parallel };

struct Bounds {
    double low;
    double high;

    bool contain(double position) const { return low <= position && position <= high; }
    double clamp(double position) const { return std::min(std::max(position, low), high); }
};

struct ChainJoint {
    Pose placement;  // in the frame of the joint before, at position zero
    bool slides;
    size_t unknown;                // the number of the unknown that moves it
    double ratio;                  // its displacement divided by that unknown
    double distance_to_point = 0;  // along its axis, to the point in which it meets others, in a chain with a closed form
};

struct Unknown {
    Bounds bounds;
    Bounds free_bounds;  // of a descent without bounds, which unknowns with a period do not have
    Bounds one_turn;     // half a turn to each side for an unknown with a period, the bounds of others
    double period;       // 2 pi if whole turns lead back to the same pose, 0 if not
};

// The structure of a chain of six hinges with a closed form. In a chain of seven, one is left out.
struct SpecialAxes {
    AxesRelation relation;         // of the three special axes: they meet or are parallel
    size_t first;                  // the first of the three
    std::array<size_t, 3> others;  // the other joints, in the order of the loop
    AxesRelation pair_relation;    // of two neighbours among the others
    size_t pair_first;             // 0 if these are the first two of the others, 1 if the last two
};

inline Unknown make_unknown(Bounds bounds, double period) {
    constexpr double endless = std::numeric_limits<double>::infinity();
    const bool turns = period > 0;
    return {
        .bounds = bounds,
        .free_bounds = turns ? Bounds{-endless, endless} : bounds,
        .one_turn = turns ? Bounds{-std::numbers::pi, std::numbers::pi} : bounds,
        .period = period,
    };
}

// A position turned by whole turns of a period, if it has one, to that nearest to `near` inside bounds, if there is one.
inline double wound(double position, double near, Bounds bounds, double period) {
    if (!(period > 0)) { return position; }
    position += period * std::nearbyint((near - position) / period);
    if (position > bounds.high) { position -= period * std::ceil((position - bounds.high) / period); }
    if (position < bounds.low) { position += period * std::ceil((bounds.low - position) / period); }
    return position;
}

struct ChainDescription {
    double reach = 1.0;                         // m
    std::vector<ChainJoint> joints;             // k
    std::vector<Unknown> unknowns;              // n
    Pose tip;                                   // in the last joint's frame
    std::optional<SpecialAxes> special_axes{};  // of a chain with a closed form
};

// Immutable after its construction: threads share it.
class Chain {
public:
    explicit Chain(ChainDescription given)
        : joints_(std::move(given.joints)), unknowns_(std::move(given.unknowns)), tip_(given.tip), reach_(given.reach),
          special_axes_(given.special_axes) {
        const size_t k = joints_.size();
        if (k == 0 || unknowns_.size() > k) { throw InputError("slides: expected at least one joint, and one for each unknown"); }
        for (const ChainJoint& joint : joints_) { require_index(joint.unknown, unknowns_.size(), "unknowns"); }
        if (!special_axes_) { return; }
        for (const size_t other : special_axes_->others) { require_index(other, k, "others"); }
        require_index(special_axes_->first + 2, k, "first");
    }

    // Whether the unknowns q (n,) are inside their bounds.
    bool contains(Vector q) const {
        for (size_t i = 0; i < unknowns_.size(); ++i) {
            if (!unknowns_[i].bounds.contain(q[i]) || !std::isfinite(q[i])) { return false; }
        }
        return true;
    }

    // Turns the hinges by whole turns to the positions nearest to q0 inside bounds that are wider by a margin. Returns whether q is
    // inside then.
    bool wind_inside(Vector q0, double margin, Result q) const {
        bool is_inside = true;
        for (size_t i = 0; i < q.size(); ++i) {
            const Bounds wide{unknowns_[i].bounds.low - margin, unknowns_[i].bounds.high + margin};
            q[i] = wound(q[i], q0[i], wide, unknowns_[i].period);
            is_inside = is_inside && wide.contain(q[i]);
        }
        return is_inside;
    }

    // Moves unknowns outside their bounds to the bounds.
    void clamp(Result q) const {
        for (size_t i = 0; i < q.size(); ++i) { q[i] = unknowns_[i].bounds.clamp(q[i]); }
    }

    size_t n() const { return unknowns_.size(); }
    bool has_followers() const { return joints_.size() > unknowns_.size(); }
    const std::vector<ChainJoint>& joints() const { return joints_; }
    const std::vector<Unknown>& unknowns() const { return unknowns_; }
    const Pose& tip() const { return tip_; }
    double reach() const { return reach_; }
    const std::optional<SpecialAxes>& special_axes() const { return special_axes_; }

    // The origin of the first joint, from which the reach is measured.
    Vec3 base() const { return joints_.front().placement.translation; }

private:
    std::vector<ChainJoint> joints_;
    std::vector<Unknown> unknowns_;
    Pose tip_;  // in the last joint's frame
    double reach_;
    std::optional<SpecialAxes> special_axes_;
};

// A column of a rotation: the frame's x, y or z axis.
inline const Vec3& axis_of(const Rotation& rotation, int k) {
    if (k == 0) { return rotation.x; }
    return k == 1 ? rotation.y : rotation.z;
}

}  // namespace armctl
