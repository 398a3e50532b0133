#include "pd_gravity.hpp"

#include <cmath>
#include <utility>

namespace armctl {

PDGravity::PDGravity(std::shared_ptr<const ArmModel> model, PDGains gains)
    : feedback_(checked(std::move(gains), model->n())), dynamics_(model), gravity_(model->n()) {}

void PDGravity::torque(const State& state, const Setpoint& setpoint, Result tau) {
    dynamics_.gravity(state.q, gravity_);
    feedback_.torque(state, setpoint, tau);
    for (size_t i = 0; i < tau.size(); ++i) { tau[i] += gravity_[i]; }
}

PIDGravity::PIDGravity(std::shared_ptr<const ArmModel> model, PIDGains gains, double dt)
    : feedback_(checked(std::move(gains.feedback), model->n())), dynamics_(model),
      gain_per_tick_(checked_gains(std::move(gains.integral), model->n(), "integral_gain")),
      torque_limit_(checked_limits(std::move(gains.torque_limit), model->n(), "torque_limit")), gravity_(model->n()),
      integral_(model->n()) {
    checked_period(dt);
    for (double& gain : gain_per_tick_) { gain *= dt; }
}

void PIDGravity::torque(const State& state, const Setpoint& setpoint, Result tau) {
    dynamics_.gravity(state.q, gravity_);
    feedback_.torque(state, setpoint, tau);
    for (size_t i = 0; i < tau.size(); ++i) {
        tau[i] += gravity_[i] + integral_[i];
        const double change = gain_per_tick_[i] * (setpoint.q[i] - state.q[i]);
        const bool winds_up = std::abs(tau[i]) >= torque_limit_[i] && change * tau[i] > 0.0;
        if (!winds_up) { integral_[i] += change; }
    }
}

}  // namespace armctl
