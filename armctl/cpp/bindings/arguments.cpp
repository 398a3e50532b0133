#include "arguments.hpp"

namespace nb = nanobind;

namespace armctl {

nb::handle KeywordArguments::value(const char* name) const {
    const nb::handle found = find(name);
    if (!found.is_valid()) { throw InputError(std::string(name) + ": this argument is missing"); }
    return found;
}

double KeywordArguments::number(const char* name) const {
    const double number = PyFloat_AsDouble(value(name).ptr());
    if (number == -1.0 && PyErr_Occurred() != nullptr) {
        PyErr_Clear();
        throw InputError(std::string(name) + ": need a number");
    }
    return number;
}

std::int64_t KeywordArguments::integer(const char* name) const {
    const std::int64_t number = PyLong_AsLongLong(value(name).ptr());
    if (number == -1 && PyErr_Occurred() != nullptr) {
        PyErr_Clear();
        throw InputError(std::string(name) + ": need an integer");
    }
    return number;
}

size_t KeywordArguments::length(const char* name) const {
    const Py_ssize_t length = PyObject_Length(value(name).ptr());
    if (length < 0) {
        PyErr_Clear();
        throw InputError(std::string(name) + ": need an array with at least one dimension");
    }
    return static_cast<size_t>(length);
}

namespace {

// An array of mjData, which is where it is as long as the object `data`.
template <class Number = double>
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
        .qpos = numbers(data, "qpos"),
        .qvel = numbers(data, "qvel"),
        .ctrl = numbers(data, "ctrl"),
        .qfrc_actuator = numbers<const double>(data, "qfrc_actuator"),
        .qfrc_applied = numbers(data, "qfrc_applied"),
        .actuator_length = numbers<const double>(data, "actuator_length"),
        .xfrc_applied = rows(data, "xfrc_applied", 6),
        .cfrc_ext = rows(data, "cfrc_ext", 6),
        .xpos = rows(data, "xpos", 3),
        .xmat = rows(data, "xmat", 9),
        .subtree_com = rows(data, "subtree_com", 3),
    };
}

}  // namespace armctl
