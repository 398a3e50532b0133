// The steps of environments.
#include <nanobind/nanobind.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>

#include "../environment_rows.hpp"
#include "arrays.hpp"
#include "mujoco_arguments.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

using Model = std::shared_ptr<const ArmModel>;
using Api = std::shared_ptr<const MujocoApi>;

Pose pose(Vector numbers) { return {.rotation = Rotation::from_rows(numbers.subspan(3, 9)), .translation = vec3(numbers.first(3))}; }

std::vector<ActionLimits> limits_of(Matrix columns) {
    std::vector<ActionLimits> limits(columns.columns);
    for (size_t i = 0; i < limits.size(); ++i) {
        limits[i] = {
            .q_min = columns(0, i),
            .q_max = columns(1, i),
            .v_max = columns(2, i),
            .a_max = columns(3, i),
            .tau_max = columns(4, i),
        };
    }
    return limits;
}

std::vector<GripperActuator> gripper_of(const IntegersIn& ctrl_addresses, const IntegersIn& length_addresses, const In& gripper_ends) {
    const size_t actuators = ctrl_addresses.length("gripper_ctrl");
    const std::span<const std::int64_t> ctrl = ctrl_addresses.vector(actuators, "gripper_ctrl");
    const std::span<const std::int64_t> length = length_addresses.vector(actuators, "gripper_length");
    const Matrix ends = gripper_ends.matrix(4, actuators, "gripper_ends");
    std::vector<GripperActuator> gripper(actuators);
    for (size_t k = 0; k < gripper.size(); ++k) {
        gripper[k] = {
            .ctrl = address(ctrl[k]),
            .length = address(length[k]),
            .closed_ctrl = ends(0, k),
            .open_ctrl = ends(1, k),
            .closed_length = ends(2, k),
            .open_length = ends(3, k),
        };
    }
    return gripper;
}

// The numbers of the loose object's joint in qpos and qvel.
std::optional<LooseObject> object_of(std::optional<std::pair<size_t, size_t>> addresses) {
    if (!addresses) { return {}; }
    return LooseObject{.qpos = addresses->first, .qvel = addresses->second};
}

void check(const ActionOptions& options, size_t n) {
    const bool is_cartesian = options.mode == ActionMode::cartesian_delta || options.mode == ActionMode::cartesian_pose;
    const bool has_right_size = is_cartesian ? options.size == 3 || options.size == 6 : options.size == n;
    if (!has_right_size || options.ticks == 0 || !(options.dt > 0.0)) {
        throw InputError("action: need a number for each joint, or 3 or 6 for the tip; a positive dt; and at least one tick");
    }
}

// The arrays of all copies, as Python passes them.
struct ArrayArguments {
    nb::handle action;
    nb::handle q;
    nb::handle v;
    nb::handle target;
    nb::handle q_ref;
    nb::handle v_ref;
    nb::handle tip;
    nb::handle opening;
    nb::handle object;
    nb::handle touched;
    nb::handle noise;
};

// Rows, with what belongs to Python and has to stay: their arrays and simulations.
class HeldRows {
public:
    HeldRows(const Api& api, const Model& arm, const Law& law, EnvironmentOptions options, const ArrayArguments& arguments) {
        const size_t n = arm->n();
        check(options.action, n);
        if (options.motors.size() != n) { throw InputError("gear: need as many motors as the arm has joints"); }
        const size_t width = options.action.size + (options.gripper.empty() ? 0 : 1);
        const size_t count = length(arguments.q, "q");
        const size_t ticks = options.action.ticks;
        const EnvironmentArrays arrays{
            .action = read_only(matrix(arguments.action, count, width, "action")),
            .q = matrix(arguments.q, count, n, "q"),
            .v = matrix(arguments.v, count, n, "v"),
            .target = matrix(arguments.target, count, n, "target"),
            .q_ref = matrix(arguments.q_ref, count, n, "q_ref"),
            .v_ref = matrix(arguments.v_ref, count, n, "v_ref"),
            .tip = matrix(arguments.tip, count, 12, "tip"),
            .opening = held(arguments.opening).vector(count, "opening"),
            .object = matrix(arguments.object, count, 13, "object"),
            .touched = held_integers(arguments.touched).vector(count, "touched"),
            .noise = arguments.noise.is_none() ? Vector() : held(arguments.noise).shaped({count, ticks, 2, n}, "noise"),
        };
        simulations_.resize(count);
        rows_ = std::make_unique<EnvironmentRows>(api, arm, law, std::move(options), arrays);
    }

