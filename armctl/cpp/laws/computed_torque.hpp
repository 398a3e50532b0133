// Computed torque: the model's inverse dynamics turn every joint into a unit mass, which a PD law controls.
//
// Source: Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control (2009), 8.5.2.
#pragma once
#include "../dynamics.hpp"
#include "motion_estimate.hpp"

namespace armctl {

struct ComputedTorqueGains {
    double stiffness = 0.0;   // 1/s^2
    double damping = 0.0;     // 1/s
    Numbers added_damping;    // (n,) N m s/rad
    double decay_rate = 0.0;  // 1/s
    bool textbook = false;
    Numbers torque_limit;    // (n,) N m, of the motors
    EstimateGains estimate;  // without a weight of the position, q and v are the measured ones

    bool has_estimate() const { return estimate.position_weight > 0.0 && estimate.dt > 0.0; }

    // Numbers of a law's memory.
    size_t memory_size(size_t n) const { return has_estimate() ? MotionEstimate::memory_size(n) : 0; }
};

// tau = ID(q, v, a_ref + stiffness e + damping e_dot) + (D + added_damping) (e_dot + decay_rate e), at measured or estimated q, v
//
// The textbook form is the first term alone. It inverts the differential equation, with a model of continuous time. The other form
// inverts the motion over one control period, with the model of that period and a reference that is differenced on the tick grid.
//
// D, the linear damping of the joints, is thus compensated at the velocity v_ref + decay_rate e, and helps the feedback: compensated
// at a measured velocity, which is late, large damping would be a large positive feedback. With the bandwidth w of the feedback as
// decay_rate, no error decays more slowly than without the second term: M (s^2 + 2 z w s + w^2) + (D + added_damping) (s + w) has,
// for any z, the slowest root of the first factor or a faster one, and for z = 1 the root -w.
//
// The formula in two steps, as a part of laws that replace the feedback or what follows.
class InverseDynamicsControl {
public:
    InverseDynamicsControl(const Model& model, ComputedTorqueGains gains)
        : error(model->n()), error_rate(error), correction(error), added_torque(error), gains_(std::move(gains)), dynamics_(model),
          acceleration_(error), further_acceleration_(error), commanded_(error), applied_(error) {
        require_size(gains_.torque_limit, model->n(), "torque_limit");
        require_size(gains_.added_damping, model->n(), "added_damping");
        for (size_t i = 0; i < model->n(); ++i) { gains_.added_damping[i] += model->drives[i].damping.linear; }
    }

    const ComputedTorqueGains& gains() const { return gains_; }

    // Finds the errors and the acceleration of the feedback. `memory` is that of the law. Returns the state that is fed back, which is
    // valid until the next call.
    State feed_back(const State& measured, const Setpoint& setpoint, Result memory) {
        State state = measured;
        if (gains_.has_estimate()) {
            MotionEstimate estimate(memory, error.size());
            estimate.update(measured, gains_.estimate);
            state = {.q = estimate.position, .v = estimate.velocity, .wrench = {}};
        }
        const Vector v_ref = velocity(setpoint);
        for (size_t i = 0; i < error.size(); ++i) {
            error[i] = setpoint.q[i] - state.q[i];
            error_rate[i] = v_ref[i] - state.v[i];
            correction[i] = gains_.stiffness * error[i] + gains_.damping * error_rate[i];
        }
        return state;
    }

    // The torque (n,) N m at the state that `feed_back` returned, with the errors and the correction that are there now.
    void torque(const State& state, const Setpoint& setpoint, Result memory, Result tau) {
        const Vector v_ref = velocity(setpoint);
        const Vector a_ref = gains_.textbook ? setpoint.a : setpoint.a_tick;
        for (size_t i = 0; i < tau.size(); ++i) {
            acceleration_[i] = a_ref[i] + correction[i];
            added_torque[i] = gains_.textbook ? 0.0 : gains_.added_damping[i] * (error_rate[i] + gains_.decay_rate * error[i]);
        }
        dynamics_.inverse_dynamics(state.q, state.v, acceleration_, tau);
        for (size_t i = 0; i < tau.size(); ++i) { tau[i] += added_torque[i]; }
        dynamics_.add_friction(v_ref, a_ref, tau);
        if (!gains_.has_estimate()) { return; }
        for (size_t i = 0; i < tau.size(); ++i) {
            commanded_[i] = tau[i];
            applied_[i] = clipped(tau[i], gains_.torque_limit[i]);
        }
        take_applied(applied_, memory);
    }

    // Estimates the acceleration of the coming period: the commanded one, and that of added torques and of what the motors, which
    // got tau, cut off.
    void take_applied(Vector tau, Result memory) {
        if (!gains_.has_estimate()) { return; }
        const MotionEstimate estimate(memory, error.size());
        for (size_t i = 0; i < tau.size(); ++i) { further_acceleration_[i] = added_torque[i] + tau[i] - commanded_[i]; }
        dynamics_.accelerate(further_acceleration_);
        for (size_t i = 0; i < tau.size(); ++i) { estimate.acceleration[i] = acceleration_[i] + further_acceleration_[i]; }
    }

    // Of the last tick, (n,) each.
    Numbers error;
    Numbers error_rate;
    Numbers correction;    // the acceleration of the feedback
    Numbers added_torque;  // of the second term, which inverse dynamics does not contain

private:
    Vector velocity(const Setpoint& setpoint) const { return gains_.textbook ? setpoint.v : setpoint.v_tick; }

    ComputedTorqueGains gains_;  // `added_damping` with the linear damping of the joints
    Dynamics dynamics_;

    Numbers acceleration_, further_acceleration_;
    Numbers commanded_, applied_;  // torques
};

class ComputedTorque final : public Cloneable<ComputedTorque> {
public:
    ComputedTorque(const Model& model, ComputedTorqueGains gains)
        : Cloneable(model->n(), gains.memory_size(model->n())), control_(model, std::move(gains)) {}

    void torque(const State& measured, const Setpoint& setpoint, Result tau) noexcept override {
        const State state = control_.feed_back(measured, setpoint, memory());
        control_.torque(state, setpoint, memory(), tau);
    }

    void applied(Vector tau) noexcept override { control_.take_applied(tau, memory()); }

private:
    InverseDynamicsControl control_;
};

}  // namespace armctl
