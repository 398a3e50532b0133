// Arguments that are simulations of MuJoCo, and arguments that may be None.
#pragma once
#include <nanobind/nanobind.h>

#include "../motors.hpp"
#include "../mujoco_api.hpp"
#include "arrays.hpp"

namespace armctl {

// The address of a mujoco.MjModel. What keeps it has to keep `model` alive, by nb::keep_alive.
const MujocoModel* mujoco_model(nanobind::handle model);

// The simulation of a mujoco.MjModel and a mujoco.MjData. What keeps it has to keep `data` alive, by nb::keep_alive.
MujocoSimulation mujoco_simulation(nanobind::handle model, nanobind::handle data);

// Where MuJoCo has the motors of an arm, (n,) each.
struct MotorArrays {
    const IntegersIn& qpos;
    const IntegersIn& dof;
    const IntegersIn& ctrl;
    const In& gear;
};

// The motors of the arrays; their torques are where their velocities are.
std::vector<Motor> motors_of(const MotorArrays& arrays);

// An address of an array's element; a negative one is beyond each array.
inline size_t address(std::int64_t number) { return static_cast<size_t>(number); }

// An argument that is an array or None.
template <class Number>
class OptionalArray {
public:
    explicit OptionalArray(nanobind::handle argument) : is_given_(!argument.is_none()) {
        if (is_given_) { array_.acquire(argument.ptr()); }
    }

    std::span<Number> shaped(std::initializer_list<size_t> shape, const char* name) const {
        return is_given_ ? array_.shaped(shape, name) : std::span<Number>();
    }
    std::span<Number> vector(size_t size, const char* name) const { return shaped({size}, name); }
    MatrixSpan<Number> matrix(size_t rows, size_t columns, const char* name) const {
        return is_given_ ? array_.matrix(rows, columns, name) : MatrixSpan<Number>();
    }

private:
    bool is_given_;
    Array<Number> array_;
};

using OptionalIn = OptionalArray<const double>;
using OptionalOut = OptionalArray<double>;

}  // namespace armctl
