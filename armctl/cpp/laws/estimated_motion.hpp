// What laws share that feed back the motion of the joints, measured or estimated.
#pragma once
#include "../dynamics.hpp"
#include "../law.hpp"

namespace armctl {

// The commanded acceleration predicts position and velocity, and the measured position corrects both.
//
// Source: Friedland, Control System Design (1986), chapter 8.
class EstimatedMotion : public Law {
protected:
    // The memory: whether there was a tick and the estimate, if there is one, and further numbers for a derived law.
    EstimatedMotion(const Model& model, const Arguments& gains, bool has_estimate, size_t further_memory)
        : Law(model->n(), estimate_size(has_estimate, model->n()) + further_memory), has_estimate_(has_estimate), dynamics_(model),
          dt_(gains.number("dt")), stiffness_(gains.number("stiffness")), damping_(gains.number("damping")),
          tau_max_(gains.numbers(joints(), "torque_limit")), position_weight_(gains.number("position_weight")),
          velocity_weight_(gains.number("velocity_weight")), position_step_(gains.flag("continuous") ? 0.5 : 1.0) {}

    bool has_begun() { return memory()[0] != 0.0; }

    // (n,) each, estimated. The acceleration is the one commanded at the last tick; after `estimate` the mean one since then.
    Result position() { return memory(1, joints()); }
    Result velocity() { return memory(1 + joints(), joints()); }
    Result acceleration() { return memory(1 + 2 * joints(), joints()); }

    Result further_memory() { return memory().subspan(estimate_size(has_estimate_, joints())); }

    // Estimates the motion at this tick. The velocity is measured at the first tick only, because it is noisy where it is
    // differenced from positions.
    void estimate(const State& state) {
        if (!has_begun()) {
            copy(state.q, position());
            copy(state.v, velocity());
            memory()[0] = 1.0;
            return;
        }
        for (size_t i = 0; i < joints(); ++i) {
            const double predicted = position()[i] + dt_ * velocity()[i] + position_step_ * dt_ * dt_ * acceleration()[i];
            const double error = state.q[i] - predicted;
            position()[i] = predicted + position_weight_ * error;
            acceleration()[i] += velocity_weight_ * error / (dt_ * dt_);
            velocity()[i] += dt_ * acceleration()[i];
        }
    }

    bool has_estimate_;
    Dynamics dynamics_;
    double dt_;         // s, the period
    double stiffness_;  // 1/s^2
    double damping_;    // 1/s
    Numbers tau_max_;   // (n,) N m, of the motors

private:
    static size_t estimate_size(bool has_estimate, size_t n) { return has_estimate ? 1 + 3 * n : 0; }

    double position_weight_;  // of the error of the predicted position
    double velocity_weight_;  // of the error / period
    // Change of position / (acceleration x dt^2) in a period from rest: 1 if the period is a step of MuJoCo, whose last velocity
    // moves the joint; 1/2 if the arm moves continuously.
    double position_step_;
};

}  // namespace armctl
