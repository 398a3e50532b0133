#include "pd.hpp"

#include <utility>

namespace armctl {

PDGains checked(PDGains gains, size_t n) {
    return {
        .stiffness = checked_gains(std::move(gains.stiffness), n, "stiffness"),
        .damping = checked_gains(std::move(gains.damping), n, "damping"),
    };
}

PD::PD(PDGains gains) {
    const size_t n = gains.joints();
    gains_ = checked(std::move(gains), n);
}

void PD::torque(const State& state, const Setpoint& setpoint, Result tau) {
    for (size_t i = 0; i < tau.size(); ++i) {
        tau[i] = gains_.stiffness[i] * (setpoint.q[i] - state.q[i]) + gains_.damping[i] * (setpoint.v[i] - state.v[i]);
    }
}

}  // namespace armctl
