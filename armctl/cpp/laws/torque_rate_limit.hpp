// Limits of how fast the torques of another law change.
#pragma once
#include "../law.hpp"

namespace armctl {

// The first torque of a run is not limited.
class TorqueRateLimit final : public Law {
public:
    // The limited law is shared with its owner, who sees its memory.
    TorqueRateLimit(std::shared_ptr<Law> limited, const Arguments& gains)
        : Law(limited->joints(), 1 + limited->joints() + limited->memory().size(), limited->needs_wrench()), limited_(std::move(limited)),
          max_change_(gains.limits(joints(), "tau_rate_max")) {
        const double dt = gains.gain("dt");
        for (double& change : max_change_) { change *= dt; }
    }

    TorqueRateLimit(const TorqueRateLimit& other) : Law(other), limited_(other.limited_->clone()), max_change_(other.max_change_) {}

    void set_memory(Vector numbers) override {
        Law::set_memory(numbers);
        limited_->set_memory(memory_of_limited());
    }

    void torque(const State& state, const Setpoint& setpoint, Result tau) override {
        copy(memory_of_limited(), limited_->memory());
        limited_->torque(state, setpoint, tau);
        copy(limited_->memory(), memory_of_limited());
        const bool is_first = memory()[0] == 0.0;
        const Result last = memory(1, joints());
        for (size_t i = 0; i < tau.size(); ++i) {
            if (!is_first) {
                if (tau[i] > last[i] + max_change_[i]) {
                    tau[i] = last[i] + max_change_[i];
                } else if (tau[i] < last[i] - max_change_[i]) {
                    tau[i] = last[i] - max_change_[i];
                }
            }
            last[i] = tau[i];
        }
        memory()[0] = 1.0;
    }

    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

private:
    // The memory of a law is one vector: whether there was a tick, the last torque, and that of the limited law, which gets it in
    // each tick.
    Result memory_of_limited() { return memory().subspan(1 + joints()); }

    std::shared_ptr<Law> limited_;
    Numbers max_change_;  // (n,) N m, in one control period
};

}  // namespace armctl
