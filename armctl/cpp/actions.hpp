// What the numbers of a policy's action do: they move joint targets, which a reference approaches, or they are torques.
#pragma once
#include "dynamics.hpp"
#include "law.hpp"

namespace armctl {

enum class ActionMode : std::uint8_t { torque, joint_delta, joint_target, cartesian_delta, cartesian_pose };

// Limits of a joint that an action commands.
struct ActionLimits {
    double q_min = 0.0;    // rad
    double q_max = 0.0;    // rad
    double v_max = 0.0;    // rad/s
    double a_max = 0.0;    // rad/s^2
    double tau_max = 0.0;  // N m

    // The signed speed from which a joint stops within a way, sqrt(2 a s), exponential at a rate, 1/s, near the end.
    double approach_speed(double way, double rate) const;
};

// Numbers of an action are in [-1, 1].
struct ActionOptions {
    // The members by name. `mode` is an ActionMode, `limits` (5, n) are those of ActionLimits, `home_tip` (12,) is translation and
    // rotation matrix.
    ActionOptions(const Arguments& given, size_t n);

    ActionMode mode;
    std::vector<ActionLimits> limits;
    size_t size;            // numbers of an action
    size_t ticks;           // of a step
    double dt;              // s, the control period
    double joint_scale;     // s: a full action moves a joint's target as far as full speed does in this time
    double position_scale;  // m, of a full cartesian action
    double rotation_scale;  // rad, of a full cartesian action
    double approach_rate;   // 1/s, at which a reference approaches its target near the end
    double tip_damping;     // of the inverse Jacobian, squared
    Pose T_world_home;      // the tip at home, where cartesian poses begin
};

// A number of an action within [-1, 1]; 0 if it is not a number.
inline double unit(double value) { return value == value ? clipped(value, 1.0) : 0.0; }

// Joint targets that actions move, and the reference that approaches them.
class ActionTargets {
public:
    ActionTargets(const Model& model, const ActionOptions& options) : options_(options), dynamics_(model) {}

    // Moves targets (n,) by an action.
    void move(Vector action, Result target);

    // Moves the reference (n,) one tick towards the target, within speed and acceleration, so that it stops there without
    // overshoot. Returns the setpoint of this tick, which is valid until the next call.
    Setpoint advance(Vector target, Result q_ref, Result v_ref);

    // The pose of the tip at joint positions (n,).
    Pose tip(Vector q) {
        dynamics_.locate(q);
        return dynamics_.tip();
    }

private:
    void move_tip(Vector action, Result target);
    void follow(const Pose& goal, Result target);
    Numbers zeros() const { return Numbers(options_.limits.size()); }

    const ActionOptions& options_;
    Dynamics dynamics_;
    // The tip of an arm with fewer than six joints has a position as its goal.
    size_t components_ = options_.size == 6 ? 6 : 3;
    DenseMatrix square_{components_, components_};
    Numbers start_ = zeros(), q_ = zeros(), v_ = zeros(), a_ = zeros();
};

// Torques of actions, where a torque that would drive a joint too fast or into a stop is replaced by one that brakes it.
class TorqueGuard {
public:
    TorqueGuard(const Model& model, const ActionOptions& options) : options_(options), dynamics_(model) {}

    // The torque (n,) N m of an action in a state.
    void torque(Vector action, Vector q, Vector v, Result tau);

private:
    double guarded_acceleration(size_t i, double q, double v, double a) const;

    const ActionOptions& options_;
    Dynamics dynamics_;
    size_t n_ = options_.limits.size();
    Numbers bias_ = Numbers(n_), a_ = Numbers(n_);
    DenseMatrix factors_{n_, n_};
};

}  // namespace armctl
