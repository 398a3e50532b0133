// Joint targets whose tip follows a goal.
#pragma once
#include <memory>
#include <span>
#include <vector>

#include "dynamics.hpp"
#include "spans.hpp"
#include "vectors.hpp"

namespace armctl {

// Limits of a joint that an action commands.
struct ActionLimits {
    double q_min = 0.0;    // rad
    double q_max = 0.0;    // rad
    double v_max = 0.0;    // rad/s
    double a_max = 0.0;    // rad/s^2
    double tau_max = 0.0;  // N m
};

// exp(turn) R: an orientation after a rotation by a rotation vector, rad, in the frame around it. Rodrigues' formula.
Rotation turned(Vec3 turn, const Rotation& R);

class TipTarget {
public:
    // `components` of the tip's error count: 3 for its position, 6 for its pose. `damping` is the square of that of the
    // inverse Jacobian.
    TipTarget(std::shared_ptr<const ArmModel> model, size_t components, double damping);

    // The pose of the tip at joint positions (n,).
    Pose tip(Vector q);

    // Moves targets (n,) by damped least squares until their tip is at a goal, each joint within its limits and at most `ways`
    // (n,) from where it starts.
    //
    // Nakamura, Hanafusa, "Inverse kinematic solutions with singularity robustness for robot manipulator control" (1986).
    void follow(const Pose& goal, std::span<const ActionLimits> limits, Vector ways, Result target);

private:
    Dynamics dynamics_;
    size_t components_;
    double damping_;
    // Scratch memory.
    std::vector<double> start_;     // (n,)
    std::vector<double> jacobian_;  // (6, n)
};

}  // namespace armctl
