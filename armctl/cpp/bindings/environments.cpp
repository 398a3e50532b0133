// The steps of environments.
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>

#include "../environment_rows.hpp"
#include "arguments.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

void bind_environments(nb::module_& module) {
    nb::enum_<ActionMode>(module, "ActionMode", "What the numbers of an action mean.")
        .value("torque", ActionMode::torque)
        .value("joint_delta", ActionMode::joint_delta)
        .value("joint_target", ActionMode::joint_target)
        .value("cartesian_delta", ActionMode::cartesian_delta)
        .value("cartesian_pose", ActionMode::cartesian_pose);
    // The rows keep the arrays that they were given, and the simulations.
    nb::class_<EnvironmentRows>(module, "EnvironmentRows", "Several copies of an arm, each with its own simulation, controller and target.")
        .def(nb::new_([](std::shared_ptr<const MujocoApi> api, const Model& arm, const Law& law, const nb::kwargs& given) {
                 return new EnvironmentRows(std::move(api), arm, law, Arguments(given));
             }),
             "api"_a, "arm"_a, "law"_a, "given"_a, nb::keep_alive<0, 5>(),
             "Copies without simulations, that work on the arrays; armctl/cpp/environment_rows.hpp explains the arguments.")
        .def(
            "set_simulation",
            [](EnvironmentRows& self, size_t row, nb::handle model, nb::handle data) {
                self.set_simulation(row, mujoco_simulation(model, data));
            },
            "row"_a, "model"_a, "data"_a, nb::keep_alive<1, 3>(), nb::keep_alive<1, 4>(), "Gives a copy its mujoco.MjModel and MjData.")
        .def("restart", &EnvironmentRows::restart, "row"_a, "delay"_a,
             "Begins an episode of a copy, whose commands are delayed by some ticks; its arrays are the caller's.")
        .def("step", &EnvironmentRows::step, "first"_a, "last"_a, nb::call_guard<nb::gil_scoped_release>(),
             "Steps the copies [first, last). Returns MuJoCo's message if it could not make a step; else an empty text.")
        .def(
            "rehearse",
            [](const EnvironmentRows& self, const In& action, const Out& target, const Out& q_ref, const Out& v_ref) {
                const size_t n = self.joints();
                self.rehearse(action.vector(self.action_size(), "action"), target.vector(n, "target"), q_ref.vector(n, "q_ref"),
                              v_ref.vector(n, "v_ref"));
            },
            "action"_a, "target"_a, "q_ref"_a, "v_ref"_a,
            "Moves target and reference, (n,) each, as a step does; the arms stay where they are.");
}

}  // namespace armctl
