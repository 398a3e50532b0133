// What the ticks of simulations and of environments have in common: motors and measurement noise.
#pragma once
#include <cmath>
#include <span>

#include "mujoco_api.hpp"
#include "spans.hpp"

namespace armctl {

// A driven joint of a simulation: where MuJoCo's arrays have it.
struct Motor {
    size_t qpos = 0;
    size_t dof = 0;  // in qvel and qfrc_applied
    size_t ctrl = 0;
    size_t torque = 0;          // in qfrc_actuator
    double gear = 1.0;          // torque per unit of ctrl
    double torque_share = 1.0;  // torque per unit of qfrc_actuator
};

using Motors = std::span<const Motor>;

// Throws InputError if an address is not in the arrays of a simulation.
void check_addresses(Motors motors, const MujocoSimulation& simulation);

// Reads positions and velocities (n,) of the joints; returns the norm of the velocities.
inline double read_joints(Motors motors, const MujocoSimulation& simulation, Result q, Result v) {
    double squared = 0.0;
    for (size_t i = 0; i < motors.size(); ++i) {
        q[i] = simulation.qpos[motors[i].qpos];
        v[i] = simulation.qvel[motors[i].dof];
        squared += v[i] * v[i];
    }
    return std::sqrt(squared);
}

// Sets the controls of the motors to joint torques (n,) N m.
inline void command_motors(Motors motors, Vector tau, const MujocoSimulation& simulation) {
    for (size_t i = 0; i < motors.size(); ++i) { simulation.ctrl[motors[i].ctrl] = tau[i] / motors[i].gear; }
}

// The joint torques (n,) N m of the motors in the last step.
inline void read_torques(Motors motors, const MujocoSimulation& simulation, Result tau) {
    for (size_t i = 0; i < motors.size(); ++i) { tau[i] = simulation.qfrc_actuator[motors[i].torque] * motors[i].torque_share; }
}

// Noise on measured positions and velocities in some ticks; empty if there is none.
struct MeasurementNoise {
    Vector numbers;  // (ticks, 2, n)

    // Adds that of a tick to positions and velocities (n,).
    void add(size_t tick, Result q, Result v) const {
        if (numbers.empty()) { return; }
        const size_t n = q.size();
        const Vector noise = numbers.subspan(2 * n * tick, 2 * n);
        for (size_t i = 0; i < n; ++i) {
            q[i] += noise[i];
            v[i] += noise[n + i];
        }
    }
};

}  // namespace armctl
