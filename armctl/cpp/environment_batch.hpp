// Several copies of an arm, each with its own simulation, controller and target: the steps of a batch of environments.
#pragma once
#include <deque>
#include <mutex>
#include <optional>

#include "actions.hpp"
#include "sensors.hpp"

namespace armctl {

// An actuator of the gripper, at whose ends the gripper is closed and open.
struct GripperActuator {
    size_t ctrl;
    size_t length;  // in actuator_length
    double closed_ctrl;
    double open_ctrl;
    double closed_length;
    double open_length;
};

// The numbers of all copies, which belong to the caller. A step writes all but the action and the noise.
struct EnvironmentArrays {
    Matrix action;                    // (copies, numbers of an action), with the gripper's number last, in [-1, 1]
    MatrixResult q;                   // (copies, n) rad
    MatrixResult v;                   // (copies, n) rad/s
    MatrixResult target;              // (copies, n) rad, joint targets
    MatrixResult q_ref;               // (copies, n) rad, the reference
    MatrixResult v_ref;               // (copies, n) rad/s
    MatrixResult tip;                 // (copies, 12) position and rotation matrix
    Result opening;                   // (copies,) of the gripper, from closed (0) to open (1)
    MatrixResult object;              // (copies, 13) position, quaternion and velocities of the loose object
    std::span<std::int64_t> touched;  // (copies,) ticks of the last step with the obstacle touched
    Vector noise{};                   // (copies, ticks, 2, n) on measured positions and velocities; empty for none

    size_t count() const { return q.rows; }  // of the copies
};

struct EnvironmentOptions {
    Motors motors;
    ActionOptions action;
    std::vector<GripperActuator> gripper;  // empty if the actions do not move it
    double grip_step = 0.0;                // the share of the way from closed to open in a tick
    // Of the loose object in qpos and qvel, if there is one.
    std::optional<std::array<size_t, 2>> object_addresses{};
    std::optional<std::int32_t> obstacle{};  // a geom, if there is one
    size_t max_delay = 0;                    // ticks
};

class EnvironmentBatch {
public:
    // `arm` is the model that controllers know; each copy gets a clone of the law.
    EnvironmentBatch(std::shared_ptr<const MujocoApi> api, Model arm, const Law& law, EnvironmentOptions options,
                     const EnvironmentArrays& arrays)
        : api_(std::move(api)), arm_(std::move(arm)), options_(std::move(options)), arrays_(arrays) {
        if (law.joints() != joints() || arm_->n() != joints()) {
            throw InputError("law, arm: they are not for " + std::to_string(joints()) + " joints");
        }
        if (law.needs_wrench()) { throw InputError("law: environments measure no wrench, and this law needs one"); }
        action().check(joints(), arm_->joints.size());
        for (size_t row = 0; row < arrays_.count(); ++row) {
            copies_.emplace_back(law.clone(), options_, action().smoothing);
            restart(row, 0);
        }
    }

    EnvironmentBatch(const EnvironmentBatch&) = delete;
    EnvironmentBatch& operator=(const EnvironmentBatch&) = delete;

    size_t joints() const { return options_.motors.size(); }
    size_t action_size() const { return action().size; }

    // Gives a copy its simulation. A step of a copy without one throws InputError.
    void set_simulation(size_t row, const MujocoSimulation& simulation) {
        require_rows(row, row + 1);
        check_addresses(options_.motors, simulation);
        for (const GripperActuator& actuator : options_.gripper) {
            if (actuator.ctrl >= simulation.ctrl.size() || actuator.length >= simulation.actuator_length.size()) {
                throw InputError("gripper: the model has no such actuator");
            }
        }
        if (options_.object_addresses && ((*options_.object_addresses)[0] + 7 > simulation.qpos.size() ||
                                          (*options_.object_addresses)[1] + 6 > simulation.qvel.size())) {
            throw InputError("object: the model has no such joint");
        }
        copies_[row].simulation = simulation;
    }

    // Begins an episode of a copy, whose commands are delayed by some ticks. Its arrays and its simulation are the caller's.
    void restart(size_t row, size_t delay) {
        require_rows(row, row + 1);
        Copy& copy = copies_[row];
        copy.law->reset();
        copy.sensors.restart();
        copy.delay.restart(delay);
        copy.mean.restart(arrays_.q_ref.row(row));
        copy.grip_target = 1.0;
    }

    // Steps the copies [first, last). Different threads may step different copies at the same time; a copy that is stepped
    // already throws InputError.
    //
    // Returns MuJoCo's message, if it could not make a step.
    [[nodiscard]] std::string step(size_t first, size_t last) {
        require_rows(first, last);
        std::vector<std::unique_lock<std::mutex>> locks;
        for (size_t row = first; row < last; ++row) {
            if (!locks.emplace_back(copies_[row].in_use, std::try_to_lock).owns_lock()) {
                throw InputError("environment: another thread steps it; give each thread an environment of its own");
            }
            if (copies_[row].simulation.data == nullptr) { throw InputError("row " + std::to_string(row) + ": it has no simulation"); }
        }
        Workspace workspace{*this};
        auto work = [&] {
            for (size_t row = first; row < last; ++row) { step_row(row, workspace); }
        };
        std::string error = guarded(*api_, work);
        if (error.empty() && has_repaired_any(first, last)) {
            return "a position, velocity, acceleration or control was NaN or above 1e10, and MuJoCo repaired it";
        }
        return error;
    }

