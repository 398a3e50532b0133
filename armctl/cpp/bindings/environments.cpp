// The steps of environments.
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>

#include "../environment_batch.hpp"
#include "arguments.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

struct EnvironmentArguments {
    EnvironmentOptions options;
    EnvironmentArrays arrays;
};

// Of K tips: `tip_joints` (K,) carry them, -1 for the world, at `tip_placements` (K, 12); `tip_sizes` (K,) are the numbers of their blocks,
// and `home_tips` (K, 12) their poses at home.
template <class Given>
std::vector<ActionTip> action_tips(Given& given) {
    const Integers joints = given.integers("tip_joints");
    const Integers sizes = given.integers(joints.size(), "tip_sizes");
    const Matrix placements = given.matrix(joints.size(), 12, "tip_placements");
    const Matrix homes = given.matrix(joints.size(), 12, "home_tips");
    std::vector<ActionTip> tips;
    tips.reserve(joints.size());
    for (size_t k = 0; k < joints.size(); ++k) {
        tips.push_back({
            .frame = {.joint = static_cast<int>(joints[k]), .placement = pose_of(placements.row(k))},
            .size = static_cast<size_t>(sizes[k]),
            .T_world_home = pose_of(homes.row(k)),
        });
    }
    return tips;
}

// `limits` (5, n) are those of ActionLimits.
template <class Given>
ActionOptions action_options(Given& given, size_t n) {
    const Matrix limits = given.matrix(5, n, "limits");
    ActionOptions options{
        .mode = static_cast<ActionMode>(given.integer("mode")),
        .limits = {},
        .size = given.count("size"),
        .ticks = given.count("ticks"),
        .dt = given.number("dt"),
        .joint_scale = given.number("joint_scale"),
        .position_scale = given.number("position_scale"),
        .rotation_scale = given.number("rotation_scale"),
        .smoothing = given.count("smoothing"),
        .approach_rate = given.number("approach_rate"),
        .tip_damping = given.number("tip_damping"),
        .tips = action_tips(given),
    };
    for (size_t i = 0; i < n; ++i) { options.limits.push_back({limits(0, i), limits(1, i), limits(2, i), limits(3, i), limits(4, i)}); }
    return options;
}

// `gripper_ctrl` and `gripper_length` are addresses in ctrl and actuator_length of the actuators that actions move; `gripper_ends` (4,
// actuators) controls when closed and open, and lengths.
template <class Given>
std::vector<GripperActuator> gripper_of(Given& given) {
    const Integers ctrl = given.integers("gripper_ctrl");
    const Integers length = given.integers(ctrl.size(), "gripper_length");
    const Matrix ends = given.matrix(4, ctrl.size(), "gripper_ends");
    std::vector<GripperActuator> gripper;
    gripper.reserve(ctrl.size());
    for (size_t k = 0; k < ctrl.size(); ++k) {
        gripper.push_back({address(ctrl[k]), address(length[k]), ends(0, k), ends(1, k), ends(2, k), ends(3, k)});
    }
    return gripper;
}

template <class Given>
EnvironmentArrays environment_arrays(Given& given, const EnvironmentOptions& options) {
    const size_t n = options.motors.size();
    const size_t count = given.length("q");
    EnvironmentArrays arrays{
        .action = given.matrix(count, options.action.size + (options.gripper.empty() ? 0 : 1), "action"),
        .q = given.writable_matrix(count, n, "q"),
        .v = given.writable_matrix(count, n, "v"),
        .target = given.writable_matrix(count, n, "target"),
        .q_ref = given.writable_matrix(count, n, "q_ref"),
        .v_ref = given.writable_matrix(count, n, "v_ref"),
        .tip = given.writable_matrix(count, 12, "tip"),
        .opening = given.writable({count}, "opening"),
        .object = given.writable_matrix(count, 13, "object"),
        .touched = given.template array<std::int64_t>({count}, "touched"),
    };
    if (given.has("noise")) { arrays.noise = given.shaped({count, options.action.ticks, 2, n}, "noise"); }
    return arrays;
}

template <class Given>
EnvironmentArguments environment_arguments(Given& given) {
    EnvironmentArguments all;
    EnvironmentOptions& options = all.options;
    options.motors = motors_of(given, false);
    options.action = action_options(given, options.motors.size());
    options.gripper = gripper_of(given);
    options.grip_step = given.number("grip_step");
    if (given.has("object_addresses")) {
        const Integers addresses = given.integers(2, "object_addresses");
        options.object_addresses = {address(addresses[0]), address(addresses[1])};
    }
    if (given.has("obstacle")) { options.obstacle = static_cast<std::int32_t>(given.integer("obstacle")); }
    options.max_delay = given.count("max_delay");
    all.arrays = environment_arrays(given, options);
    return all;
}

}  // namespace

void bind_environments(nb::module_& module) {
    nb::enum_<ActionMode>(module, "ActionMode", "What the numbers of an action mean.")
        .value("torque", ActionMode::torque)
        .value("joint_delta", ActionMode::joint_delta)
        .value("joint_target", ActionMode::joint_target)
        .value("cartesian_delta", ActionMode::cartesian_delta)
        .value("cartesian_pose", ActionMode::cartesian_pose);
    const auto read = [](auto& given) { return environment_arguments(given); };
    const auto make = [](EnvironmentBatch* self, const std::shared_ptr<const MujocoApi>& api, const Model& arm, const Law& law,
                         EnvironmentArguments given) {
        new (self) EnvironmentBatch(api, arm, law, std::move(given.options), given.arrays);
    };
    nb::class_<EnvironmentBatch> bound(module, "EnvironmentBatch",
                                       "Several copies of an arm, each with its own simulation, controller and target.");
    // The rows keep the arrays that they were given, and the simulations.
    bind_constructor<std::shared_ptr<const MujocoApi>, Model, Law>(
        bound, "__init__(self, api: MujocoApi, arm: ArmModel, law: Law", read, make, "api"_a, "arm"_a, "law"_a, "given"_a,
        nb::keep_alive<1, 5>(),
        "Copies without simulations, that work on the arrays; armctl/cpp/environment_batch.hpp explains the arguments.");
    bound
        .def(
            "set_simulation",
            [](EnvironmentBatch& self, size_t row, nb::handle model, nb::handle data) {
                self.set_simulation(row, mujoco_simulation(model, data));
            },
            "row"_a, "model"_a, "data"_a, nb::keep_alive<1, 3>(), nb::keep_alive<1, 4>(), "Gives a copy its mujoco.MjModel and MjData.")
        .def("restart", &EnvironmentBatch::restart, "row"_a, "delay"_a,
             "Begins an episode of a copy, whose commands are delayed by some ticks; its arrays are the caller's.")
        .def("step", &EnvironmentBatch::step, "first"_a, "last"_a, nb::call_guard<nb::gil_scoped_release>(),
             "Steps the copies [first, last). Returns MuJoCo's message if it could not make a step; else an empty text.")
        .def(
            "rehearse",
            [](const EnvironmentBatch& self, const In& action, const Out& target, const Out& q_ref, const Out& v_ref) {
                const size_t n = self.joints();
                self.rehearse(action.vector(self.action_size(), "action"), target.vector(n, "target"), q_ref.vector(n, "q_ref"),
                              v_ref.vector(n, "v_ref"));
            },
            "action"_a, "target"_a, "q_ref"_a, "v_ref"_a,
            "Moves target and reference, (n,) each, as a step does; the arms stay where they are.");
}

}  // namespace armctl
