// The estimated motion of the joints, from measured positions and commanded accelerations.
#pragma once
#include "../law.hpp"

namespace armctl {

struct EstimateGains {
    double position_weight = 0.0;  // of the error of the predicted position
    double velocity_weight = 0.0;  // of the error / period
    double dt = 0.0;               // s, the period
    bool continuous = false;       // whether the arm moves continuously; if not, the period is a step of MuJoCo
};

// The commanded acceleration predicts position and velocity, and the measured position corrects both.
//
// Source: Friedland, Control System Design (1986), chapter 8.
class MotionEstimate {
public:
    // Numbers of a law's memory for an arm of n joints, in which an estimate is.
    static size_t memory_size(size_t n) { return 1 + 3 * n; }

    // Of the memory of a law with as many numbers or more.
    MotionEstimate(Result memory, size_t n)
        : position(memory.subspan(1, n)), velocity(memory.subspan(1 + n, n)), acceleration(memory.subspan(1 + 2 * n, n)),
          has_begun_(memory[0]) {}

    bool has_begun() const { return has_begun_ != 0.0; }

    // Estimates the motion at this tick. The velocity is measured at the first tick only, because it is noisy where it is
    // differenced from positions.
    void update(const State& state, const EstimateGains& gains) {
        if (!has_begun()) {
            copy(state.q, position);
            copy(state.v, velocity);
            has_begun_ = 1.0;
            return;
        }
        // Change of position / (acceleration x dt^2) in a period from rest: 1 if the period is a step of MuJoCo, whose last velocity
        // moves the joint; 1/2 if the arm moves continuously.
        const double position_step = gains.continuous ? 0.5 : 1.0;
        const double dt = gains.dt;
        for (size_t i = 0; i < position.size(); ++i) {
            const double predicted = position[i] + dt * velocity[i] + position_step * dt * dt * acceleration[i];
            const double error = state.q[i] - predicted;
            position[i] = predicted + gains.position_weight * error;
            acceleration[i] += gains.velocity_weight * error / (dt * dt);
            velocity[i] += dt * acceleration[i];
        }
    }

    // (n,) each, estimated. The acceleration is the one commanded at the last tick; after `update` the mean one since then.
    Result position;
    Result velocity;
    Result acceleration;

private:
    double& has_begun_;
};

}  // namespace armctl
