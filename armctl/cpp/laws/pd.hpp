// PD: a spring and a damper at every joint, and no model.
#pragma once
#include "../law.hpp"

namespace armctl {

struct PDGains {
    std::vector<double> stiffness;  // (n,) N m/rad
    std::vector<double> damping;    // (n,) N m s/rad

    size_t joints() const { return stiffness.size(); }
};

// Throws InputError if a gain is negative or not finite, or if there are not n of each.
PDGains checked(PDGains gains, size_t n);

// tau = stiffness (q_ref - q) + damping (v_ref - v)
class PD final : public Law {
public:
    explicit PD(PDGains gains);

    size_t joints() const override { return gains_.joints(); }
    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

private:
    PDGains gains_;
};

}  // namespace armctl
