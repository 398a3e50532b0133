// Computed torque: the model's inverse dynamics turn every joint into a unit mass, which a PD law controls.
//
// Source: Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control (2009), 8.5.2.
#pragma once
#include "estimated_motion.hpp"

namespace armctl {

// tau = ID(q, v, a_ref + stiffness e + damping e_dot) + (D + added_damping) (e_dot + decay_rate e), at measured or estimated q, v
//
// The textbook form is the first term alone. It inverts the differential equation, with a model of continuous time. The other form
// inverts the motion over one control period, with the model of that period and a reference that is differenced on the tick grid.
//
// D, the linear damping of the joints, is thus compensated at the velocity v_ref + decay_rate e, and helps the feedback: compensated
// at a measured velocity, which is late, large damping would be a large positive feedback. With the bandwidth w of the feedback as
// decay_rate, no error decays more slowly than without the second term: M (s^2 + 2 z w s + w^2) + (D + added_damping) (s + w) has,
// for any z, the slowest root of the first factor or a faster one, and for z = 1 the root -w.
class ComputedTorque : public Cloneable<ComputedTorque, EstimatedMotion> {
public:
    // The gains are the members and those of EstimatedMotion; without a weight of the position, q and v are the measured ones.
    ComputedTorque(const Model& model, const Arguments& gains, size_t further_memory = 0)
        : Cloneable(model, gains, gains.number("position_weight") > 0.0 && gains.number("dt") > 0.0, further_memory),
          added_damping_(gains.numbers(joints(), "added_damping")), decay_rate_(gains.number("decay_rate")),
          textbook_(gains.flag("textbook")) {
        for (size_t i = 0; i < joints(); ++i) { added_damping_[i] += model->drives[i].damping.linear; }
    }

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
            added_torque_[i] = textbook_ ? 0.0 : added_damping_[i] * (error_rate_[i] + decay_rate_ * error_[i]);
        }
        dynamics_.inverse_dynamics(state.q, state.v, acceleration_, tau);
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
    Numbers added_torque_ = zeros();  // of the second term, which inverse dynamics does not contain

private:
    // The acceleration of the coming period: the commanded one, and that of added torques and of what the motors cut off.
    void predict(Vector tau) {
        for (size_t i = 0; i < tau.size(); ++i) { further_acceleration_[i] = added_torque_[i] + clipped(tau[i], tau_max_[i]) - tau[i]; }
        dynamics_.accelerate(further_acceleration_);
        for (size_t i = 0; i < tau.size(); ++i) { acceleration()[i] = acceleration_[i] + further_acceleration_[i]; }
    }

    Numbers added_damping_;  // (n,) N m s/rad, with the linear damping of the joints
    double decay_rate_;      // 1/s
    bool textbook_;
    Numbers acceleration_ = zeros(), further_acceleration_ = zeros();
};

}  // namespace armctl
