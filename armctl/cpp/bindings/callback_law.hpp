// A law in Python.
#pragma once
#include <nanobind/nanobind.h>

#include <limits>
#include <optional>
#include <utility>

#include "../law.hpp"
#include "arrays.hpp"

namespace armctl {

// Calls a function of Python that writes the torque into an array. It takes Python's lock for the call only; whoever makes, copies or
// destroys such a law has it.
//
// `torque` throws nothing, for MuJoCo's errors leave the ticks around it by longjmp: an exception is kept, the torque becomes NaN, which
// ends the ticks, and `raise` raises the exception when they have ended.
class CallbackLaw : public Cloneable<CallbackLaw> {
public:
    // `tau` is a writable array (n,), which `call()` writes.
    CallbackLaw(nanobind::object call, nanobind::object tau)
        : Cloneable(written(tau).size()), call_(std::move(call)), array_(std::move(tau)), tau_(written(array_)) {}

    void torque(const State& /*state*/, const Setpoint& /*setpoint*/, Result tau) noexcept override {
        const nanobind::gil_scoped_acquire acquire;
        PyObject* none = PyObject_CallNoArgs(call_.ptr());
        if (none == nullptr) {
            error_.emplace();  // takes the exception
            std::ranges::fill(tau, std::numeric_limits<double>::quiet_NaN());
            return;
        }
        Py_DECREF(none);
        copy(tau_, tau);
    }

    // Raises the exception of the last call, if it raised one.
    void raise() {
        if (!error_) { return; }
        nanobind::python_error error = std::move(*error_);
        error_.reset();
        throw error;
    }

private:
    static Result written(const nanobind::object& array) {
        Out out;
        out.acquire(array.ptr());
        return out.vector(out.length("tau"), "tau");
    }

    nanobind::object call_;
    nanobind::object array_;  // keeps the numbers of `tau_`
    Vector tau_;
    std::optional<nanobind::python_error> error_;
};

}  // namespace armctl
