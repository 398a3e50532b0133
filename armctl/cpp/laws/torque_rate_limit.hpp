// Limits of how fast the torques of another law change.
#pragma once
#include "../law.hpp"

namespace armctl {

// The first torque of a run is not limited.
class TorqueRateLimit final : public Law {
public:
    // `max_rate` (n,) N m/s. The limited law is shared with its owner, who sees its memory.
    TorqueRateLimit(std::shared_ptr<Law> limited, std::vector<double> max_rate, double dt);
    TorqueRateLimit(const TorqueRateLimit& other);

    size_t joints() const override { return limited_->joints(); }
    bool needs_wrench() const override { return limited_->needs_wrench(); }
    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::span<double> memory() override { return memory_; }
    void set_memory(Vector numbers) override;
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

private:
    double& has_last_torque() { return memory_[0]; }
    Result last_torque() { return std::span(memory_).subspan(1, joints()); }
    Result memory_of_limited() { return std::span(memory_).subspan(1 + joints()); }

    std::shared_ptr<Law> limited_;
    std::vector<double> max_change_;  // (n,) N m, in one control period
    // The memory of a law is one vector, so it contains that of the limited law, which gets it in each tick.
    std::vector<double> memory_;
};

}  // namespace armctl
