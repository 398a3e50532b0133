// Computed torque: the model's inverse dynamics turn every joint into a unit mass, which a PD law controls.
//
// Source: Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control (2009), 8.5.2.
#pragma once
#include "estimated_motion.hpp"

namespace armctl {

// tau = ID(q, v, a_ref + stiffness (q_ref - q) + damping (v_ref - v)), at measured or estimated q and v
//
// The textbook form inverts the differential equation, with a model of continuous time. The other form inverts the motion over
// one control period, with the model of that period and a reference that is differenced on the tick grid.
class ComputedTorque : public Cloneable<ComputedTorque, EstimatedMotion> {
public:
    // The gains are the members and those of EstimatedMotion; without a weight of the position, q and v are the measured ones.
    ComputedTorque(const Model& model, const Arguments& gains, size_t further_memory = 0)
        : Cloneable(model, gains, gains.number("position_weight") > 0.0 && gains.number("dt") > 0.0, further_memory),
          added_inertia_(gains.numbers(joints(), "added_inertia")), textbook_(gains.flag("textbook")) {}

    void torque(const State& measured, const Setpoint& setpoint, Result tau) override {
        State state = measured;
        if (has_estimate_) {
            estimate(measured);
            state = {.q = position(), .v = velocity(), .wrench = {}};
        }
        const Vector v_ref = textbook_ ? setpoint.v : setpoint.v_tick;
        const Vector a_ref = textbook_ ? setpoint.a : setpoint.a_tick;
        for (size_t i = 0; i < tau.size(); ++i) {
            error_[i] = setpoint.q[i] - state.q[i];
            error_rate_[i] = v_ref[i] - state.v[i];
        }
        correct(setpoint.q);
        for (size_t i = 0; i < tau.size(); ++i) {
            acceleration_[i] = a_ref[i] + correction_[i];
            added_torque_[i] = added_inertia_[i] * correction_[i];
        }
        dynamics_.inverse_dynamics(state.q, state.v, acceleration_, tau);
        // Damping is compensated at the velocity of the reference: the arm's own damping then helps the feedback. Compensated at
        // the measured velocity, large damping would be a large positive feedback.
        dynamics_.add_linear_damping(error_rate_, added_torque_);
        for (size_t i = 0; i < tau.size(); ++i) { tau[i] += added_torque_[i]; }
        dynamics_.add_friction(v_ref, a_ref, tau);
        if (has_estimate_) { predict(tau); }
    }

protected:
    // Finds the acceleration of the feedback.
    virtual void correct([[maybe_unused]] Vector q_ref) {
        for (size_t i = 0; i < joints(); ++i) { correction_[i] = stiffness_ * error_[i] + damping_ * error_rate_[i]; }
    }

    // Of the last tick.
    Numbers error_ = zeros(), error_rate_ = zeros();
    Numbers correction_ = zeros();    // the acceleration of the feedback
    Numbers added_torque_ = zeros();  // of the added inertia and of the damping, which inverse dynamics does not contain

private:
    // The acceleration of the coming period: the commanded one, and that of added torques and of what the motors cut off.
    void predict(Vector tau) {
        for (size_t i = 0; i < tau.size(); ++i) { further_acceleration_[i] = added_torque_[i] + clipped(tau[i], tau_max_[i]) - tau[i]; }
        dynamics_.accelerate(further_acceleration_);
        for (size_t i = 0; i < tau.size(); ++i) { acceleration()[i] = acceleration_[i] + further_acceleration_[i]; }
    }

    Numbers added_inertia_;  // (n,) kg m^2, with which the feedback of joints of negligible inertia acts
    bool textbook_;
    Numbers acceleration_ = zeros(), further_acceleration_ = zeros();
};

}  // namespace armctl
