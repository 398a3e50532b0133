// Position and velocity of the joints, predicted by the commanded acceleration and corrected by the measured position.
//
// Source: Friedland, Control System Design (1986), chapter 8.
#pragma once
#include "../law.hpp"

namespace armctl {

// How much the error of the predicted position corrects the estimate.
struct EstimateWeights {
    double position = 0.0;
    double velocity = 0.0;  // of the error / period
};

// (n,) each; a part of a law's memory.
struct MotionEstimate {
    Result position;
    Result velocity;
    Result acceleration;  // commanded at the last tick; after `correct` the mean one since then

    void begin(const State& state) const {
        std::ranges::copy(state.q, position.begin());
        std::ranges::copy(state.v, velocity.begin());
    }

    // One period dt later. `position_step` is the change of position / (acceleration x dt^2) in a period from rest.
    void correct(Vector measured, EstimateWeights weights, double dt, double position_step) const {
        for (size_t i = 0; i < position.size(); ++i) {
            const double predicted = position[i] + dt * velocity[i] + position_step * dt * dt * acceleration[i];
            const double error = measured[i] - predicted;
            position[i] = predicted + weights.position * error;
            acceleration[i] += weights.velocity * error / (dt * dt);
            velocity[i] += dt * acceleration[i];
        }
    }
};

// 1 if the period is a step of MuJoCo, whose last velocity moves the joint; 1/2 if the arm moves continuously.
inline double position_step(bool continuous) { return continuous ? 0.5 : 1.0; }

}  // namespace armctl
