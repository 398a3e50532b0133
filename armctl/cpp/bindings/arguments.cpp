#include "arguments.hpp"

namespace nb = nanobind;

namespace armctl {

namespace {

nb::handle find(const nb::kwargs& given, const char* name) { return PyDict_GetItemString(given.ptr(), name); }

PyObject* value(const nb::kwargs& given, const char* name) {
    const nb::handle found = find(given, name);
    if (!found.is_valid()) { throw InputError(std::string(name) + ": this argument is missing"); }
    return found.ptr();
}

// What Python made of a value; InputError if it could not, which the value -1 may stand for.
template <class Number>
Number converted(Number result, const char* name, const char* needed) {
    if (result == Number{-1} && PyErr_Occurred() != nullptr) {
        PyErr_Clear();
        throw InputError(std::string(name) + ": need " + needed);
    }
    return result;
}

}  // namespace

bool Arguments::is_there(const char* name) const { return find(*given_, name).is_valid() && !find(*given_, name).is_none(); }

double Arguments::number(const char* name) const { return converted(PyFloat_AsDouble(value(*given_, name)), name, "a number"); }

std::int64_t Arguments::integer(const char* name) const {
    return converted<std::int64_t>(PyLong_AsLongLong(value(*given_, name)), name, "an integer");
}

size_t Arguments::length(const char* name, int axis) const {
    if (axis == 0) {
        const Py_ssize_t length = PyObject_Length(value(*given_, name));
        return static_cast<size_t>(converted(length, name, "an array with at least one dimension"));
    }
    In array;
    array.acquire(value(*given_, name));
    return array.length(name, axis);
}

Mat Arguments::matrix(const char* name) const {
    In array;
    array.acquire(value(*given_, name));
    const bool is_stack = array.dimensions() == 3;
    const size_t first = array.length(name);
    const size_t second = array.length(name, 1);
    Mat matrix(is_stack ? first * second : first, is_stack ? array.length(name, 2) : second);
    copy(is_stack ? array.shaped({first, second, matrix.columns()}, name) : array.shaped({first, second}, name), matrix.numbers());
    return matrix;
}

template <class Number>
std::span<Number> Arguments::array(std::initializer_list<size_t> shape, const char* name) const {
    Array<Number> array;
    array.acquire(value(*given_, name));
    return array.shaped(shape, name);
}

void Signature::refuse_others(const nb::kwargs& given) const {
    for (const auto& [key, each] : given) {
        const std::string_view name = nb::cast<const char*>(key);
        if (std::ranges::find(parameters_, name, &Parameter::name) == parameters_.end()) {
            throw InputError(std::string(name) + ": there is no such argument");
        }
    }
}

template Vector Arguments::array(std::initializer_list<size_t>, const char*) const;
template Result Arguments::array(std::initializer_list<size_t>, const char*) const;
template Integers Arguments::array(std::initializer_list<size_t>, const char*) const;
template std::span<std::int64_t> Arguments::array(std::initializer_list<size_t>, const char*) const;

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
        .actuator_force = numbers<const double>(data, "actuator_force"),
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