    HeldRows(const HeldRows&) = delete;
    HeldRows& operator=(const HeldRows&) = delete;

    void set_simulation(size_t row, nb::object model, nb::object data) {
        require_row(row, row + 1);
        rows_->set_simulation(row, mujoco_simulation(model, data));
        simulations_[row] = {std::move(model), std::move(data)};
    }

    void restart(size_t row, size_t delay) {
        require_row(row, row + 1);
        rows_->restart(row, delay);
    }

    std::string step(size_t first, size_t last) {
        require_row(first, last);
        nb::gil_scoped_release release;
        return rows_->step(first, last);
    }

    void rehearse(const In& action, const Out& target, const Out& q_ref, const Out& v_ref) const {
        const size_t n = rows_->joints();
        rows_->rehearse(action.vector(rows_->action_size(), "action"), target.vector(n, "target"), q_ref.vector(n, "q_ref"),
                        v_ref.vector(n, "v_ref"));
    }

private:
    struct PythonSimulation {
        nb::object model;
        nb::object data;
    };

    static Matrix read_only(MatrixResult matrix) { return {matrix.data, matrix.rows, matrix.columns}; }

    static size_t length(nb::handle argument, const char* name) {
        In array;
        array.acquire(argument.ptr());
        return array.length(name);
    }

    const Out& held(nb::handle argument) {
        arrays_.emplace_back().acquire(argument.ptr());
        return arrays_.back();
    }

    const IntegersOut& held_integers(nb::handle argument) {
        integers_.emplace_back().acquire(argument.ptr());
        return integers_.back();
    }

    MatrixResult matrix(nb::handle argument, size_t rows, size_t columns, const char* name) {
        return held(argument).matrix(rows, columns, name);
    }

    void require_row(size_t first, size_t last) const {
        if (first >= last || last > rows_->count()) { throw InputError("row: there are " + std::to_string(rows_->count()) + " rows"); }
    }

    std::vector<Out> arrays_;
    std::vector<IntegersOut> integers_;
    std::vector<PythonSimulation> simulations_;
    std::unique_ptr<EnvironmentRows> rows_;
};

void bind_actions(nb::module_& module) {
    nb::enum_<ActionMode>(module, "ActionMode", "What the numbers of an action mean.")
        .value("torque", ActionMode::torque)
        .value("joint_delta", ActionMode::joint_delta)
        .value("joint_target", ActionMode::joint_target)
        .value("cartesian_delta", ActionMode::cartesian_delta)
        .value("cartesian_pose", ActionMode::cartesian_pose);
    nb::class_<ActionOptions>(module, "ActionOptions", "How actions are used; armctl/cpp/actions.hpp explains it.")
        .def(nb::new_([](ActionMode mode, size_t size, size_t ticks, double dt, double joint_scale, double position_scale,
                         double rotation_scale, double approach_rate, double tip_damping, const In& home_tip) {
                 return ActionOptions{
                     .mode = mode,
                     .size = size,
                     .ticks = ticks,
                     .dt = dt,
                     .joint_scale = joint_scale,
                     .position_scale = position_scale,
                     .rotation_scale = rotation_scale,
                     .approach_rate = approach_rate,
                     .tip_damping = tip_damping,
                     .T_world_home = pose(home_tip.vector(12, "home_tip")),
                 };
             }),
             nb::kw_only(), "mode"_a, "size"_a, "ticks"_a, "dt"_a, "joint_scale"_a, "position_scale"_a, "rotation_scale"_a,
             "approach_rate"_a, "tip_damping"_a, "home_tip"_a);
}

