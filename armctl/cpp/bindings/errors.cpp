// The errors of the core as armctl's exceptions.
#include "errors.hpp"

#include <exception>

#include "topics.hpp"

namespace nb = nanobind;

namespace armctl {

namespace {

// The exception of a name in armctl.core.errors. It is imported when it is needed, so that the core can be imported first.
void set_python_error(const char* name, const char* message) {
    const nb::object type = nb::module_::import_("armctl.core.errors").attr(name);
    PyErr_SetString(type.ptr(), message);
}

}  // namespace

void bind_errors(nb::module_&) {
    nb::register_exception_translator([](const std::exception_ptr& thrown, void*) {
        try {
            std::rethrow_exception(thrown);
        } catch (const InputError& error) { set_python_error("InputError", error.what()); }
    });
}

}  // namespace armctl
