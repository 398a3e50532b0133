// Computed torque: the model's inverse dynamics turn every joint into a unit mass, which a PD law controls.
//
// Source: Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control (2009), 8.5.2.
#pragma once
#include "../dynamics.hpp"
#include "motion_estimate.hpp"

namespace armctl {

// tau = ID(q, v, a_ref + stiffness (q_ref - q) + damping (v_ref - v)), at measured or estimated q and v
//
// The textbook form inverts the differential equation, with a model of continuous time. The other form inverts the motion over
// one control period, with the model of that period and a reference that is differenced on the tick grid.
class ComputedTorque : public Cloneable<ComputedTorque> {
public:
    // The gains are the members below and those of EstimateWeights; without weights, q and v are the measured ones.
    ComputedTorque(const Model& model, const Arguments& gains) : ComputedTorque(model, gains, EstimateWeights(gains)) {}

    void torque(const State& measured, const Setpoint& setpoint, Result tau) override {
        const State state = estimated(measured);
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
        if (is_estimated()) { predict(tau); }
    }

    // Of the last tick, (n,): the acceleration of the feedback, and the torque of the added inertia and of the damping, which
    // inverse dynamics does not contain.
    Vector correction() const { return correction_; }
    Vector added_torque() const { return added_torque_; }

protected:
    // The memory: whether there was a tick, then the estimate, and further numbers for a derived law.
    ComputedTorque(const Model& model, const Arguments& gains, const EstimateWeights& weights, size_t further_memory = 0)
        : Cloneable(model->n(), estimate_size(model->n(), weights) + further_memory), estimate_size_(estimate_size(model->n(), weights)),
          stiffness_(gains.number("stiffness")), damping_(gains.number("damping")),
          added_inertia_(gains.numbers(joints(), "added_inertia")), weights_(weights),
          torque_limit_(gains.numbers(joints(), "torque_limit")), textbook_(gains.flag("textbook")), dynamics_(model) {}

    // Finds the acceleration of the feedback.
    virtual void correct([[maybe_unused]] Vector q_ref) {
        for (size_t i = 0; i < joints(); ++i) { correction_[i] = stiffness_ * error_[i] + damping_ * error_rate_[i]; }
    }

    Vector torque_limit() const { return torque_limit_; }  // (n,) N m, of the motors
    Result further_memory() { return memory().subspan(estimate_size_); }

    Numbers error_ = zeros(), error_rate_ = zeros();  // of the last tick
    Numbers correction_ = zeros();

private:
    static size_t estimate_size(size_t n, const EstimateWeights& weights) {
        return weights.position > 0.0 && weights.dt > 0.0 ? 1 + 3 * n : 0;
    }
    bool is_estimated() const { return estimate_size_ > 0; }
    MotionEstimate estimate() {
        const size_t n = joints();
        return {memory(1, n), memory(1 + n, n), memory(1 + 2 * n, n)};
    }

    // The state with estimated position and velocity.
    State estimated(const State& state) {
        if (!is_estimated()) { return state; }
        if (memory()[0] == 0.0) {
            estimate().begin(state);
            memory()[0] = 1.0;
        } else {
            estimate().correct(state.q, weights_);
        }
        return {.q = estimate().position, .v = estimate().velocity, .wrench = state.wrench};
    }

    // The acceleration of the coming period: the commanded one, and that of added torques and of what the motors cut off.
    void predict(Vector tau) {
        const Result acceleration = estimate().acceleration;
        for (size_t i = 0; i < tau.size(); ++i) {
            further_acceleration_[i] = added_torque_[i] + clipped(tau[i], torque_limit_[i]) - tau[i];
        }
        dynamics_.mass_matrix(inertia_);
        dynamics_.add_step_inertia(inertia_);
        factorize(inertia_);
        solve(inertia_, further_acceleration_);
        for (size_t i = 0; i < tau.size(); ++i) { acceleration[i] = acceleration_[i] + further_acceleration_[i]; }
    }

    size_t estimate_size_;
    double stiffness_;       // 1/s^2
    double damping_;         // 1/s
    Numbers added_inertia_;  // (n,) kg m^2, with which the feedback of joints of negligible inertia acts
    EstimateWeights weights_;
    Numbers torque_limit_;  // (n,) N m, of the motors, for the estimate
    bool textbook_;
    Dynamics dynamics_;
    Numbers acceleration_ = zeros(), added_torque_ = zeros();
    Numbers further_acceleration_ = zeros();
    DenseMatrix inertia_{joints(), joints()};
};

}  // namespace armctl