HeldRows* new_rows(const Api& api, const Model& arm, const Law& law, const ActionOptions& options, const In& limits,
                   const IntegersIn& qpos_addresses, const IntegersIn& dof_addresses, const IntegersIn& ctrl_addresses, const In& gear,
                   const IntegersIn& gripper_ctrl, const IntegersIn& gripper_length, const In& gripper_ends, double grip_step,
                   std::optional<std::pair<size_t, size_t>> object_addresses, std::optional<std::int32_t> obstacle, size_t max_delay,
                   nb::handle action, nb::handle q, nb::handle v, nb::handle target, nb::handle q_ref, nb::handle v_ref, nb::handle tip,
                   nb::handle opening, nb::handle object, nb::handle touched, nb::handle noise) {
    EnvironmentOptions environment{
        .action = options,
        .limits = limits_of(limits.matrix(5, arm->n(), "limits")),
        .motors = motors_of({.qpos = qpos_addresses, .dof = dof_addresses, .ctrl = ctrl_addresses, .gear = gear}),
        .gripper = gripper_of(gripper_ctrl, gripper_length, gripper_ends),
        .grip_step = grip_step,
        .object = object_of(object_addresses),
        .obstacle = obstacle,
        .max_delay = max_delay,
    };
    const ArrayArguments arrays{
        .action = action,
        .q = q,
        .v = v,
        .target = target,
        .q_ref = q_ref,
        .v_ref = v_ref,
        .tip = tip,
        .opening = opening,
        .object = object,
        .touched = touched,
        .noise = noise,
    };
    return new HeldRows(api, arm, law, std::move(environment), arrays);
}

void bind_rows(nb::module_& module) {
    nb::class_<HeldRows>(module, "EnvironmentRows", "Several copies of an arm, each with its own simulation, controller and target.")
        .def(nb::new_(&new_rows), "api"_a, nb::kw_only(), "arm"_a, "law"_a, "options"_a, "limits"_a, "qpos_addresses"_a, "dof_addresses"_a,
             "ctrl_addresses"_a, "gear"_a, "gripper_ctrl"_a, "gripper_length"_a, "gripper_ends"_a, "grip_step"_a,
             "object_addresses"_a.none(), "obstacle"_a.none(), "max_delay"_a, "action"_a, "q"_a, "v"_a, "target"_a, "q_ref"_a, "v_ref"_a,
             "tip"_a, "opening"_a, "object"_a, "touched"_a, "noise"_a.none(),
             "Copies without simulations, that work on the arrays; armctl/cpp/environment_rows.hpp explains them.\n\n"
             "`limits` (5, n) are least and greatest position, greatest speed, acceleration and torque. `gripper_ctrl` and\n"
             "`gripper_length` (actuators,) are addresses in ctrl and in actuator_length, `gripper_ends` (4, actuators) the\n"
             "controls when closed and open, and the lengths. `object_addresses` are those of the loose object in qpos and\n"
             "qvel, `obstacle` is a geom.")
        .def("set_simulation", &HeldRows::set_simulation, "row"_a, "model"_a, "data"_a, "Gives a copy its mujoco.MjModel and MjData.")
        .def("restart", &HeldRows::restart, "row"_a, "delay"_a,
             "Begins an episode of a copy, whose commands are delayed by some ticks; its arrays are the caller's.")
        .def("step", &HeldRows::step, "first"_a, "last"_a,
             "Steps the copies [first, last). Returns MuJoCo's message if it could not make a step; else an empty text.")
        .def("rehearse", &HeldRows::rehearse, "action"_a, "target"_a, "q_ref"_a, "v_ref"_a,
             "Moves target and reference, (n,) each, as a step does; the arms stay where they are.");
}

}  // namespace

void bind_environments(nb::module_& module) {
    bind_actions(module);
    bind_rows(module);
}

}  // namespace armctl
