// What the numbers of a policy's action do: they move joint targets, which a reference approaches, or they are torques.
#pragma once
#include <cstdint>
#include <memory>
#include <vector>

#include "dynamics.hpp"
#include "law.hpp"
#include "spans.hpp"
#include "tip_target.hpp"

namespace armctl {

enum class ActionMode : std::uint8_t { torque, joint_delta, joint_target, cartesian_delta, cartesian_pose };

// Numbers of an action are in [-1, 1].
struct ActionOptions {
    ActionMode mode = ActionMode::torque;
    size_t size = 0;              // numbers of an action
    size_t ticks = 0;             // of a step
    double dt = 0.0;              // s, the control period
    double joint_scale = 0.0;     // s: a full action moves a joint's target as far as full speed does in this time
    double position_scale = 0.0;  // m, of a full cartesian action
    double rotation_scale = 0.0;  // rad, of a full cartesian action
    double approach_rate = 0.0;   // 1/s, at which a reference approaches its target near the end
    double tip_damping = 0.0;     // of the inverse Jacobian, squared
    Pose T_world_home;            // the tip at home, where cartesian poses begin
};

// A number of an action within [-1, 1]; 0 if it is not a number.
inline double unit(double value) { return value == value ? std::min(std::max(value, -1.0), 1.0) : 0.0; }

// The signed speed from which a joint stops within a way, sqrt(2 a s), exponential near the end.
double approach_speed(double way, double a_max, double rate);

// Joint targets that actions move, and the reference that approaches them.
class ActionTargets {
public:
    ActionTargets(std::shared_ptr<const ArmModel> model, std::vector<ActionLimits> limits, const ActionOptions& options);

    // Moves targets (n,) by an action.
    void move(Vector action, Result target);

    // Moves the reference (n,) one tick towards the target, within speed and acceleration, so that it stops there without
    // overshoot. Returns the setpoint of this tick, which is valid until the next call.
    Setpoint advance(Vector target, Result q_ref, Result v_ref);

    // Moves target and reference as in one step: the motion of an arm that follows its reference.
    void rehearse(Vector action, Result target, Result q_ref, Result v_ref);

    // The pose of the tip at joint positions (n,).
    Pose tip(Vector q) { return tip_target_.tip(q); }

private:
    void move_tip(Vector action, Result target);

    std::vector<ActionLimits> limits_;
    ActionOptions options_;
    TipTarget tip_target_;
    // Scratch memory, (n,) each.
    std::vector<double> ways_;
    std::vector<double> q_;
    std::vector<double> v_;
    std::vector<double> a_;
};

// Torques of actions, where a torque that would drive a joint too fast or into a stop is replaced by one that brakes it.
class TorqueGuard {
public:
    TorqueGuard(std::shared_ptr<const ArmModel> model, std::vector<ActionLimits> limits, const ActionOptions& options);

    // The torque (n,) N m of an action in a state.
    void torque(Vector action, Vector q, Vector v, Result tau);

private:
    double guarded_acceleration(size_t i, double q, double v, double a) const;

    Dynamics dynamics_;
    std::vector<ActionLimits> limits_;
    double dt_;
    double rate_;
    // Scratch memory.
    std::vector<double> bias_;     // (n,)
    std::vector<double> a_;        // (n,)
    std::vector<double> factors_;  // (n, n)
};

}  // namespace armctl
