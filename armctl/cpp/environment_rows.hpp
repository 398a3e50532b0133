// Several copies of an arm, each with its own simulation, controller and target: the steps of a batch of environments.
#pragma once
#include <deque>
#include <mutex>
#include <optional>

#include "actions.hpp"

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
    const Arguments& given;  // it exists while this object is made
    size_t n;
    size_t ticks;
    size_t action_size;                                                // with the gripper's number
    size_t count = given.length("q");                                  // of the copies
    Matrix action = given.matrix(count, action_size, "action");        // in [-1, 1]
    MatrixResult q = given.writable_matrix(count, n, "q");             // rad
    MatrixResult v = given.writable_matrix(count, n, "v");             // rad/s
    MatrixResult target = given.writable_matrix(count, n, "target");   // rad, joint targets
    MatrixResult q_ref = given.writable_matrix(count, n, "q_ref");     // rad, the reference
    MatrixResult v_ref = given.writable_matrix(count, n, "v_ref");     // rad/s
    MatrixResult tip = given.writable_matrix(count, 12, "tip");        // position and rotation matrix
    Result opening = given.writable({count}, "opening");               // of the gripper, from closed (0) to open (1)
    MatrixResult object = given.writable_matrix(count, 13, "object");  // position, quaternion and velocities of the loose object
    std::span<std::int64_t> touched = given.array<std::int64_t>({count}, "touched");  // ticks of the last step with the obstacle touched
    // On measured positions and velocities.
    Vector noise = given.has("noise") ? given.shaped({count, ticks, 2, n}, "noise") : Vector();
};

class EnvironmentRows {
public:
    // `arm` is the model that controllers know; each copy gets a clone of the law. The arguments are those of `motors_of`,
    // ActionOptions and EnvironmentArrays, and: `gripper_ctrl` and `gripper_length`, addresses in ctrl and actuator_length of the
    // gripper's actuators, if actions move them; `gripper_ends` (4, actuators), controls when closed and open, and lengths;
    // `grip_step`, the share of the way from closed to open in a tick; `object_addresses` (2,) of the loose object in qpos and qvel,
    // if there is one; `obstacle`, a geom, if there is one; `max_delay`, ticks.
    EnvironmentRows(std::shared_ptr<const MujocoApi> api, Model arm, const Law& law, const Arguments& given)
        : api_(std::move(api)), arm_(std::move(arm)), motors_(motors_of(given)), options_(given, arm_->n()), gripper_(gripper_of(given)),
          grip_step_(given.number("grip_step")), arrays_{given, arm_->n(), options_.ticks, options_.size + (gripper_.empty() ? 0 : 1)} {
        if (law.joints() != joints() || arm_->n() != joints()) {
            throw InputError("law, arm: they are not for " + std::to_string(joints()) + " joints");
        }
        if (law.needs_wrench()) { throw InputError("law: environments measure no wrench, and this law needs one"); }
        if (given.has("object_addresses")) {
            const Integers addresses = given.integers(2, "object_addresses");
            object_ = {address(addresses[0]), address(addresses[1])};
        }
        if (given.has("obstacle")) { obstacle_ = static_cast<std::int32_t>(given.integer("obstacle")); }
        for (size_t row = 0; row < arrays_.count; ++row) {
            copies_.emplace_back(law.clone(), given.count("max_delay"), options_.smoothing);
            restart(row, 0);
        }
    }

    EnvironmentRows(const EnvironmentRows&) = delete;
    EnvironmentRows& operator=(const EnvironmentRows&) = delete;

    size_t joints() const { return motors_.size(); }
    size_t action_size() const { return options_.size; }

    // Gives a copy its simulation. A step of a copy without one throws InputError.
    void set_simulation(size_t row, const MujocoSimulation& simulation) {
        require_rows(row, row + 1);
        check_addresses(motors_, simulation);
        for (const GripperActuator& actuator : gripper_) {
            if (actuator.ctrl >= simulation.ctrl.size() || actuator.length >= simulation.actuator_length.size()) {
                throw InputError("gripper: the model has no such actuator");
            }
        }
        if (object_ && ((*object_)[0] + 7 > simulation.qpos.size() || (*object_)[1] + 6 > simulation.qvel.size())) {
            throw InputError("object: the model has no such joint");
        }
        copies_[row].simulation = simulation;
    }

    // Begins an episode of a copy, whose commands are delayed by some ticks. Its arrays and its simulation are the caller's.
    void restart(size_t row, size_t delay) {
        require_rows(row, row + 1);
        Copy& copy = copies_[row];
        copy.law->reset();
        copy.delay.restart(delay);
        copy.mean.restart(arrays_.q_ref.row(row));
        copy.grip_target = 1.0;
    }

    // Steps the copies [first, last). Different threads may step different copies at the same time; a copy that is stepped
    // already throws InputError.
    //
    // Returns MuJoCo's message, if it could not make a step.
    std::string step(size_t first, size_t last) {
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
        ActionTargets targets(arm_, options_);
        targets.move(action, target);
        for (size_t tick = 0; tick < options_.ticks; ++tick) { targets.advance(target, q_ref, v_ref); }
    }

private:
    // Whether MuJoCo repaired one of the simulations [first, last) in its episode.
    bool has_repaired_any(size_t first, size_t last) const {
        for (size_t row = first; row < last; ++row) {
            if (has_repaired(api_->repairs, copies_[row].simulation.data)) { return true; }
        }
        return false;
    }

