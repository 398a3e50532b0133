// Python's keyword arguments, and simulations of MuJoCo.
#pragma once
#include "../arguments.hpp"
#include "../mujoco_api.hpp"
#include "arrays.hpp"

namespace armctl {

// Its arrays stay where they are as long as this object exists.
class KeywordArguments final : public Arguments {
public:
    explicit KeywordArguments(nanobind::kwargs given) : given_(std::move(given)) {}

    bool has(const char* name) const override { return find(name).is_valid() && !find(name).is_none(); }
    double number(const char* name) const override;
    std::int64_t integer(const char* name) const override;
    size_t length(const char* name) const override;

    Vector shaped(std::initializer_list<size_t> shape, const char* name) const override { return array<const double>(shape, name); }
    Result writable(std::initializer_list<size_t> shape, const char* name) const override { return array<double>(shape, name); }
    std::span<const std::int64_t> integers(size_t size, const char* name) const override { return array<const std::int64_t>({size}, name); }
    std::span<std::int64_t> writable_integers(size_t size, const char* name) const override { return array<std::int64_t>({size}, name); }

private:
    nanobind::handle find(const char* name) const { return PyDict_GetItemString(given_.ptr(), name); }
    nanobind::handle value(const char* name) const;

    template <class Number>
    std::span<Number> array(std::initializer_list<size_t> shape, const char* name) const {
        Array<Number> array;
        array.acquire(value(name).ptr());
        return array.shaped(shape, name);
    }

    nanobind::kwargs given_;
};

// The address of a mujoco.MjModel. What keeps it has to keep `model` alive, by nb::keep_alive.
const MujocoModel* mujoco_model(nanobind::handle model);

// The simulation of a mujoco.MjModel and a mujoco.MjData. What keeps it has to keep `data` alive, by nb::keep_alive.
MujocoSimulation mujoco_simulation(nanobind::handle model, nanobind::handle data);

}  // namespace armctl
