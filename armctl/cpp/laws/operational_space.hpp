// Operational space control: the tip's error behaves like a unit mass on a spring; a posture law acts in the null space.
#pragma once
#include "task_space.hpp"

namespace armctl {

// tau = ID(q, v, a_ref + J# (k_p e + k_d e_dot) + (1 - J# J) (k_p' (q_ref - q) + k_d' (v_ref - v)))
//
// J# is the dynamically consistent inverse, damped near singular configurations.
class OperationalSpace final : public Cloneable<OperationalSpace> {
public:
    OperationalSpace(const Model& model, const Arguments& gains)
        : Cloneable(model->n()), stiffness_(gains.number("stiffness")), damping_(gains.number("damping")),
          posture_stiffness_(gains.number("posture_stiffness")), posture_damping_(gains.number("posture_damping")), task_(model, 6) {}

    void torque(const State& state, const Setpoint& setpoint, Result tau) override {
        const Vector v_ref = setpoint.v_tick;
        const Vector a_ref = setpoint.a_tick;
        task_.measure(state.q, setpoint.q);
        for (size_t i = 0; i < tau.size(); ++i) {
            error_rate_[i] = v_ref[i] - state.v[i];
            acceleration_[i] = posture_stiffness_ * (setpoint.q[i] - state.q[i]) + posture_damping_ * error_rate_[i];
        }
        Vector6 left_to_tip{};  // by the posture
        for (size_t k = 0; k < 6; ++k) {
            const double of_posture = dot(task_.J.row(k), acceleration_);
            left_to_tip[k] = stiffness_ * task_.error[k] + damping_ * task_.error_rate(k, v_ref, state.v) - of_posture;
        }
        for (size_t i = 0; i < tau.size(); ++i) { acceleration_[i] += a_ref[i]; }
        task_.add_joint_motion(left_to_tip, acceleration_);
        task_.dynamics.inverse_dynamics(state.q, state.v, acceleration_, tau);
        task_.dynamics.add_linear_damping(error_rate_, tau);
        task_.dynamics.add_friction(v_ref, a_ref, tau);
    }

private:
    double stiffness_;          // 1/s^2, of the tip
    double damping_;            // 1/s
    double posture_stiffness_;  // 1/s^2, of the joints
    double posture_damping_;    // 1/s
    TaskSpace task_;
    Numbers acceleration_ = zeros(), error_rate_ = zeros();
};

}  // namespace armctl
