// Operational space control: the tip's error behaves like a unit mass on a spring; a posture law acts in the null space.
#pragma once
#include "../law.hpp"
#include "task_space.hpp"

namespace armctl {

// tau = ID(q, v, a_ref + J# (k_p e + k_d e_dot) + (1 - J# J) (k_p' (q_ref - q) + k_d' (v_ref - v)))
//
// J# is the dynamically consistent inverse, damped near singular configurations.
class OperationalSpace final : public Law {
public:
    struct Gains {
        double stiffness = 0.0;          // 1/s^2, of the tip
        double damping = 0.0;            // 1/s
        double posture_stiffness = 0.0;  // 1/s^2, of the joints
        double posture_damping = 0.0;    // 1/s
    };

    OperationalSpace(std::shared_ptr<const ArmModel> model, Gains gains);

    size_t joints() const override { return dynamics_.model().n(); }
    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

private:
    Gains gains_;
    Dynamics dynamics_;
    TaskSpace task_;

    // Scratch memory.
    DenseMatrix mobility_;              // (6, 6) factors
    std::vector<double> acceleration_;  // (n,)
    std::vector<double> error_rate_;    // (n,)
    std::array<double, 6> force_{};
};

}  // namespace armctl
