#include "actions.hpp"

#include <algorithm>
#include <cmath>

#include "factorization.hpp"

namespace armctl {

double approach_speed(double way, double a_max, double rate) {
    const double distance = std::abs(way);
    double speed = rate * distance;
    if (speed * rate > a_max) { speed = std::sqrt(2.0 * a_max * (distance - 0.5 * a_max / (rate * rate))); }
    return std::copysign(speed, way);
}

ActionTargets::ActionTargets(std::shared_ptr<const ArmModel> model, std::vector<ActionLimits> limits, const ActionOptions& options)
    : limits_(std::move(limits)), options_(options),
      // The tip of an arm with fewer than six joints has a position as its goal.
      tip_target_(std::move(model), options.size == 6 ? 6 : 3, options.tip_damping), ways_(limits_.size()), q_(limits_.size()),
      v_(limits_.size()), a_(limits_.size()) {}

void ActionTargets::move(Vector action, Result target) {
    if (options_.mode == ActionMode::joint_delta) {
        for (size_t i = 0; i < target.size(); ++i) {
            const double moved = target[i] + options_.joint_scale * limits_[i].v_max * unit(action[i]);
            target[i] = std::min(std::max(moved, limits_[i].q_min), limits_[i].q_max);
        }
    } else if (options_.mode == ActionMode::joint_target) {
        for (size_t i = 0; i < target.size(); ++i) {
            const double share = 0.5 * (1.0 + unit(action[i]));
            target[i] = limits_[i].q_min + share * (limits_[i].q_max - limits_[i].q_min);
        }
    } else if (options_.mode != ActionMode::torque) {
        move_tip(action, target);
    }
}

void ActionTargets::move_tip(Vector action, Result target) {
    for (size_t i = 0; i < target.size(); ++i) { ways_[i] = options_.dt * static_cast<double>(options_.ticks) * limits_[i].v_max; }
    const Pose origin = options_.mode == ActionMode::cartesian_delta ? tip_target_.tip(target) : options_.T_world_home;
    const double position = options_.position_scale;
    const double rotation = options_.rotation_scale;
    Vec3 turn;
    if (options_.size == 6) { turn = {rotation * unit(action[3]), rotation * unit(action[4]), rotation * unit(action[5])}; }
    const Pose goal{
        .rotation = turned(turn, origin.rotation),
        .translation = origin.translation + Vec3{position * unit(action[0]), position * unit(action[1]), position * unit(action[2])},
    };
    tip_target_.follow(goal, limits_, ways_, target);
}

Setpoint ActionTargets::advance(Vector target, Result q_ref, Result v_ref) {
    const double dt = options_.dt;
    for (size_t i = 0; i < target.size(); ++i) {
        const ActionLimits& limits = limits_[i];
        const double way = target[i] - q_ref[i];
        const double wanted = approach_speed(way, limits.a_max, options_.approach_rate);
        const double speed = std::min(std::max(wanted, -limits.v_max), limits.v_max);
        const double change = limits.a_max * dt;
        const double after = std::min(std::max(speed, v_ref[i] - change), v_ref[i] + change);
        q_[i] = q_ref[i];
        v_[i] = v_ref[i];
        a_[i] = (after - v_ref[i]) / dt;
        v_ref[i] = after;
        q_ref[i] += dt * after;
    }
    return {.q = q_, .v = v_, .a = a_, .v_tick = v_, .a_tick = a_};
}

void ActionTargets::rehearse(Vector action, Result target, Result q_ref, Result v_ref) {
    move(action, target);
    for (size_t tick = 0; tick < options_.ticks; ++tick) { advance(target, q_ref, v_ref); }
}

TorqueGuard::TorqueGuard(std::shared_ptr<const ArmModel> model, std::vector<ActionLimits> limits, const ActionOptions& options)
    : dynamics_(std::move(model)), limits_(std::move(limits)), dt_(options.dt), rate_(options.approach_rate), bias_(limits_.size()),
      a_(limits_.size()), factors_(limits_.size() * limits_.size()) {}

double TorqueGuard::guarded_acceleration(size_t i, double q, double v, double a) const {
    const ActionLimits& limits = limits_[i];
    const double upper = std::min(approach_speed(limits.q_max - q, limits.a_max, rate_), limits.v_max);
    const double lower = std::max(approach_speed(limits.q_min - q, limits.a_max, rate_), -limits.v_max);
    const double brake = 2.0 * limits.a_max;
    const double highest = std::max((upper - v) / dt_, -brake);
    const double lowest = std::min((lower - v) / dt_, brake);
    return std::min(std::max(a, lowest), highest);
}

void TorqueGuard::torque(Vector action, Vector q, Vector v, Result tau) {
    const size_t n = tau.size();
    const MatrixResult M{factors_.data(), n, n};
    // The torques that keep the velocity, and the factors of the inertia of a step.
    std::ranges::fill(a_, 0.0);
    dynamics_.inverse_dynamics(q, v, a_, bias_);
    dynamics_.mass_matrix(M);
    dynamics_.add_step_inertia(M);
    factorize(M);
    const Matrix factors{factors_.data(), n, n};
    for (size_t i = 0; i < n; ++i) {
        tau[i] = limits_[i].tau_max * unit(action[i]);
        a_[i] = tau[i] - bias_[i];
    }
    solve(factors, a_);
    bool is_changed = false;
    for (size_t i = 0; i < n; ++i) {
        const double bounded = guarded_acceleration(i, q[i], v[i], a_[i]);
        is_changed = is_changed || bounded != a_[i];
        a_[i] = bounded;
    }
    if (is_changed) {
        multiply(factors, a_, tau);
        for (size_t i = 0; i < n; ++i) { tau[i] += bias_[i]; }
    }
}

}  // namespace armctl
