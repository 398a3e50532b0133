// A law whose torques change at limited rates, such as those of a robot's interface.
#pragma once
#include "law_around.hpp"

namespace armctl {

// The first torque of a run is not limited.
class TorqueRateLimit final : public Cloneable<TorqueRateLimit, LawAround> {
public:
    TorqueRateLimit(const std::shared_ptr<Law>& limited, const Arguments& gains)
        : Cloneable(limited, limited->joints()), max_change_(gains.numbers(joints(), "tau_rate_max")) {
        const double dt = gains.number("dt");
        for (double& change : max_change_) { change *= dt; }
    }

    void torque(const State& state, const Setpoint& setpoint, Result tau) override {
        const bool is_first = inner_torque(state, setpoint, tau);
        const Result last = own_memory();
        for (size_t i = 0; i < tau.size(); ++i) {
            if (!is_first) { tau[i] = std::clamp(tau[i], last[i] - max_change_[i], last[i] + max_change_[i]); }
            last[i] = tau[i];
        }
    }

private:
    Numbers max_change_;  // (n,) N m, in one control period
};

}  // namespace armctl
