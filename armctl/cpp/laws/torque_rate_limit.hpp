// Limits of how fast the torques of another law change.
#pragma once
#include "law_around.hpp"

namespace armctl {

// The first torque of a run is not limited.
class TorqueRateLimit final : public LawAround {
public:
    // `max_rate` (n,) N m/s.
    TorqueRateLimit(std::shared_ptr<Law> limited, std::vector<double> max_rate, double dt);

    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

private:
    std::vector<double> max_change_;  // (n,) N m, in one control period
};

}  // namespace armctl
