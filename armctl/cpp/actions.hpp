// What the numbers of a policy's action do: they move joint targets, which a reference approaches, or they are torques.
//
// A cartesian action has one block of numbers for each tip. The tips are moved together: they may share joints, such as a torso.
#pragma once
#include "dynamics.hpp"
#include "errors.hpp"
#include "law.hpp"
#include "motors.hpp"

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
    double approach_speed(double way, double rate) const {
        const double distance = std::abs(way);
        double speed = rate * distance;
        if (speed * rate > a_max) { speed = std::sqrt(2.0 * a_max * (distance - 0.5 * a_max / (rate * rate))); }
        return std::copysign(speed, way);
    }
};

// A tip, and its block of a cartesian action.
struct ActionTip {
    CarriedFrame frame;
    size_t size = 3;    // numbers of its block: 3 of the position, or 6 with the rotation
    Pose T_world_home;  // where cartesian poses begin
};

// Numbers of an action are in [-1, 1].
struct ActionOptions {
    ActionMode mode = ActionMode::torque;
    std::vector<ActionLimits> limits;  // of each joint
    size_t size = 0;                   // numbers of an action
    size_t ticks = 0;                  // of a step
    double dt = 0.0;                   // s, the control period
    double joint_scale = 0.0;          // s: a full action moves a joint's target as far as full speed does in this time
    double position_scale = 0.0;       // m, of a full cartesian action
    double rotation_scale = 0.0;       // rad, of a full cartesian action
    size_t smoothing = 1;              // ticks over which the reference is averaged
    double approach_rate = 0.0;        // 1/s, at which a reference approaches its target near the end
    double tip_damping = 0.0;          // of the inverse Jacobian, squared
    std::vector<ActionTip> tips;       // at least one

    bool is_cartesian() const { return mode == ActionMode::cartesian_delta || mode == ActionMode::cartesian_pose; }

    // The numbers of a cartesian action.
    size_t tip_numbers() const {
        size_t sum = 0;
        for (const ActionTip& tip : tips) { sum += tip.size; }
        return sum;
    }

    // Throws InputError if an arm of n driven joints, m in all, cannot act so.
    void check(size_t n, size_t m) const {
        const bool has_right_size = size == (is_cartesian() ? tip_numbers() : n);
        if (!has_right_size || limits.size() != n || ticks == 0 || smoothing == 0 || !(dt > 0.0)) {
            throw InputError("action: need a number for each joint, or a block for each tip; and a positive dt, ticks and smoothing");
        }
        for (const ActionTip& tip : tips) {
            if (tip.size != 3 && tip.size != 6) { throw InputError("tip_sizes: need 3 or 6 numbers for each tip"); }
            if (tip.frame.joint < -1 || tip.frame.joint >= static_cast<int>(m)) {
                throw InputError("tip_joints: need -1 or one of " + std::to_string(m) + " joints, got " + std::to_string(tip.frame.joint));
            }
        }
        if (tips.empty()) { throw InputError("tip_joints: need at least one tip"); }
    }
};

// A number of an action within [-1, 1]; 0 if it is not a number.
inline double unit(double value) { return value == value ? clipped(value, 1.0) : 0.0; }

inline double bounded(double value, double low, double high) { return std::min(std::max(value, low), high); }

// Joint targets that actions move, and the reference that approaches them.
class ActionTargets {
public:
    ActionTargets(const Model& model, const ActionOptions& options)
        : options_(options), dynamics_(model), goals_(options.is_cartesian() ? options.tips.size() : 0),
          components_(options.is_cartesian() ? options.size : 0), errors_(components_), J_(components_, model->n()),
          square_(components_, components_) {}

    // Moves targets (n,) by an action.
    void move(Vector action, Result target) {
        for (size_t i = 0; i < target.size(); ++i) {
            const ActionLimits& limits = options_.limits[i];
            if (options_.mode == ActionMode::joint_delta) {
                target[i] = bounded(target[i] + options_.joint_scale * limits.v_max * unit(action[i]), limits.q_min, limits.q_max);
            } else if (options_.mode == ActionMode::joint_target) {
                target[i] = limits.q_min + 0.5 * (1.0 + unit(action[i])) * (limits.q_max - limits.q_min);
            }
        }
        if (options_.is_cartesian()) { move_tips(action, target); }
    }

