// PD with dynamic feedforward: the torque of the reference motion from the model, and PD feedback.
#pragma once
#include "../dynamics.hpp"
#include "pd.hpp"

namespace armctl {

// tau = ID(q_ref, v_ref, a_ref) + stiffness (q_ref - q) + damping (v_ref - v)
class PDFeedforward final : public Law {
public:
    PDFeedforward(std::shared_ptr<const ArmModel> model, PDGains gains);

    size_t joints() const override { return gains_.joints(); }
    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

private:
    PDGains gains_;
    Dynamics dynamics_;
};

}  // namespace armctl
