#include "torque_rate_limit.hpp"

#include <algorithm>
#include <utility>

namespace armctl {

TorqueRateLimit::TorqueRateLimit(std::shared_ptr<Law> limited, std::vector<double> max_rate, double dt)
    : limited_(std::move(limited)), max_change_(checked_limits(std::move(max_rate), limited_->joints(), "tau_rate_max")),
      memory_(1 + limited_->joints() + limited_->memory().size()) {
    checked_period(dt);
    for (double& change : max_change_) { change *= dt; }
}

TorqueRateLimit::TorqueRateLimit(const TorqueRateLimit& other)
    : limited_(other.limited_->clone()), max_change_(other.max_change_), memory_(other.memory_) {}

void TorqueRateLimit::set_memory(Vector numbers) {
    std::ranges::copy(numbers, memory_.begin());
    limited_->set_memory(memory_of_limited());
}

void TorqueRateLimit::torque(const State& state, const Setpoint& setpoint, Result tau) {
    std::ranges::copy(memory_of_limited(), limited_->memory().begin());
    limited_->torque(state, setpoint, tau);
    std::ranges::copy(limited_->memory(), memory_of_limited().begin());
    const Result last = last_torque();
    for (size_t i = 0; i < tau.size(); ++i) {
        if (has_last_torque() != 0.0) {
            if (tau[i] > last[i] + max_change_[i]) {
                tau[i] = last[i] + max_change_[i];
            } else if (tau[i] < last[i] - max_change_[i]) {
                tau[i] = last[i] - max_change_[i];
            }
        }
        last[i] = tau[i];
    }
    has_last_torque() = 1.0;
}

}  // namespace armctl