    // Moves the reference (n,) one tick towards the target, within speed and acceleration, so that it stops there without
    // overshoot. Returns the setpoint of this tick, which is valid until the next call.
    Setpoint advance(Vector target, Result q_ref, Result v_ref) {
        const double dt = options_.dt;
        for (size_t i = 0; i < target.size(); ++i) {
            const ActionLimits& limits = options_.limits[i];
            const double speed = clipped(limits.approach_speed(target[i] - q_ref[i], options_.approach_rate), limits.v_max);
            const double change = limits.a_max * dt;
            const double after = bounded(speed, v_ref[i] - change, v_ref[i] + change);
            q_[i] = q_ref[i];
            v_[i] = v_ref[i];
            a_[i] = (after - v_ref[i]) / dt;
            v_ref[i] = after;
            q_ref[i] += dt * after;
        }
        return {.q = q_, .v = v_, .a = a_, .v_tick = v_, .a_tick = a_};
    }

    // The pose of the first tip at joint positions (n,).
    Pose tip(Vector q) {
        dynamics_.locate(q);
        return dynamics_.pose_of(options_.tips.front().frame);
    }

private:
    static constexpr int max_iterations = 4;
    // Square of the error in m and rad: a full action is more than a thousand times its root.
    static constexpr double reached_squared = 1e-10;

    void move_tips(Vector action, Result target) {
        const bool is_delta = options_.mode == ActionMode::cartesian_delta;
        if (is_delta) { dynamics_.locate(target); }
        size_t first = 0;
        for (size_t k = 0; k < goals_.size(); ++k) {
            const ActionTip& tip = options_.tips[k];
            goals_[k] = moved(is_delta ? dynamics_.pose_of(tip.frame) : tip.T_world_home, action.subspan(first, tip.size));
            first += tip.size;
        }
        follow(target);
    }

    // A pose moved by the block of a tip, (3,) or (6,).
    Pose moved(const Pose& origin, Vector block) const {
        const auto scaled = [block](double scale, size_t k) {
            return Vec3{scale * unit(block[k]), scale * unit(block[k + 1]), scale * unit(block[k + 2])};
        };
        Pose goal = origin;
        goal.translation += scaled(options_.position_scale, 0);
        const Vec3 turn = block.size() == 6 ? scaled(options_.rotation_scale, 3) : Vec3();
        if (const double angle = norm(turn); angle > 0.0) { goal.rotation = rotation_about((1.0 / angle) * turn, angle) * origin.rotation; }
        return goal;
    }

    // Moves targets (n,) by damped least squares over the errors of all tips until these are at their goals, each joint within its
    // limits and at most as far from where it starts as it can move in a step.
    //
    // Nakamura, Hanafusa, "Inverse kinematic solutions with singularity robustness for robot manipulator control" (1986).
    void follow(Result target) {
        copy(target, start_);
        for (int iteration = 0; iteration < max_iterations; ++iteration) {
            dynamics_.locate(target);
            find_errors();
            if (dot(errors_, errors_) < reached_squared) { return; }
            find_jacobian();
            // The solver reads the lower triangle.
            for (size_t r = 0; r < components_; ++r) {
                for (size_t c = 0; c <= r; ++c) { square_(r, c) = dot(J_.row(r), J_.row(c), r == c ? options_.tip_damping : 0.0); }
            }
            factorize(square_);
            solve(square_, errors_);
            for (size_t i = 0; i < target.size(); ++i) {
                const ActionLimits& limits = options_.limits[i];
                const double way = options_.dt * static_cast<double>(options_.ticks) * limits.v_max;
                const double within_way = bounded(target[i] + dot(J_.column(i), errors_), start_[i] - way, start_[i] + way);
                target[i] = bounded(within_way, limits.q_min, limits.q_max);
            }
        }
    }

    // The translations, m, and rotations, rad, from the tips to their goals, one block after the other.
    void find_errors() {
        size_t first = 0;
        for (size_t k = 0; k < goals_.size(); ++k) {
            const ActionTip& tip = options_.tips[k];
            const std::array<double, 6> twist = numbers(difference(dynamics_.pose_of(tip.frame), goals_[k]));
            copy(Vector(twist).first(tip.size), Result(errors_).subspan(first, tip.size));
            first += tip.size;
        }
    }

    // How the joints move the tips, likewise.
    void find_jacobian() {
        size_t first = 0;
        for (const ActionTip& tip : options_.tips) {
            const Vector rows = dynamics_.jacobian_of(tip.frame).numbers().first(tip.size * J_.columns());
            copy(rows, J_.numbers().subspan(first * J_.columns()));
            first += tip.size;
        }
    }

