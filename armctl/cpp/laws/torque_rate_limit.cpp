#include "torque_rate_limit.hpp"

#include <utility>

namespace armctl {

TorqueRateLimit::TorqueRateLimit(std::shared_ptr<Law> limited, std::vector<double> max_rate, double dt)
    : LawAround(limited, 1 + limited->joints()), max_change_(checked_limits(std::move(max_rate), limited->joints(), "tau_rate_max")) {
    checked_period(dt);
    for (double& change : max_change_) { change *= dt; }
}

void TorqueRateLimit::torque(const State& state, const Setpoint& setpoint, Result tau) {
    inner_torque(state, setpoint, tau);
    double& has_last_torque = own_memory()[0];
    const Result last = own_memory().subspan(1);
    for (size_t i = 0; i < tau.size(); ++i) {
        if (has_last_torque != 0.0) {
            if (tau[i] > last[i] + max_change_[i]) {
                tau[i] = last[i] + max_change_[i];
            } else if (tau[i] < last[i] - max_change_[i]) {
                tau[i] = last[i] - max_change_[i];
            }
        }
        last[i] = tau[i];
    }
    has_last_torque = 1.0;
}

}  // namespace armctl
