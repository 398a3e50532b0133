#include "pd_gravity.hpp"

#include <utility>

namespace armctl {

PDGravity::PDGravity(std::shared_ptr<const ArmModel> model, PDGains gains)
    : feedback_(checked(std::move(gains), model->n())), dynamics_(model), gravity_(model->n()) {}

void PDGravity::torque(const State& state, const Setpoint& setpoint, Result tau) {
    dynamics_.gravity(state.q, gravity_);
    feedback_.torque(state, setpoint, tau);
    for (size_t i = 0; i < tau.size(); ++i) { tau[i] += gravity_[i]; }
}

}  // namespace armctl
