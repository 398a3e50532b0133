#include "mujoco_arguments.hpp"

namespace nb = nanobind;

namespace armctl {

namespace {

// An array of mjData, which is where it is as long as the object `data`.
template <class Number = const double>
std::span<Number> numbers(nb::handle data, const char* name) {
    const nb::object attribute = data.attr(name);
    Array<Number> array;
    array.acquire(attribute.ptr());
    return array.vector(array.length(name), name);
}

Matrix rows(nb::handle data, const char* name, size_t columns) {
    const nb::object attribute = data.attr(name);
    In array;
    array.acquire(attribute.ptr());
    return array.matrix(array.length(name), columns, name);
}

template <class Struct>
Struct* pointer(nb::handle object) {
    const auto address = nb::cast<std::uintptr_t>(object.attr("_address"));
    return reinterpret_cast<Struct*>(address);  // NOLINT(performance-no-int-to-ptr): Python has it as a number
}

}  // namespace

const MujocoModel* mujoco_model(nb::handle model) { return pointer<const MujocoModel>(model); }

MujocoSimulation mujoco_simulation(nb::handle model, nb::handle data) {
    return {
        .model = mujoco_model(model),
        .data = pointer<MujocoData>(data),
        .qpos = numbers<double>(data, "qpos"),
        .qvel = numbers<double>(data, "qvel"),
        .ctrl = numbers<double>(data, "ctrl"),
        .qfrc_actuator = numbers(data, "qfrc_actuator"),
        .qfrc_applied = numbers<double>(data, "qfrc_applied"),
        .actuator_length = numbers(data, "actuator_length"),
        .xfrc_applied = rows(data, "xfrc_applied", 6),
        .cfrc_ext = rows(data, "cfrc_ext", 6),
        .xpos = rows(data, "xpos", 3),
        .xmat = rows(data, "xmat", 9),
        .subtree_com = rows(data, "subtree_com", 3),
    };
}

std::vector<Motor> motors_of(const MotorArrays& arrays) {
    const size_t n = arrays.gear.length("gear");
    const std::span<const std::int64_t> qpos = arrays.qpos.vector(n, "qpos_addresses");
    const std::span<const std::int64_t> dof = arrays.dof.vector(n, "dof_addresses");
    const std::span<const std::int64_t> ctrl = arrays.ctrl.vector(n, "ctrl_addresses");
    const Vector gear = arrays.gear.vector(n, "gear");
    std::vector<Motor> motors(n);
    for (size_t i = 0; i < n; ++i) {
        motors[i] = {
            .qpos = address(qpos[i]),
            .dof = address(dof[i]),
            .ctrl = address(ctrl[i]),
            .torque = address(dof[i]),
            .gear = gear[i],
        };
    }
    return motors;
}

}  // namespace armctl
