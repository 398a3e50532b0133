#include "admittance.hpp"

#include <cmath>
#include <utility>

#include "../errors.hpp"

namespace armctl {

namespace {

// rad/s. The measured wrench is compensated, so the position loop need not be stiff. Faster, it resonates with a stiff wall.
constexpr double wrench_filter = 20.0;

std::vector<double> checked_masses(std::vector<double> masses) {
    for (const double mass : checked_gains(masses, 6, "mass")) {
        if (mass == 0.0) { throw InputError("mass: every value must be greater than 0, got 0"); }
    }
    return masses;
}

}  // namespace

Admittance::Admittance(std::shared_ptr<const ArmModel> model, Gains gains, double dt)
    : gains_{
          .mass = checked_masses(std::move(gains.mass)),
          .damping = checked_gains(std::move(gains.damping), 6, "damping"),
          .stiffness = checked_gains(std::move(gains.stiffness), 6, "stiffness"),
          .bandwidth = checked_gain(gains.bandwidth, "bandwidth"),
      },
      dt_(checked_period(dt)), dynamics_(model), task_(model->n()), memory_(size_t{3} * 6),
      mobility_(task_rows(model->n()), task_rows(model->n())), motion_(task_rows(model->n())), acceleration_(model->n()),
      v_friction_(model->n()), error_rate_(model->n()) {}

void Admittance::torque(const State& state, const Setpoint& setpoint, Result tau) {
    const size_t n = tau.size();
    const size_t rows = motion_.size();
    const Vector v_ref = setpoint.v_tick;
    const Vector a_ref = setpoint.a_tick;
    yield(state.wrench);
    task_.measure_tip(dynamics_, state.q, setpoint.q);
    task_.find_responses(dynamics_);
    task_.factorize_mobility(mobility_);

    const double bandwidth = gains_.bandwidth;
    const double posture_bandwidth = 0.5 * bandwidth;
    for (size_t i = 0; i < n; ++i) {
        acceleration_[i] = posture_bandwidth * posture_bandwidth * (setpoint.q[i] - state.q[i]);
        acceleration_[i] += 2.0 * posture_bandwidth * (v_ref[i] - state.v[i]);
        v_friction_[i] = v_ref[i];
    }
    const Matrix J = task_.J();
    const Matrix J_ref = task_.J_ref();
    for (size_t k = 0; k < rows; ++k) {
        // The acceleration of the offset is not fed forward: with a delay, a mass below the real one would bounce.
        double error_rate = rate()[k];
        double of_posture = 0.0;
        for (size_t i = 0; i < n; ++i) {
            error_rate += J_ref(k, i) * v_ref[i] - J(k, i) * state.v[i];
            of_posture += J(k, i) * acceleration_[i];
        }
        const double error = task_.error()[k] + offset()[k];
        motion_[k] = bandwidth * bandwidth * error + 2.0 * bandwidth * error_rate - of_posture;
    }
    task_.add_joint_motion(mobility_, motion_, acceleration_);
    for (size_t k = 0; k < rows; ++k) { motion_[k] = rate()[k]; }
    task_.add_joint_motion(mobility_, motion_, v_friction_);
    for (size_t i = 0; i < n; ++i) {
        acceleration_[i] += a_ref[i];
        error_rate_[i] = v_friction_[i] - state.v[i];
    }
    dynamics_.inverse_dynamics(state.q, state.v, acceleration_, tau);
    dynamics_.add_linear_damping(error_rate_, tau);
    dynamics_.add_friction(v_friction_, a_ref, tau);
    for (size_t i = 0; i < n; ++i) {
        for (size_t k = 0; k < rows; ++k) { tau[i] -= J(k, i) * filtered_wrench()[k]; }
    }
}

// Moves the offset by one control period, by an implicit Euler step, which is stable for any gains; filters the wrench.
void Admittance::yield(Vector wrench) {
    for (size_t k = 0; k < 6; ++k) {
        const double damping = gains_.damping[k];
        const double stiffness = gains_.stiffness[k];
        double& rate = this->rate()[k];
        double& offset = this->offset()[k];
        double& filtered = filtered_wrench()[k];
        const double force = wrench[k] - damping * rate - stiffness * (offset + dt_ * rate);
        rate += dt_ * force / (gains_.mass[k] + dt_ * damping + dt_ * dt_ * stiffness);
        offset += dt_ * rate;
        filtered -= std::expm1(-wrench_filter * dt_) * (wrench[k] - filtered);
    }
}

}  // namespace armctl
