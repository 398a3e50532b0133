// The contact transition of a force axis: approach, contact, and back if the contact is lost.
#pragma once
#include "../spans.hpp"

namespace armctl {

// What a force axis keeps from tick to tick, as numbers of the memory of a law.
struct AxisMemory {
    static constexpr size_t size = 10;

    explicit AxisMemory(std::span<double> numbers)
        : touches(numbers[0]), measured(numbers[1]), commanded(numbers[2]), integral(numbers[3]), lost_time(numbers[4]),
          yielding(numbers[5]), steady_speed(numbers[6]), first_force(numbers[7]), depth(numbers[8]), fluidity(numbers[9]) {}

    double& touches;       // 1 in contact, else 0
    double& measured;      // N, filtered
    double& commanded;     // N
    double& integral;      // of the error of the force, N, in contact; of that of the speed, m, before
    double& lost_time;     // s, for which there was hardly any force
    double& yielding;      // m/s
    double& steady_speed;  // m/s
    double& first_force;   // N, at which the depth begins; 0 before
    double& depth;         // m, travelled since
    double& fluidity;      // m/(N s), the largest speed per force since, an upper bound for that of the wall's own damping
};

struct AxisCommand {
    double force = 0.0;           // N
    double acceleration = 0.0;    // m/s^2 that damps or approaches
    double speed = 0.0;           // m/s of the approach, or that lasts in contact: joint damping and friction are compensated at it
    double yielding_speed = 0.0;  // m/s in contact at which dry friction is compensated
};

// One axis at one tick.
struct AxisTick {
    double target = 0.0;          // N
    double measured = 0.0;        // N, that the tip exerts
    double speed = 0.0;           // m/s of the tip
    double mass = 0.0;            // kg, effective, of a tip that moves along the axis only
    double approach_speed = 0.0;  // m/s
    double threshold = 0.0;       // N, above which there is contact
    double dt = 0.0;              // s, control period
};

// The command of a force axis.
AxisCommand command_axis(const AxisTick& tick, AxisMemory axis);

// The weight of a new sample in a low-pass of first order, of a rate in 1/s.
double low_pass_weight(double rate, double dt);

}  // namespace armctl