    static std::vector<GripperActuator> gripper_of(const Arguments& given) {
        const size_t count = given.length("gripper_ctrl");
        const Integers ctrl = given.integers(count, "gripper_ctrl");
        const Integers length = given.integers(count, "gripper_length");
        const Matrix ends = given.matrix(4, count, "gripper_ends");
        std::vector<GripperActuator> gripper;
        gripper.reserve(count);
        for (size_t k = 0; k < count; ++k) {
            gripper.push_back({address(ctrl[k]), address(length[k]), ends(0, k), ends(1, k), ends(2, k), ends(3, k)});
        }
        return gripper;
    }

    struct Copy {
        Copy(std::unique_ptr<Law> own_law, size_t max_delay, size_t smoothing)
            : law(std::move(own_law)), delay(law->joints(), max_delay), mean(law->joints(), smoothing) {}

        std::unique_ptr<Law> law;
        Delay delay;
        ReferenceMean mean;
        MujocoSimulation simulation;
        double grip_target = 1.0;  // where the gripper's controls are, from closed (0) to open (1)
        std::mutex in_use;
    };

    // What a thread needs for its steps.
    struct Workspace {
        const EnvironmentRows& rows;
        ActionTargets targets{rows.arm_, rows.options_};
        TorqueGuard guard{rows.arm_, rows.options_};
        Numbers q_seen = Numbers(rows.joints());
        Numbers v_seen = q_seen;
        Numbers tau = q_seen;
    };

    void require_rows(size_t first, size_t last) const {
        if (first >= last || last > arrays_.count) { throw InputError("row: there are " + std::to_string(arrays_.count) + " rows"); }
    }

    void step_row(size_t row, Workspace& work) {
        arrays_.touched[row] = 0;
        work.targets.move(arrays_.action.row(row), arrays_.target.row(row));
        for (size_t k = 0; k < options_.ticks; ++k) { tick(row, k, work); }
        observe_scene(row);
        const Pose tip = work.targets.tip(arrays_.q.row(row));
        tip.translation.store(arrays_.tip.row(row));
        tip.rotation.to_rows(arrays_.tip.row(row).subspan(3));
    }

    // Measure, control, step.
    void tick(size_t row, size_t tick, Workspace& work) {
        Copy& copy = copies_[row];
        armctl::copy(arrays_.q.row(row), work.q_seen);
        armctl::copy(arrays_.v.row(row), work.v_seen);
        add_noise(arrays_.noise, row * options_.ticks + tick, work.q_seen, work.v_seen);
        if (options_.mode == ActionMode::torque) {
            work.guard.torque(arrays_.action.row(row), work.q_seen, work.v_seen, work.tau);
        } else {
            const Setpoint setpoint = work.targets.advance(arrays_.target.row(row), arrays_.q_ref.row(row), arrays_.v_ref.row(row));
            const Setpoint smooth = options_.smoothing == 1 ? setpoint : copy.mean.mean(setpoint);
            copy.law->torque({.q = work.q_seen, .v = work.v_seen, .wrench = {}}, smooth, work.tau);
        }
        if (!gripper_.empty()) { drive_gripper(row); }
        command_motors(motors_, copy.delay.delayed(work.tau), copy.simulation);
        api_->step(copy.simulation.model, copy.simulation.data);
        read_joints(motors_, copy.simulation, arrays_.q.row(row), arrays_.v.row(row));
        if (obstacle_ && Contacts(api_->contacts, copy.simulation.data).touch(*obstacle_)) { ++arrays_.touched[row]; }
    }

    // Moves the controls of the gripper towards the last number of the action, at a limited speed.
    void drive_gripper(size_t row) {
        Copy& copy = copies_[row];
        const double wanted = 0.5 * (1.0 + unit(arrays_.action.row(row)[action_size()]));
        copy.grip_target = std::min(std::max(wanted, copy.grip_target - grip_step_), copy.grip_target + grip_step_);
        for (const GripperActuator& actuator : gripper_) {
            copy.simulation.ctrl[actuator.ctrl] = actuator.closed_ctrl + copy.grip_target * (actuator.open_ctrl - actuator.closed_ctrl);
        }
    }

    // Reads the gripper's opening and the loose object.
    void observe_scene(size_t row) {
        const MujocoSimulation& simulation = copies_[row].simulation;
        if (!gripper_.empty()) {
            double share = 0.0;
            for (const GripperActuator& actuator : gripper_) {
                const double length = simulation.actuator_length[actuator.length];
                share += (length - actuator.closed_length) / (actuator.open_length - actuator.closed_length);
            }
            arrays_.opening[row] = share / static_cast<double>(gripper_.size());
        }
        if (object_) {
            copy(simulation.qpos.subspan((*object_)[0], 7), arrays_.object.row(row));
            copy(simulation.qvel.subspan((*object_)[1], 6), arrays_.object.row(row).subspan(7));
        }
    }

    std::shared_ptr<const MujocoApi> api_;
    Model arm_;
    Motors motors_;
    ActionOptions options_;
    std::vector<GripperActuator> gripper_;  // empty if the actions do not move it
    double grip_step_;
    EnvironmentArrays arrays_;
    std::optional<std::array<size_t, 2>> object_;
    std::optional<std::int32_t> obstacle_;
    std::deque<Copy> copies_;
};

}  // namespace armctl
