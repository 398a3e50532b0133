// Several copies of an arm, each with its own simulation, controller and target: the steps of a batch of environments.
#pragma once
#include <atomic>
#include <deque>
#include <optional>

#include "actions.hpp"
#include "motors.hpp"

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
    EnvironmentArrays(const Arguments& given, size_t n, size_t ticks, size_t action_size);

    size_t count;
    Matrix action;                    // (count, size), and the gripper's number
    MatrixResult q;                   // (count, n) rad
    MatrixResult v;                   // (count, n) rad/s
    MatrixResult target;              // (count, n) rad, joint targets
    MatrixResult q_ref;               // (count, n) rad, the reference
    MatrixResult v_ref;               // (count, n) rad/s
    MatrixResult tip;                 // (count, 12) position and rotation matrix
    Result opening;                   // (count,) of the gripper, from closed (0) to open (1)
    MatrixResult object;              // (count, 13) position, quaternion, velocity and angular velocity of the loose object
    std::span<std::int64_t> touched;  // (count,) ticks of the last step at which something touched the obstacle
    Vector noise;                     // (count, ticks, 2, n) on measured positions and velocities; empty for none
};

class EnvironmentRows {
public:
    // `arm` is the model that controllers know; each copy gets a clone of the law. The arguments are those of `motors_of`,
    // ActionOptions and EnvironmentArrays, and: `gripper_ctrl` and `gripper_length`, addresses in ctrl and actuator_length of the
    // gripper's actuators, if actions move them; `gripper_ends` (4, actuators), controls when closed and open, and lengths;
    // `grip_step`, the share of the way from closed to open in a tick; `object_addresses` (2,) of the loose object in qpos and qvel,
    // if there is one; `obstacle`, a geom, if there is one; `max_delay`, ticks.
    EnvironmentRows(std::shared_ptr<const MujocoApi> api, Model arm, const Law& law, const Arguments& given);

    size_t joints() const { return motors_.size(); }
    size_t action_size() const { return options_.size; }

    // Gives a copy its simulation. A step of a copy without one throws InputError.
    void set_simulation(size_t row, const MujocoSimulation& simulation);

    // Begins an episode of a copy, whose commands are delayed by some ticks. Its arrays and its simulation are the caller's.
    void restart(size_t row, size_t delay);

    // Steps the copies [first, last). Different threads may step different copies at the same time; a copy that is stepped
    // already throws InputError.
    //
    // Returns MuJoCo's message, if it could not make a step.
    std::string step(size_t first, size_t last);

    // Moves target and reference, (n,) each, as a step does; the arms stay where they are.
    void rehearse(Vector action, Result target, Result q_ref, Result v_ref) const;

private:
    struct Copy {
        Copy(std::unique_ptr<Law> own_law, size_t max_delay) : law(std::move(own_law)), delay(law->joints(), max_delay) {}

        std::unique_ptr<Law> law;
        Delay delay;
        MujocoSimulation simulation;
        double grip_target = 1.0;  // where the gripper's controls are, from closed (0) to open (1)
        std::atomic<bool> is_in_use = false;
    };
    class Use;
    struct Workspace;

    void require_rows(size_t first, size_t last) const;
    void step_row(size_t row, Workspace& work);
    void tick(size_t row, size_t tick, Workspace& work);
    void drive_gripper(size_t row);
    void observe_scene(size_t row);

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
