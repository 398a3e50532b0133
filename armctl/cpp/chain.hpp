// The chain of an arm from its base to the tip, as inverse kinematics sees it.
//
// Lengths are in units of the arm's reach, so that one set of constants fits an arm of three centimetres and one of three
// metres. The chain has k joints and n unknowns; n is less than k if joints follow others.
#pragma once
#include <algorithm>
#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "arguments.hpp"
#include "vectors.hpp"

namespace armctl {

// How the axes of some joints are related.
enum class AxesRelation { neither = 0, meet = 1, parallel = 2 };

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

// Immutable after its construction: threads share it.
class Chain {
public:
    // From arrays that are named as here, for each of the k joints and each of the n unknowns; lengths in reaches, `reach` in m.
    explicit Chain(const Arguments& arguments);

    // Whether the unknowns q (n,) are inside their bounds.
    bool contains(Vector q) const;

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

// A position turned by whole turns of a period, if it has one, to that nearest to `near` inside bounds, if there is one.
double wound(double position, double near, Bounds bounds, double period);

// A column of a rotation: the frame's x, y or z axis.
inline const Vec3& axis_of(const Rotation& rotation, int k) {
    if (k == 0) { return rotation.x; }
    return k == 1 ? rotation.y : rotation.z;
}

}  // namespace armctl
