// What the ticks of simulations and of environments have in common: motors, measurement noise and delays.
#pragma once
#include <cmath>

#include "errors.hpp"
#include "linear_algebra.hpp"
#include "mujoco_api.hpp"

namespace armctl {

// A driven joint of a simulation: where MuJoCo's arrays have it.
struct Motor {
    size_t qpos = 0;
    size_t dof = 0;  // in qvel and qfrc_applied
    size_t ctrl = 0;
    size_t force = 0;   // in actuator_force
    double gear = 1.0;  // torque per unit of ctrl, and of force
};

using Motors = std::vector<Motor>;

// Throws InputError if an address is not in the arrays of a simulation.
inline void check_addresses(const Motors& motors, const MujocoSimulation& simulation) {
    for (const Motor& motor : motors) {
        if (motor.qpos >= simulation.qpos.size() || motor.dof >= simulation.qvel.size() || motor.ctrl >= simulation.ctrl.size() ||
            motor.force >= simulation.actuator_force.size()) {
            throw InputError("motors: the model has no such joint or motor");
        }
    }
}

// Reads positions and velocities (n,) of the joints; returns the norm of the velocities.
inline double read_joints(const Motors& motors, const MujocoSimulation& simulation, Result q, Result v) {
    for (size_t i = 0; i < motors.size(); ++i) {
        q[i] = simulation.qpos[motors[i].qpos];
        v[i] = simulation.qvel[motors[i].dof];
    }
    return std::sqrt(dot(v, v));
}

// Sets the controls of the motors to joint torques (n,) N m.
inline void command_motors(const Motors& motors, Vector tau, const MujocoSimulation& simulation) {
    for (size_t i = 0; i < motors.size(); ++i) { simulation.ctrl[motors[i].ctrl] = tau[i] / motors[i].gear; }
}

// The joint torques (n,) N m of the motors in the last step.
inline void read_torques(const Motors& motors, const MujocoSimulation& simulation, Result tau) {
    for (size_t i = 0; i < motors.size(); ++i) { tau[i] = simulation.actuator_force[motors[i].force] * motors[i].gear; }
}

// Adds the noise (ticks, 2, n) of a tick to measured positions and velocities (n,), if there is noise.
inline void add_noise(Vector noise, size_t tick, Result q, Result v) {
    if (noise.empty()) { return; }
    const size_t n = q.size();
    for (size_t i = 0; i < n; ++i) {
        q[i] += noise[2 * n * tick + i];
        v[i] += noise[2 * n * tick + n + i];
    }
}

// Commands that reach the motors some ticks after they were given.
class Delay {
public:
    // A delay of at most max_ticks for n joints; it is 0 until `restart`.
    Delay(size_t n, size_t max_ticks) : commands_(max_ticks + 1, n) {}

    size_t joints() const { return commands_.columns(); }

    // Forgets all commands, and delays those to come by some ticks. Throws InputError for more than max_ticks.
    void restart(size_t ticks) {
        const size_t most = commands_.rows() - 1;
        if (ticks > most) { throw InputError("ticks: need at most " + std::to_string(most) + ", got " + std::to_string(ticks)); }
        ticks_ = ticks;
        given_ = 0;
    }

    // Takes the command of this tick, (n,) N m. Returns that of `ticks` ago, or the first one until then; the numbers change in
    // the next call.
    Vector delayed(Vector tau) {
        copy(tau, commands_.row(given_ % commands_.rows()));
        const size_t oldest = given_ > ticks_ ? given_ - ticks_ : 0;
        ++given_;
        return commands_.row(oldest % commands_.rows());
    }

private:
    Mat commands_;  // ring buffer
    size_t ticks_ = 0;
    size_t given_ = 0;  // commands since the start
};

}  // namespace armctl
