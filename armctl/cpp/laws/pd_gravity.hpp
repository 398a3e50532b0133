// PD with gravity compensation: gravity from the model, everything else from feedback.
//
// Source: Takegaki, Arimoto, "A new feedback method for dynamic control of manipulators" (1981).
#pragma once
#include "../dynamics.hpp"
#include "pd.hpp"

namespace armctl {

// tau = g(q) + stiffness (q_ref - q) + damping (v_ref - v)
class PDGravity final : public Law {
public:
    PDGravity(std::shared_ptr<const ArmModel> model, PDGains gains);

    size_t joints() const override { return feedback_.joints(); }
    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

private:
    PD feedback_;
    Dynamics dynamics_;
    std::vector<double> gravity_;  // (n,) N m
};

}  // namespace armctl
