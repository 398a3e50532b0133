// Keyword arguments of Python as the structs from which the core makes its objects; simulations of MuJoCo as arguments.
#pragma once
#include <algorithm>
#include <functional>
#include <numeric>
#include <string>
#include <string_view>

#include "../linear_algebra.hpp"
#include "../motors.hpp"
#include "arrays.hpp"

namespace armctl {

// Keyword arguments by name. All functions throw InputError with the name if there is no such value, or if it is not what is asked for.
// The keyword arguments have to exist as long as this object and the arrays from it.
class Arguments {
public:
    explicit Arguments(const nanobind::kwargs& given) : given_(&given) {}

    // Whether there is such a value, and not None. The further ones come with it.
    template <class... Names>
    bool has(const char* name, Names...) const {
        return is_there(name);
    }

    double number(const char* name) const;
    std::int64_t integer(const char* name) const;

    // An array of a shape, as its numbers: double or std::int64_t, const where they are only read.
    template <class Number>
    std::span<Number> array(std::initializer_list<size_t> shape, const char* name) const;

    // A dimension of an array.
    size_t length(const char* name, int axis = 0) const;

    bool flag(const char* name) const { return number(name) != 0.0; }
    size_t count(const char* name) const { return static_cast<size_t>(integer(name)); }
    Vector shaped(std::initializer_list<size_t> shape, const char* name) const { return array<const double>(shape, name); }
    Result writable(std::initializer_list<size_t> shape, const char* name) const { return array<double>(shape, name); }
    Integers integers(size_t size, const char* name) const { return array<const std::int64_t>({size}, name); }
    Vector vector(size_t size, const char* name) const { return shaped({size}, name); }
    Matrix matrix(size_t rows, size_t columns, const char* name) const { return {shaped({rows, columns}, name).data(), rows, columns}; }
    MatrixResult writable_matrix(size_t rows, size_t columns, const char* name) const {
        return {writable({rows, columns}, name).data(), rows, columns};
    }

    // A copy of a vector of any length, such as a gain for each joint.
    Numbers numbers(const char* name) const {
        const Vector values = vector(length(name), name);
        return {values.begin(), values.end()};
    }

    Integers integers(const char* name) const { return integers(length(name), name); }

    // A copy of an array of any length and of two dimensions, or of three, of which the first two become rows.
    Mat matrix(const char* name) const;

private:
    bool is_there(const char* name) const;

    const nanobind::kwargs* given_;
};

// What a reader asks `Arguments` for, as the text of a Python signature. It has the same functions, which note a name with its type
// and return zeros.
//
// A reader is a function of either, such as
//
//     const auto read = [](auto& given) { return PDGains{.stiffness = given.numbers("stiffness"), .damping = given.numbers("damping")}; };
//
// so that the arguments of Python are written once, and a type checker knows them.
class Signature {
public:
    // Notes that the arguments may be missing or None.
    template <class... Names>
    bool has(Names... names) {
        ((parameter(names).is_optional = true), ...);
        return true;
    }

    double number(const char* name) { return note(name, "float"), 0.0; }
    std::int64_t integer(const char* name) { return note(name, "int"), 0; }
    bool flag(const char* name) { return note(name, "bool"), false; }
    size_t count(const char* name) { return note(name, "int"), 0; }
    size_t length(const char* name, int = 0) { return note(name, array_type), 0; }
    Numbers numbers(const char* name) { return note(name, array_type), Numbers(); }
    Integers integers(const char* name) { return note(name, array_type), Integers(); }
    Mat matrix(const char* name) { return note(name, array_type), Mat(); }

    template <class Number>
    std::span<Number> array(std::initializer_list<size_t> shape, const char* name) {
        static std::remove_const_t<Number> zeros[16] = {};
        note(name, array_type);
        return {zeros, std::accumulate(shape.begin(), shape.end(), size_t{1}, std::multiplies())};
    }
    Vector shaped(std::initializer_list<size_t> shape, const char* name) { return array<const double>(shape, name); }
    Result writable(std::initializer_list<size_t> shape, const char* name) { return array<double>(shape, name); }
    Integers integers(size_t size, const char* name) { return array<const std::int64_t>({size}, name); }
    Vector vector(size_t size, const char* name) { return shaped({size}, name); }
    Matrix matrix(size_t rows, size_t columns, const char* name) { return {shaped({rows, columns}, name).data(), rows, columns}; }
    MatrixResult writable_matrix(size_t rows, size_t columns, const char* name) {
        return {writable({rows, columns}, name).data(), rows, columns};
    }

