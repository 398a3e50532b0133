// The extension armctl._core: one call for each topic.
#include <nanobind/nanobind.h>

#include "source_checksum.hpp"
#include "topics.hpp"

namespace nb = nanobind;

NB_MODULE(_core, module) {
    // An extension that was built from other sources than those beside it is never used.
    const nb::module_ compiled_core = nb::module_::import_("armctl.core.compiled_core");
    const nb::object problem = compiled_core.attr("build_problem")(module.attr("__file__"), armctl::SOURCE_CHECKSUM);
    if (nb::len(problem) > 0) { throw nb::import_error(nb::str(problem).c_str()); }
#ifndef ARMCTL_SANITIZE
    // A program that ends while threads run leaves objects behind; what nanobind prints about them helps only with bindings.
    nb::set_leak_warnings(false);
#endif
    module.doc() = "The compiled core of armctl. It computes; the Python modules that use it check and explain.";
    armctl::bind_arm_motion(module);
    armctl::bind_collision(module);
    armctl::bind_dynamics(module);
    armctl::bind_environments(module);
    armctl::bind_errors(module);
    armctl::bind_ik(module);
    armctl::bind_laws(module);
    armctl::bind_motion(module);
    armctl::bind_planning(module);
    armctl::bind_tick_loop(module);
}
