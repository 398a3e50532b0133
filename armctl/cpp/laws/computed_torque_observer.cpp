#include "computed_torque_observer.hpp"

#include <cmath>
#include <utility>

#include "../factorization.hpp"

namespace armctl {

ComputedTorqueObserver::ComputedTorqueObserver(std::shared_ptr<const ArmModel> model, Gains gains, double dt, bool continuous)
    : ComputedTorqueObserver(std::move(model), std::move(gains), dt, continuous, 0) {}

ComputedTorqueObserver::ComputedTorqueObserver(std::shared_ptr<const ArmModel> model, Gains gains, double dt, bool continuous,
                                               size_t further_memory)
    : stiffness_(checked_gain(gains.stiffness, "stiffness")), damping_(checked_gain(gains.damping, "damping")), weights_(gains.estimate),
      disturbance_weight_(checked_gain(gains.disturbance_weight, "disturbance_weight")),
      torque_limit_(checked_limits(std::move(gains.torque_limit), model->n(), "torque_limit")), dt_(checked_period(dt)),
      position_step_(position_step(continuous)), dynamics_(model), memory_(1 + memory_vectors * model->n() + further_memory),
      known_(model->n()), needed_(model->n()), last_position_(model->n()), last_velocity_(model->n()), corrected_velocity_(model->n()),
      lost_(model->n()), inertia_(model->n(), model->n()) {}

void ComputedTorqueObserver::torque(const State& state, const Setpoint& setpoint, Result tau) {
    observe(state);
    control(setpoint, tau);
    cancel(tau);
    add_known(tau);
}

void ComputedTorqueObserver::observe(const State& state) {
    const MotionEstimate estimate = this->estimate();
    if (!has_begun()) {
        estimate.begin(state);
        return;
    }
    std::ranges::copy(estimate.position, last_position_.begin());
    std::ranges::copy(estimate.velocity, last_velocity_.begin());
    estimate.correct(state.q, weights_, dt_, position_step_);
    dynamics_.inverse_dynamics(last_position_, last_velocity_, estimate.acceleration, needed_);
    const Result disturbance = this->disturbance();
    const Result last_torque = this->last_torque();
    for (size_t i = 0; i < joints(); ++i) { disturbance[i] += disturbance_weight_ * (needed_[i] - last_torque[i] - disturbance[i]); }
}

void ComputedTorqueObserver::control(const Setpoint& setpoint, Result tau) {
    const auto [position, velocity, acceleration] = estimate();
    const Vector v_ref = setpoint.v_tick;
    const Vector a_ref = setpoint.a_tick;
    const double bandwidth = std::sqrt(stiffness_);
    for (size_t i = 0; i < joints(); ++i) {
        const double error = setpoint.q[i] - position[i];
        acceleration[i] = a_ref[i] + stiffness_ * error + damping_ * (v_ref[i] - velocity[i]);
        corrected_velocity_[i] = v_ref[i] + bandwidth * error - velocity[i];
        known_[i] = 0.0;
    }
    dynamics_.inverse_dynamics(position, velocity, acceleration, tau);
    // Damping is compensated at the velocity v_ref + bandwidth x error: the arm's own damping then helps the feedback, and the
    // error of a joint that hardly anything but damping resists decays as fast as those of the others. Compensated at the
    // estimated velocity, which is late, large damping would be a large positive feedback.
    dynamics_.add_linear_damping(corrected_velocity_, tau);
    dynamics_.add_friction(v_ref, a_ref, known_);
}

void ComputedTorqueObserver::cancel(Result tau) {
    const Result disturbance = this->disturbance();
    const Result last_torque = this->last_torque();
    bool is_clipped = false;
    memory_[0] = 1.0;
    for (size_t i = 0; i < joints(); ++i) {
        tau[i] -= disturbance[i];
        last_torque[i] = clipped(tau[i] + known_[i], torque_limit_[i]) - known_[i];
        lost_[i] = last_torque[i] - tau[i];
        is_clipped = is_clipped || std::abs(tau[i] + known_[i]) > torque_limit_[i];
    }
    if (is_clipped) { subtract_lost_acceleration(); }
}

// What the motors cut off is no disturbance.
void ComputedTorqueObserver::subtract_lost_acceleration() {
    dynamics_.mass_matrix(inertia_);
    dynamics_.add_step_inertia(inertia_);
    factorize(inertia_);
    solve(inertia_, lost_);
    const Result acceleration = this->acceleration();
    for (size_t i = 0; i < joints(); ++i) { acceleration[i] += lost_[i]; }
}

void ComputedTorqueObserver::add_known(Result tau) const {
    for (size_t i = 0; i < joints(); ++i) { tau[i] += known_[i]; }
}

}  // namespace armctl