    // Throws InputError if an argument has a name that nothing asks for.
    void refuse_others(const nanobind::kwargs& given) const;

    // The parameters with their types, after a comma each.
    std::string text() const {
        std::string all;
        for (const Parameter& each : parameters_) {
            all += ", " + std::string(each.name) + ": " + each.type + (each.is_optional ? " | None = None" : "");
        }
        return all;
    }

private:
    static constexpr const char* array_type = "numpy.ndarray";

    struct Parameter {
        std::string_view name;
        const char* type = "";
        bool is_optional = false;
    };

    Parameter& parameter(const char* name) {
        const auto found = std::ranges::find(parameters_, std::string_view(name), &Parameter::name);
        return found != parameters_.end() ? *found : parameters_.emplace_back(Parameter{.name = name});
    }

    void note(const char* name, const char* type) { parameter(name).type = type; }

    std::vector<Parameter> parameters_;
};

// What a reader asks for.
template <class Reader>
Signature asked_by(const Reader& read) {
    Signature asked;
    read(asked);
    return asked;
}

// The signature of a function in Python whose keyword arguments a reader reads; `begin` is what comes before them.
template <class Reader>
std::string signature(const char* begin, const Reader& read, const char* returned = "None") {
    return std::string("def ") + begin + ", *" + asked_by(read).text() + ") -> " + returned;
}

// Binds a constructor whose keyword arguments a reader reads. `make(self, positional..., read arguments)` makes the object at `self`;
// `begin` is the signature before the keyword arguments.
template <class... Positional, class Class, class Reader, class Make, class... Extra>
void bind_constructor(Class& bound, const char* begin, const Reader& read, const Make& make, const Extra&... extra) {
    const auto init = [read, make, asked = asked_by(read)](typename Class::Type* self, const Positional&... positional,
                                                           const nanobind::kwargs& given) {
        asked.refuse_others(given);
        Arguments arguments(given);
        make(self, positional..., read(arguments));
    };
    bound.def("__init__", init, nanobind::sig(signature(begin, read).c_str()), extra...);
}

// An address of an array's element; a negative one is beyond each array.
inline size_t address(std::int64_t number) { return static_cast<size_t>(number); }

// The motors of an arm, (n,) each: `qpos_addresses`, `dof_addresses`, `ctrl_addresses` and `gear`; and
// `motor_addresses` if their torques are read. Elastic joints have `spring_qpos_addresses` and `spring_dof_addresses`, or
// `rotor_qpos_addresses` and `rotor_dof_addresses`, -1 for none.
template <class Given>
Motors motors_of(Given& given, bool are_read) {
    const size_t n = given.length("gear");
    const Integers qpos = given.integers(n, "qpos_addresses");
    const Integers dof = given.integers(n, "dof_addresses");
    const Integers ctrl = given.integers(n, "ctrl_addresses");
    const Integers force = are_read ? given.integers(n, "motor_addresses") : Integers();
    const Vector gear = given.vector(n, "gear");
    Motors motors;
    for (size_t i = 0; i < n; ++i) {
        motors.push_back({
            .qpos = address(qpos[i]),
            .dof = address(dof[i]),
            .ctrl = address(ctrl[i]),
            .force = are_read ? address(force[i]) : 0,
            .gear = gear[i],
        });
    }
    if (given.has("spring_qpos_addresses", "spring_dof_addresses")) {
        const Integers spring_qpos = given.integers(n, "spring_qpos_addresses");
        const Integers spring_dof = given.integers(n, "spring_dof_addresses");
        for (size_t i = 0; i < motors.size(); ++i) {
            motors[i].spring_qpos = address(spring_qpos[i]);
            motors[i].spring_dof = address(spring_dof[i]);
        }
    }
    if (given.has("rotor_qpos_addresses", "rotor_dof_addresses")) {
        const Integers rotor_qpos = given.integers(n, "rotor_qpos_addresses");
        const Integers rotor_dof = given.integers(n, "rotor_dof_addresses");
        for (size_t i = 0; i < motors.size(); ++i) {
            motors[i].rotor_qpos = address(rotor_qpos[i]);
            motors[i].rotor_dof = address(rotor_dof[i]);
        }
    }
    return motors;
}

// The address of a mujoco.MjModel. What keeps it has to keep `model` alive, by nb::keep_alive.
const MujocoModel* mujoco_model(nanobind::handle model);

// The simulation of a mujoco.MjModel and a mujoco.MjData. What keeps it has to keep `data` alive, by nb::keep_alive.
MujocoSimulation mujoco_simulation(nanobind::handle model, nanobind::handle data);

}  // namespace armctl
