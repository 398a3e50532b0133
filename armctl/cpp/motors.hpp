// What the ticks of simulations and of environments have in common: motors, delays of commands, and steps.
#pragma once
#include <cmath>
#include <limits>

#include "errors.hpp"
#include "linear_algebra.hpp"
#include "mujoco_api.hpp"

namespace armctl {

inline constexpr size_t no_address = std::numeric_limits<size_t>::max();

// A driven joint of a simulation: where MuJoCo's arrays have it.
struct Motor {
    size_t qpos = 0;
    size_t dof = 0;  // in qvel and qfrc_applied
    size_t ctrl = 0;
    size_t force = 0;   // in actuator_force
    double gear = 1.0;  // torque per unit of ctrl, and of force
    // Of an elastic joint: the spring whose motion adds to that of `qpos`, or the rotor, where the motor is no part of the link.
    size_t spring_qpos = no_address;
    size_t spring_dof = no_address;
    size_t rotor_qpos = no_address;
    size_t rotor_dof = no_address;
};

using Motors = std::vector<Motor>;

// Throws InputError if an address is not in the arrays of a simulation.
inline void check_addresses(const Motors& motors, const MujocoSimulation& simulation) {
    const auto has = [](size_t address, size_t size, bool is_optional) { return address < size || (is_optional && address == no_address); };
    for (const Motor& motor : motors) {
        const size_t nq = simulation.qpos.size();
        const size_t nv = simulation.qvel.size();
        if (!has(motor.qpos, nq, false) || !has(motor.dof, nv, false) || !has(motor.ctrl, simulation.ctrl.size(), false) ||
            !has(motor.force, simulation.actuator_force.size(), false) || !has(motor.spring_qpos, nq, true) ||
            !has(motor.spring_dof, nv, true) || !has(motor.rotor_qpos, nq, true) || !has(motor.rotor_dof, nv, true)) {
            throw InputError("motors: the model has no such joint or motor");
        }
    }
}

// Reads positions and velocities (n,) of the links; returns the norm of the velocities.
inline double read_joints(const Motors& motors, const MujocoSimulation& simulation, Result q, Result v) {
    for (size_t i = 0; i < motors.size(); ++i) {
        const Motor& motor = motors[i];
        q[i] = simulation.qpos[motor.qpos];
        v[i] = simulation.qvel[motor.dof];
        if (motor.spring_qpos != no_address) {
            q[i] += simulation.qpos[motor.spring_qpos];
            v[i] += simulation.qvel[motor.spring_dof];
        }
    }
    return std::sqrt(dot(v, v));
}

// Reads positions and velocities (n,) of the motors at the joints.
inline void read_rotors(const Motors& motors, const MujocoSimulation& simulation, Result q, Result v) {
    for (size_t i = 0; i < motors.size(); ++i) {
        const Motor& motor = motors[i];
        q[i] = simulation.qpos[motor.rotor_qpos == no_address ? motor.qpos : motor.rotor_qpos];
        v[i] = simulation.qvel[motor.rotor_dof == no_address ? motor.dof : motor.rotor_dof];
    }
}

// Applies torques (n,) N m to the links until others replace them.
inline void push_links(const Motors& motors, Vector torque, const MujocoSimulation& simulation) {
    for (size_t i = 0; i < motors.size(); ++i) {
        simulation.qfrc_applied[motors[i].dof] = torque[i];
        if (motors[i].spring_dof != no_address) { simulation.qfrc_applied[motors[i].spring_dof] = torque[i]; }
    }
}

// Sets the controls of the motors to joint torques (n,) N m.
inline void command_motors(const Motors& motors, Vector tau, const MujocoSimulation& simulation) {
    for (size_t i = 0; i < motors.size(); ++i) { simulation.ctrl[motors[i].ctrl] = tau[i] / motors[i].gear; }
}

// The joint torques (n,) N m of the motors in the last step.
inline void read_torques(const Motors& motors, const MujocoSimulation& simulation, Result tau) {
    for (size_t i = 0; i < motors.size(); ++i) { tau[i] = simulation.actuator_force[motors[i].force] * motors[i].gear; }
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
        age_ = 0;
    }

    // Takes the command of this tick, (n,) N m. Returns that of `ticks` ago, or of `jitter` ticks more, or the first one until then; a
    // command is not followed by an older one. The numbers change in the next call.
    Vector delayed(Vector tau, size_t jitter = 0) {
        const size_t rows = commands_.rows();
        copy(tau, commands_.row(given_ % rows));
        age_ = std::min({ticks_ + jitter, age_ + 1, given_, rows - 1});
        const size_t oldest = given_ - age_;
        ++given_;
        return commands_.row(oldest % rows);
    }

private:
    Mat commands_;  // ring buffer
    size_t ticks_ = 0;
    size_t given_ = 0;  // commands since the start
    size_t age_ = 0;    // ticks, of the command that was returned last
};

// The end of a tick: the motors receive a torque (n,) N m, and MuJoCo makes its steps.
inline void move_arm(const MujocoApi& api, const Motors& motors, Vector torque, size_t substeps, const MujocoSimulation& simulation) {
    command_motors(motors, torque, simulation);
    for (size_t k = 0; k < substeps; ++k) { api.step(simulation.model, simulation.data); }
}

}  // namespace armctl
