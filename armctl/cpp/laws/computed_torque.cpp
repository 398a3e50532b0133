#include "computed_torque.hpp"

#include <utility>

#include "../factorization.hpp"

namespace armctl {

ComputedTorque::ComputedTorque(std::shared_ptr<const ArmModel> model, Gains gains, Form form, double dt, bool continuous)
    : stiffness_(checked_gain(gains.stiffness, "stiffness")), damping_(checked_gain(gains.damping, "damping")),
      added_inertia_(checked_gains(std::move(gains.added_inertia), model->n(), "added_inertia")), weights_(gains.estimate),
      torque_limit_(checked_limits(std::move(gains.torque_limit), model->n(), "torque_limit")), form_(form), dt_(checked_period(dt)),
      position_step_(position_step(continuous)), dynamics_(model), memory_(weights_.position > 0.0 && dt > 0.0 ? 1 + 3 * model->n() : 0),
      correction_(model->n()), acceleration_(model->n()), error_rate_(model->n()), added_torque_(model->n()),
      further_acceleration_(model->n()), inertia_(model->n(), model->n()) {}

// The state with estimated position and velocity.
State ComputedTorque::estimated(const State& state) {
    if (memory_.empty()) { return state; }
    const MotionEstimate estimate{memory_vector(0), memory_vector(1), memory_vector(2)};
    if (memory_[0] == 0.0) {
        estimate.begin(state);
        memory_[0] = 1.0;
    } else {
        estimate.correct(state.q, weights_, dt_, position_step_);
    }
    return {.q = estimate.position, .v = estimate.velocity, .wrench = state.wrench};
}

void ComputedTorque::torque(const State& measured, const Setpoint& setpoint, Result tau) {
    const State state = estimated(measured);
    const Vector v_ref = form_ == Form::textbook ? setpoint.v : setpoint.v_tick;
    const Vector a_ref = form_ == Form::textbook ? setpoint.a : setpoint.a_tick;
    for (size_t i = 0; i < tau.size(); ++i) {
        error_rate_[i] = v_ref[i] - state.v[i];
        correction_[i] = stiffness_ * (setpoint.q[i] - state.q[i]) + damping_ * error_rate_[i];
        acceleration_[i] = a_ref[i] + correction_[i];
        added_torque_[i] = added_inertia_[i] * correction_[i];
    }
    dynamics_.inverse_dynamics(state.q, state.v, acceleration_, tau);
    // Damping is compensated at the velocity of the reference: the arm's own damping then helps the feedback. Compensated at
    // the measured velocity, large damping would be a large positive feedback.
    dynamics_.add_linear_damping(error_rate_, added_torque_);
    for (size_t i = 0; i < tau.size(); ++i) { tau[i] += added_torque_[i]; }
    dynamics_.add_friction(v_ref, a_ref, tau);
    if (!memory_.empty()) { predict(tau); }
}

// The acceleration of the coming period: the commanded one, and that of added torques and of what the motors cut off.
void ComputedTorque::predict(Vector tau) {
    const Result acceleration = memory_vector(2);
    for (size_t i = 0; i < tau.size(); ++i) { further_acceleration_[i] = added_torque_[i] + clipped(tau[i], torque_limit_[i]) - tau[i]; }
    dynamics_.mass_matrix(inertia_);
    dynamics_.add_step_inertia(inertia_);
    factorize(inertia_);
    solve(inertia_, further_acceleration_);
    for (size_t i = 0; i < tau.size(); ++i) { acceleration[i] = acceleration_[i] + further_acceleration_[i]; }
}

}  // namespace armctl
