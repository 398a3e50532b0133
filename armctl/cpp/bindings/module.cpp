// The extension armctl._core: one call for each topic.

#include <exception>

#include "errors.hpp"
#include "source_checksum.hpp"
#include "topics.hpp"

namespace nb = nanobind;

namespace {

// Raises an error of the core as the exception of that name in armctl.core.errors, which is imported when it is needed, so that the
// core can be imported first.
void translate(const std::exception_ptr& thrown, void*) {
    try {
        std::rethrow_exception(thrown);
    } catch (const armctl::InputError& error) {
        PyErr_SetString(nb::module_::import_("armctl.core.errors").attr("InputError").ptr(), error.what());
    }
}

}  // namespace

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
    nb::register_exception_translator(translate);
    armctl::bind_arm_motion(module);
    armctl::bind_collision(module);
    armctl::bind_loop_closure(module);
    armctl::bind_dynamics(module);
    armctl::bind_environments(module);
    armctl::bind_ik(module);
    armctl::bind_laws(module);
    armctl::bind_motion(module);
    armctl::bind_planning(module);
    armctl::bind_tick_loop(module);
    armctl::bind_tree_ik(module);
}
