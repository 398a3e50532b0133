#include "pd_feedforward.hpp"

#include <utility>

namespace armctl {

PDFeedforward::PDFeedforward(std::shared_ptr<const ArmModel> model, PDGains gains)
    : gains_(checked(std::move(gains), model->n())), dynamics_(std::move(model)) {}

void PDFeedforward::torque(const State& state, const Setpoint& setpoint, Result tau) {
    const Vector v_ref = setpoint.v_tick;
    const Vector a_ref = setpoint.a_tick;
    dynamics_.inverse_dynamics(setpoint.q, v_ref, a_ref, tau);
    dynamics_.add_friction(v_ref, a_ref, tau);
    for (size_t i = 0; i < tau.size(); ++i) {
        tau[i] += gains_.stiffness[i] * (setpoint.q[i] - state.q[i]) + gains_.damping[i] * (v_ref[i] - state.v[i]);
    }
}

}  // namespace armctl
