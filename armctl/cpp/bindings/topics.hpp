// One function for each topic of the bindings; each is defined in a file of its own and called in module.cpp.
#pragma once
#include <nanobind/nanobind.h>

namespace armctl {

void bind_arm_motion(nanobind::module_& module);
void bind_collision(nanobind::module_& module);
void bind_dynamics(nanobind::module_& module);
void bind_environments(nanobind::module_& module);
void bind_ik(nanobind::module_& module);
void bind_laws(nanobind::module_& module);
void bind_loop_closure(nanobind::module_& module);
void bind_motion(nanobind::module_& module);
void bind_planning(nanobind::module_& module);
void bind_tick_loop(nanobind::module_& module);
void bind_tree_ik(nanobind::module_& module);

}  // namespace armctl
