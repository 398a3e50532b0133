// The steps of environments.
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>

#include "../environment_rows.hpp"
#include "arguments.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

// What belongs to Python and has to stay: the arrays of rows.
struct HeldArguments {
    nb::kwargs given;
    Arguments arguments{given};
};

// Rows with their arrays and simulations.
class HeldRows : private HeldArguments, public EnvironmentRows {
public:
    HeldRows(std::shared_ptr<const MujocoApi> api, const Model& arm, const Law& law, nb::kwargs kwargs)
        : HeldArguments{std::move(kwargs)}, EnvironmentRows(std::move(api), arm, law, arguments) {}

    HeldRows(const HeldRows&) = delete;
    HeldRows& operator=(const HeldRows&) = delete;

    void hold_simulation(size_t row, nb::object model, nb::object data) {
        set_simulation(row, mujoco_simulation(model, data));
        simulations_[nb::int_(row)] = nb::make_tuple(std::move(model), std::move(data));
    }

    void rehearse_arrays(const In& action, const Out& target, const Out& q_ref, const Out& v_ref) const {
        const size_t n = joints();
        rehearse(action.vector(action_size(), "action"), target.vector(n, "target"), q_ref.vector(n, "q_ref"), v_ref.vector(n, "v_ref"));
    }

private:
    nb::dict simulations_;
};

}  // namespace

void bind_environments(nb::module_& module) {
    nb::enum_<ActionMode>(module, "ActionMode", "What the numbers of an action mean.")
        .value("torque", ActionMode::torque)
        .value("joint_delta", ActionMode::joint_delta)
        .value("joint_target", ActionMode::joint_target)
        .value("cartesian_delta", ActionMode::cartesian_delta)
        .value("cartesian_pose", ActionMode::cartesian_pose);
    nb::class_<HeldRows>(module, "EnvironmentRows", "Several copies of an arm, each with its own simulation, controller and target.")
        .def(nb::new_([](std::shared_ptr<const MujocoApi> api, const Model& arm, const Law& law, const nb::kwargs& given) {
                 return new HeldRows(std::move(api), arm, law, given);
             }),
             "api"_a, "arm"_a, "law"_a, "given"_a,
             "Copies without simulations, that work on the arrays; armctl/cpp/environment_rows.hpp explains the arguments.")
        .def("set_simulation", &HeldRows::hold_simulation, "row"_a, "model"_a, "data"_a, "Gives a copy its mujoco.MjModel and MjData.")
        .def("restart", &HeldRows::restart, "row"_a, "delay"_a,
             "Begins an episode of a copy, whose commands are delayed by some ticks; its arrays are the caller's.")
        .def("step", &HeldRows::step, "first"_a, "last"_a, nb::call_guard<nb::gil_scoped_release>(),
             "Steps the copies [first, last). Returns MuJoCo's message if it could not make a step; else an empty text.")
        .def("rehearse", &HeldRows::rehearse_arrays, "action"_a, "target"_a, "q_ref"_a, "v_ref"_a,
             "Moves target and reference, (n,) each, as a step does; the arms stay where they are.");
}

}  // namespace armctl
