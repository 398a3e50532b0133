// Computed torque: the model's inverse dynamics turn every joint into a unit mass, which a PD or PID law controls.
//
// Source: Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control (2009), 8.5.2.
#pragma once
#include "../dynamics.hpp"
#include "../law.hpp"

namespace armctl {

// tau = ID(q, v, a_ref + stiffness (q_ref - q) + damping (v_ref - v) + integral of the error)
//
// The textbook form inverts the differential equation, with a model of continuous time. The other form inverts the motion over
// one control period, with the model of that period and a reference that is differenced on the tick grid.
class ComputedTorque final : public Law {
public:
    ComputedTorque(const Model& model, const Arguments& gains)
        : Law(model->n(), model->n()), stiffness_(gains.gain("stiffness")), damping_(gains.gain("damping")),
          gain_per_tick_(gains.gain("integral_gain") * gains.gain("dt")), added_inertia_(gains.gains(model->n(), "added_inertia")),
          torque_limit_(gains.limits(model->n(), "torque_limit")), textbook_(gains.flag("textbook")), dynamics_(model) {}

    void torque(const State& state, const Setpoint& setpoint, Result tau) override {
        const Vector v_ref = textbook_ ? setpoint.v : setpoint.v_tick;
        const Vector a_ref = textbook_ ? setpoint.a : setpoint.a_tick;
        const Result integral = memory();
        for (size_t i = 0; i < tau.size(); ++i) {
            error_rate_[i] = v_ref[i] - state.v[i];
            correction_[i] = stiffness_ * (setpoint.q[i] - state.q[i]) + damping_ * error_rate_[i];
            acceleration_[i] = a_ref[i] + correction_[i] + integral[i];
            added_torque_[i] = added_inertia_[i] * correction_[i];
        }
        dynamics_.inverse_dynamics(state.q, state.v, acceleration_, tau);
        // Damping is compensated at the velocity of the reference: the arm's own damping then helps the feedback. Compensated at
        // the measured velocity, large damping would be a large positive feedback.
        dynamics_.add_linear_damping(error_rate_, added_torque_);
        for (size_t i = 0; i < tau.size(); ++i) { tau[i] += added_torque_[i]; }
        dynamics_.add_friction(v_ref, a_ref, tau);
        if (gain_per_tick_ == 0.0) { return; }
        for (size_t i = 0; i < tau.size(); ++i) {
            integrate(gain_per_tick_ * (setpoint.q[i] - state.q[i]), tau[i], torque_limit_[i], integral[i]);
        }
    }

    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

    // Of the last tick, (n,): the acceleration of the feedback without integral action, and the torque of the added inertia and
    // of the damping, which inverse dynamics does not contain.
    Vector correction() const { return correction_; }
    Vector added_torque() const { return added_torque_; }

private:
    double stiffness_;       // 1/s^2
    double damping_;         // 1/s
    double gain_per_tick_;   // 1/s^2, integral gain x control period; 0 without integral action
    Numbers added_inertia_;  // (n,) kg m^2, with which the feedback of joints of negligible inertia acts
    Numbers torque_limit_;   // (n,) N m, at which a joint stops to integrate
    bool textbook_;
    Dynamics dynamics_;
    Numbers correction_ = zeros(), acceleration_ = zeros(), error_rate_ = zeros(), added_torque_ = zeros();
};

}  // namespace armctl
