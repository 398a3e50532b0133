// Operational space control: the tip's error behaves like a unit mass on a spring; a posture law acts in the null space.
#pragma once
#include "task_space.hpp"

namespace armctl {

struct OperationalSpaceGains {
    double stiffness = 0.0;          // 1/s^2, of the tip
    double damping = 0.0;            // 1/s
    double posture_stiffness = 0.0;  // 1/s^2, of the joints
    double posture_damping = 0.0;    // 1/s
};

// tau = ID(q, v, a_ref + J# (k_p e + k_d e_dot) + (1 - J# J) (k_p' (q_ref - q) + k_d' (v_ref - v)))
//
// J# is the dynamically consistent inverse, damped near singular configurations. The linear damping of the joints is compensated at
// the velocity v_ref + J# w e + (1 - J# J) w' (q_ref - q), with the bandwidths w and w', as ComputedTorque does: at that of the reference
// alone, errors of damped joints would decay more slowly than by the formula.
class OperationalSpace final : public Cloneable<OperationalSpace> {
public:
    OperationalSpace(const Model& model, const OperationalSpaceGains& gains) : Cloneable(model->n()), gains_(gains), task_(model, 6) {}

    void torque(const State& state, const Setpoint& setpoint, Result tau) noexcept override {
        const Vector v_ref = setpoint.v_tick;
        task_.measure(state.q, setpoint.q);
        for (size_t i = 0; i < tau.size(); ++i) {
            v_damped_[i] = std::sqrt(gains_.posture_stiffness) * (setpoint.q[i] - state.q[i]);
            posture_[i] = gains_.posture_stiffness * (setpoint.q[i] - state.q[i]) + gains_.posture_damping * (v_ref[i] - state.v[i]);
        }
        Vector6 motion{};
        for (size_t k = 0; k < 6; ++k) {
            motion[k] = gains_.stiffness * task_.error[k] + gains_.damping * task_.error_rate(k, v_ref, state.v);
        }
        Vector6 speed{};
        for (size_t k = 0; k < 6; ++k) { speed[k] = std::sqrt(gains_.stiffness) * task_.error[k]; }
        task_.add_task_motion(speed, v_damped_);
        for (size_t i = 0; i < tau.size(); ++i) { v_damped_[i] += v_ref[i]; }
        task_.torque(state, setpoint.a_tick, motion, posture_, v_damped_, v_ref, tau);
    }

private:
    OperationalSpaceGains gains_;
    TaskSpace task_;
    Numbers posture_ = zeros();   // acceleration
    Numbers v_damped_ = zeros();  // at which the damping of the joints is compensated
};

}  // namespace armctl