    // Moves target and reference, (n,) each, as a step does; the arms stay where they are.
    void rehearse(Vector action, Result target, Result q_ref, Result v_ref) const {
        ActionTargets targets(arm_, options_.action);
        targets.move(action, target);
        for (size_t tick = 0; tick < options_.action.ticks; ++tick) { targets.advance(target, q_ref, v_ref); }
    }

private:
    // Whether MuJoCo repaired one of the simulations [first, last) in its episode.
    bool has_repaired_any(size_t first, size_t last) const {
        for (size_t row = first; row < last; ++row) {
            if (has_repaired(api_->repairs, copies_[row].simulation.data)) { return true; }
        }
        return false;
    }

    const ActionOptions& action() const { return options_.action; }

    struct Copy {
        Copy(std::unique_ptr<Law> own_law, const EnvironmentOptions& options, size_t smoothing)
            : law(std::move(own_law)), sensors({.motors = options.motors}), delay(law->joints(), options.max_delay),
              mean(law->joints(), smoothing) {}

        std::unique_ptr<Law> law;
        Sensors sensors;
        Delay delay;
        ReferenceMean mean;
        MujocoSimulation simulation;
        double grip_target = 1.0;  // where the gripper's controls are, from closed (0) to open (1)
        std::mutex in_use;
    };

    // What a thread needs for its steps.
    struct Workspace {
        const EnvironmentBatch& rows;
        ActionTargets targets{rows.arm_, rows.action()};
        TorqueGuard guard{rows.arm_, rows.action()};
        Numbers tau = Numbers(rows.joints());
    };

    void require_rows(size_t first, size_t last) const {
        if (first >= last || last > arrays_.count()) { throw InputError("row: there are " + std::to_string(arrays_.count()) + " rows"); }
    }

    void step_row(size_t row, Workspace& work) {
        arrays_.touched[row] = 0;
        work.targets.move(arrays_.action.row(row), arrays_.target.row(row));
        for (size_t k = 0; k < action().ticks; ++k) { tick(row, k, work); }
        observe_scene(row);
        const Pose tip = work.targets.tip(arrays_.q.row(row));
        tip.translation.store(arrays_.tip.row(row));
        tip.rotation.to_rows(arrays_.tip.row(row).subspan(3));
    }

    // Measure, control, step.
    void tick(size_t row, size_t tick, Workspace& work) {
        Copy& copy = copies_[row];
        const size_t numbers = 2 * joints();
        const size_t noise = (row * action().ticks + tick) * numbers;
        copy.sensors.measure(copy.simulation, arrays_.noise.empty() ? Vector() : arrays_.noise.subspan(noise, numbers), {});
        copy.sensors.end_tick();
        const State state{.q = copy.sensors.q(), .v = copy.sensors.v(), .wrench = {}};
        if (action().mode == ActionMode::torque) {
            work.guard.torque(arrays_.action.row(row), state.q, state.v, work.tau);
        } else {
            const Setpoint setpoint = work.targets.advance(arrays_.target.row(row), arrays_.q_ref.row(row), arrays_.v_ref.row(row));
            const Setpoint smooth = action().smoothing == 1 ? setpoint : copy.mean.mean(setpoint);
            copy.law->torque(state, smooth, work.tau);
        }
        if (!options_.gripper.empty()) { drive_gripper(row); }
        move_arm(*api_, options_.motors, copy.delay.delayed(work.tau), 1, copy.simulation);
        read_joints(options_.motors, copy.simulation, arrays_.q.row(row), arrays_.v.row(row));
        if (options_.obstacle && Contacts(api_->contacts, copy.simulation.data).touch(*options_.obstacle)) { ++arrays_.touched[row]; }
    }

    // Moves the controls of the gripper towards the last number of the action, at a limited speed.
    void drive_gripper(size_t row) {
        Copy& copy = copies_[row];
        const double wanted = 0.5 * (1.0 + unit(arrays_.action.row(row)[action_size()]));
        copy.grip_target = std::min(std::max(wanted, copy.grip_target - options_.grip_step), copy.grip_target + options_.grip_step);
        for (const GripperActuator& actuator : options_.gripper) {
            copy.simulation.ctrl[actuator.ctrl] = actuator.closed_ctrl + copy.grip_target * (actuator.open_ctrl - actuator.closed_ctrl);
        }
    }

    // Reads the gripper's opening and the loose object.
    void observe_scene(size_t row) {
        const MujocoSimulation& simulation = copies_[row].simulation;
        if (!options_.gripper.empty()) {
            double share = 0.0;
            for (const GripperActuator& actuator : options_.gripper) {
                const double length = simulation.actuator_length[actuator.length];
                share += (length - actuator.closed_length) / (actuator.open_length - actuator.closed_length);
            }
            arrays_.opening[row] = share / static_cast<double>(options_.gripper.size());
        }
        if (options_.object_addresses) {
            copy(simulation.qpos.subspan((*options_.object_addresses)[0], 7), arrays_.object.row(row));
            copy(simulation.qvel.subspan((*options_.object_addresses)[1], 6), arrays_.object.row(row).subspan(7));
        }
    }

    std::shared_ptr<const MujocoApi> api_;
    Model arm_;
    EnvironmentOptions options_;
    EnvironmentArrays arrays_;
    std::deque<Copy> copies_;
};

}  // namespace armctl