    Numbers zeros() const { return Numbers(options_.limits.size()); }

    const ActionOptions& options_;
    Dynamics dynamics_;
    std::vector<Pose> goals_;  // of the tips; none, and no components, where actions move joints
    size_t components_;        // of all errors
    Numbers errors_;           // (components,)
    Mat J_;                    // (components, n)
    Mat square_;               // (components, components)
    Numbers start_ = zeros(), q_ = zeros(), v_ = zeros(), a_ = zeros();
};

// The mean of a reference over the last ticks. It stays within the same positions, speeds and accelerations, and its acceleration
// changes by at most 2 a_max in the time of the mean, which limits the jerk.
//
// Source: L. Biagiotti, C. Melchiorri, "FIR filters for online trajectory planning with time- and frequency-domain specifications",
// Control Engineering Practice 20(12), 2012.
class ReferenceMean {
public:
    ReferenceMean(size_t n, size_t ticks) : n_(n), ticks_(ticks), given_(3 * n, ticks), now_(3 * n), sum_(3 * n) {}

    // Begins at rest at a place (n,) rad.
    void restart(Vector q) {
        std::ranges::fill(now_, 0.0);
        copy(q, Result(now_).first(n_));
        for (size_t i = 0; i < sum_.size(); ++i) { sum_[i] = static_cast<double>(ticks_) * now_[i]; }
        given_.restart(ticks_);
        given_.delayed(now_);
    }

    // The mean with the reference of this tick; it is valid until the next call.
    Setpoint mean(const Setpoint& setpoint) {
        copy(setpoint.q, Result(now_).first(n_));
        copy(setpoint.v, Result(now_).subspan(n_, n_));
        copy(setpoint.a, Result(now_).last(n_));
        const Vector oldest = given_.delayed(now_);
        for (size_t i = 0; i < sum_.size(); ++i) {
            sum_[i] += now_[i] - oldest[i];
            now_[i] = sum_[i] / static_cast<double>(ticks_);
        }
        const Vector v = Vector(now_).subspan(n_, n_);
        const Vector a = Vector(now_).last(n_);
        return {.q = Vector(now_).first(n_), .v = v, .a = a, .v_tick = v, .a_tick = a};
    }

private:
    size_t n_;
    size_t ticks_;
    Delay given_;  // position, velocity and acceleration, (3 n,)
    Numbers now_, sum_;
};

// Torques of actions, where a torque that would drive a joint too fast or into a stop is replaced by one that brakes it.
class TorqueGuard {
public:
    TorqueGuard(const Model& model, const ActionOptions& options) : options_(options), dynamics_(model) {}

    // The torque (n,) N m of an action in a state.
    void torque(Vector action, Vector q, Vector v, Result tau) {
        // The torques that keep the velocity.
        std::ranges::fill(a_, 0.0);
        dynamics_.inverse_dynamics(q, v, a_, bias_);
        for (size_t i = 0; i < n_; ++i) {
            tau[i] = options_.limits[i].tau_max * unit(action[i]);
            a_[i] = tau[i] - bias_[i];
        }
        dynamics_.accelerate(a_);
        bool is_changed = false;
        for (size_t i = 0; i < n_; ++i) {
            const double guarded = guarded_acceleration(i, q[i], v[i], a_[i]);
            is_changed = is_changed || guarded != a_[i];
            a_[i] = guarded;
        }
        if (!is_changed) { return; }
        dynamics_.mass_matrix(inertia_);
        dynamics_.add_step_inertia(inertia_);
        for (size_t i = 0; i < n_; ++i) { tau[i] = dot(inertia_.row(i), a_, bias_[i]); }
    }

private:
    double guarded_acceleration(size_t i, double q, double v, double a) const {
        const ActionLimits& limits = options_.limits[i];
        const double upper = std::min(limits.approach_speed(limits.q_max - q, options_.approach_rate), limits.v_max);
        const double lower = std::max(limits.approach_speed(limits.q_min - q, options_.approach_rate), -limits.v_max);
        const double brake = 2.0 * limits.a_max;
        return bounded(a, std::min((lower - v) / options_.dt, brake), std::max((upper - v) / options_.dt, -brake));
    }

    const ActionOptions& options_;
    Dynamics dynamics_;
    size_t n_ = options_.limits.size();
    Numbers bias_ = Numbers(n_), a_ = Numbers(n_);
    Mat inertia_{n_, n_};
};

}  // namespace armctl
