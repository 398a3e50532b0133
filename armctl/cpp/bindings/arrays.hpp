// Arrays of Python as spans, by the buffer protocol, which takes a tenth of the time of nanobind's own array type.
//
// A binding declares its arguments as `In` or `Out` and takes the span from them with the length that it needs:
//
//     [](const Dynamics& dynamics, const In& q, const Out& tau) { dynamics.gravity(q.vector(n, "q"), tau.vector(n, "tau")); }
//
// An array that is not contiguous, of another type or length, or read-only where it is written, raises InputError.
#pragma once
#include <nanobind/nanobind.h>

#include <algorithm>
#include <initializer_list>
#include <vector>

#include "errors.hpp"
#include "spans.hpp"

namespace armctl {

// Number is double or std::int64_t, and const where the array is only read.
template <class Number>
class Array {
public:
    Array() = default;
    Array(const Array&) = delete;
    Array& operator=(const Array&) = delete;
    ~Array() { PyBuffer_Release(&view_); }

    // Takes the memory of an object. What is wrong with it is reported by `vector` and `matrix`, which know the argument's name.
    void acquire(PyObject* object) noexcept {
        is_none_ = object == Py_None;
        const int access = std::is_const_v<Number> ? PyBUF_SIMPLE : PyBUF_WRITABLE;
        if (PyObject_GetBuffer(object, &view_, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | access) != 0) {
            PyErr_Clear();
            view_ = {};
        }
    }

    // An array of a shape, as its numbers.
    std::span<Number> shaped(std::initializer_list<size_t> shape, const char* name) const {
        require_type(name);
        if (!std::equal(shape.begin(), shape.end(), view_.shape, view_.shape + view_.ndim, is_same_length)) {
            throw InputError(std::string(name) + ": need an array of shape " + text(shape) + ", got " +
                             text(std::vector<size_t>(view_.shape, view_.shape + view_.ndim)));
        }
        return {static_cast<Number*>(view_.buf), static_cast<size_t>(view_.len) / sizeof(Number)};
    }

    // Whether it is an array of shape (size,): for callers that have another way for other objects.
    bool is_vector(size_t size) const {
        return view_.obj != nullptr && has_type() && view_.ndim == 1 && is_same_length(size, view_.shape[0]);
    }

    // An array of shape (size,).
    std::span<Number> vector(size_t size, const char* name) const { return shaped({size}, name); }

    // The same, or an empty span for None.
    std::span<Number> optional_vector(size_t size, const char* name) const { return is_none_ ? std::span<Number>() : vector(size, name); }

    // An array of shape (rows, columns).
    MatrixSpan<Number> matrix(size_t rows, size_t columns, const char* name) const {
        return {shaped({rows, columns}, name).data(), rows, columns};
    }

    int dimensions() const { return view_.ndim; }

    // A dimension, where any is right: `x.matrix(x.length("x"), 3, "x")`.
    size_t length(const char* name, int axis = 0) const {
        require_type(name);
        if (view_.ndim <= axis) {
            const std::string dimensions = axis == 0 ? "one dimension" : std::to_string(axis + 1) + " dimensions";
            throw InputError(std::string(name) + ": need an array with at least " + dimensions);
        }
        return static_cast<size_t>(view_.shape[axis]);
    }

private:
    static constexpr bool is_integer = std::is_integral_v<Number>;

    bool has_type() const {
        if (view_.obj == nullptr || view_.format == nullptr || view_.itemsize != sizeof(Number) || view_.format[1] != '\0') {
            return false;
        }
        // int64 is 'l' or 'q', depending on the platform.
        const char type = view_.format[0];
        return is_integer ? (type == 'l' || type == 'q') : type == 'd';
    }

    void require_type(const char* name) const {
        if (!has_type()) {
            throw InputError(std::string(name) + ": need a contiguous" + (std::is_const_v<Number> ? "" : ", writable") + " array of type " +
                             (is_integer ? "int64" : "float64"));
        }
    }

    static bool is_same_length(size_t expected, Py_ssize_t given) { return static_cast<Py_ssize_t>(expected) == given; }

    // A shape as Python writes it: (3,) or (2, 3).
    static std::string text(const std::vector<size_t>& shape) {
        std::string lengths;
        for (size_t axis = 0; axis < shape.size(); ++axis) { lengths += (axis > 0 ? ", " : "") + std::to_string(shape[axis]); }
        return "(" + lengths + (shape.size() == 1 ? ",)" : ")");
    }

    Py_buffer view_{};
    bool is_none_ = false;
};

using In = Array<const double>;
using Out = Array<double>;
using IntegersIn = Array<const std::int64_t>;
using IntegersOut = Array<std::int64_t>;

}  // namespace armctl

template <class Number>
struct nanobind::detail::type_caster<armctl::Array<Number>> {
    NB_TYPE_CASTER(armctl::Array<Number>, const_name("numpy.ndarray"))

    bool from_python(handle source, uint8_t, cleanup_list*) noexcept {
        value.acquire(source.ptr());
        return true;
    }
};
