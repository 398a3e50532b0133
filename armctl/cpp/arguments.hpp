// Named values from which an object is made, such as the gains of a law: Python's keyword arguments.
#pragma once
#include <initializer_list>

#include "linear_algebra.hpp"

namespace nanobind {
class kwargs;
}

namespace armctl {

// All functions throw InputError with the name if there is no such value, or if it is not what is asked for. The keyword
// arguments have to exist as long as this object and the arrays from it; bindings/arguments.cpp reads them.
class Arguments {
public:
    explicit Arguments(const nanobind::kwargs& given) : given_(&given) {}

    // Whether there is such a value, and not None.
    bool has(const char* name) const;

    double number(const char* name) const;
    std::int64_t integer(const char* name) const;

    // An array of a shape, as its numbers: double or std::int64_t, const where they are only read.
    template <class Number>
    std::span<Number> array(std::initializer_list<size_t> shape, const char* name) const;

    // The first dimension of an array.
    size_t length(const char* name) const;

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

    // A copy of a vector, such as a gain for each joint.
    Numbers numbers(size_t size, const char* name) const {
        const Vector values = vector(size, name);
        return {values.begin(), values.end()};
    }

    // The same of any length.
    Numbers numbers(const char* name) const { return numbers(length(name), name); }
    Integers integers(const char* name) const { return integers(length(name), name); }

private:
    const nanobind::kwargs* given_;
};

}  // namespace armctl
