// Position and velocity of the joints, predicted by the commanded acceleration and corrected by the measured position.
//
// Source: Friedland, Control System Design (1986), chapter 8.
#pragma once
#include "../law.hpp"

namespace armctl {

// How much the error of the predicted position corrects the estimate.
struct EstimateWeights {
    explicit EstimateWeights(const Arguments& gains)
        : position(gains.number("position_weight")), velocity(gains.number("velocity_weight")), dt(gains.number("dt")),
          position_step(gains.flag("continuous") ? 0.5 : 1.0) {}

    double position;
    double velocity;  // of the error / period
    double dt;        // s, the period
    // Change of position / (acceleration x dt^2) in a period from rest: 1 if the period is a step of MuJoCo, whose last velocity
    // moves the joint; 1/2 if the arm moves continuously.
    double position_step;
};

// (n,) each; a part of a law's memory.
struct MotionEstimate {
    Result position;
    Result velocity;
    Result acceleration;  // commanded at the last tick; after `correct` the mean one since then

    void begin(const State& state) const {
        copy(state.q, position);
        copy(state.v, velocity);
    }

    // One period later.
    void correct(Vector measured, const EstimateWeights& weights) const {
        const double dt = weights.dt;
        for (size_t i = 0; i < position.size(); ++i) {
            const double predicted = position[i] + dt * velocity[i] + weights.position_step * dt * dt * acceleration[i];
            const double error = measured[i] - predicted;
            position[i] = predicted + weights.position * error;
            acceleration[i] += weights.velocity * error / (dt * dt);
            velocity[i] += dt * acceleration[i];
        }
    }
};

}  // namespace armctl
