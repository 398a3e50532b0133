#include "computed_torque.hpp"

#include <cmath>
#include <utility>

namespace armctl {

ComputedTorque::ComputedTorque(std::shared_ptr<const ArmModel> model, Gains gains, Form form, double dt)
    : stiffness_(checked_gain(gains.stiffness, "stiffness")), damping_(checked_gain(gains.damping, "damping")),
      gain_per_tick_(checked_gain(gains.integral, "integral_gain") * checked_period(dt)),
      added_inertia_(checked_gains(std::move(gains.added_inertia), model->n(), "added_inertia")),
      torque_limit_(checked_limits(std::move(gains.torque_limit), model->n(), "torque_limit")), form_(form), dynamics_(model),
      integral_(model->n()), correction_(model->n()), acceleration_(model->n()), error_rate_(model->n()), added_torque_(model->n()) {}

void ComputedTorque::torque(const State& state, const Setpoint& setpoint, Result tau) {
    const Vector v_ref = form_ == Form::textbook ? setpoint.v : setpoint.v_tick;
    const Vector a_ref = form_ == Form::textbook ? setpoint.a : setpoint.a_tick;
    for (size_t i = 0; i < tau.size(); ++i) {
        error_rate_[i] = v_ref[i] - state.v[i];
        correction_[i] = stiffness_ * (setpoint.q[i] - state.q[i]) + damping_ * error_rate_[i];
        acceleration_[i] = a_ref[i] + correction_[i] + integral_[i];
        added_torque_[i] = added_inertia_[i] * correction_[i];
    }
    dynamics_.inverse_dynamics(state.q, state.v, acceleration_, tau);
    // Damping is compensated at the velocity of the reference: the arm's own damping then helps the feedback. Compensated at
    // the measured velocity, large damping would be a large positive feedback.
    dynamics_.add_linear_damping(error_rate_, added_torque_);
    for (size_t i = 0; i < tau.size(); ++i) { tau[i] += added_torque_[i]; }
    dynamics_.add_friction(v_ref, a_ref, tau);
    if (gain_per_tick_ != 0.0) { integrate(state, setpoint, tau); }
}

void ComputedTorque::integrate(const State& state, const Setpoint& setpoint, Vector tau) {
    for (size_t i = 0; i < tau.size(); ++i) {
        const double change = gain_per_tick_ * (setpoint.q[i] - state.q[i]);
        const bool winds_up = std::abs(tau[i]) >= torque_limit_[i] && change * tau[i] > 0.0;
        if (!winds_up) { integral_[i] += change; }
    }
}

}  // namespace armctl
