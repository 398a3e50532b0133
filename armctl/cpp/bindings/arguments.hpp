// Simulations of MuJoCo as arguments.
#pragma once
#include "../arguments.hpp"
#include "../mujoco_api.hpp"
#include "arrays.hpp"

namespace armctl {

// The address of a mujoco.MjModel. What keeps it has to keep `model` alive, by nb::keep_alive.
const MujocoModel* mujoco_model(nanobind::handle model);

// The simulation of a mujoco.MjModel and a mujoco.MjData. What keeps it has to keep `data` alive, by nb::keep_alive.
MujocoSimulation mujoco_simulation(nanobind::handle model, nanobind::handle data);

}  // namespace armctl
