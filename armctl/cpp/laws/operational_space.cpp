#include "operational_space.hpp"

namespace armctl {

OperationalSpace::OperationalSpace(std::shared_ptr<const ArmModel> model, Gains gains)
    : gains_(gains), dynamics_(model), task_(model->n()), mobility_(6, 6), acceleration_(model->n()), error_rate_(model->n()) {
    checked_gain(gains.stiffness, "stiffness");
    checked_gain(gains.damping, "damping");
    checked_gain(gains.posture_stiffness, "posture_stiffness");
    checked_gain(gains.posture_damping, "posture_damping");
}

void OperationalSpace::torque(const State& state, const Setpoint& setpoint, Result tau) {
    const size_t n = tau.size();
    const Vector v_ref = setpoint.v_tick;
    const Vector a_ref = setpoint.a_tick;
    task_.measure_tip(dynamics_, state.q, setpoint.q);
    task_.find_responses(dynamics_);
    task_.factorize_mobility(mobility_);
    for (size_t i = 0; i < n; ++i) {
        error_rate_[i] = v_ref[i] - state.v[i];
        acceleration_[i] = gains_.posture_stiffness * (setpoint.q[i] - state.q[i]) + gains_.posture_damping * error_rate_[i];
    }
    const Matrix J = task_.J();
    const Matrix J_ref = task_.J_ref();
    // What the posture leaves to do for the tip.
    for (size_t k = 0; k < 6; ++k) {
        double rate = 0.0;
        double of_posture = 0.0;
        for (size_t i = 0; i < n; ++i) {
            rate += J_ref(k, i) * v_ref[i] - J(k, i) * state.v[i];
            of_posture += J(k, i) * acceleration_[i];
        }
        force_[k] = gains_.stiffness * task_.error()[k] + gains_.damping * rate - of_posture;
    }
    for (size_t i = 0; i < n; ++i) { acceleration_[i] += a_ref[i]; }
    task_.add_joint_motion(mobility_, force_, acceleration_);
    dynamics_.inverse_dynamics(state.q, state.v, acceleration_, tau);
    dynamics_.add_linear_damping(error_rate_, tau);
    dynamics_.add_friction(v_ref, a_ref, tau);
}

}  // namespace armctl
