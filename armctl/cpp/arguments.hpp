// Named values from which an object is made, such as the gains of a law. The bindings take them from Python's keyword arguments.
#pragma once
#include <initializer_list>

#include "linear_algebra.hpp"

namespace armctl {

// All functions throw InputError with the name if there is no such value, or if it is not what is asked for.
class Arguments {
public:
    virtual ~Arguments() = default;

    // Whether there is such a value, and not None.
    virtual bool has(const char* name) const = 0;

    virtual double number(const char* name) const = 0;
    virtual std::int64_t integer(const char* name) const = 0;

    // Arrays of a shape, as their numbers.
    virtual Vector shaped(std::initializer_list<size_t> shape, const char* name) const = 0;
    virtual Result writable(std::initializer_list<size_t> shape, const char* name) const = 0;
    virtual std::span<const std::int64_t> integers(size_t size, const char* name) const = 0;
    virtual std::span<std::int64_t> writable_integers(size_t size, const char* name) const = 0;

    // The first dimension of an array.
    virtual size_t length(const char* name) const = 0;

    bool flag(const char* name) const { return number(name) != 0.0; }
    size_t count(const char* name) const { return static_cast<size_t>(integer(name)); }
    Vector vector(size_t size, const char* name) const { return shaped({size}, name); }
    Matrix matrix(size_t rows, size_t columns, const char* name) const { return {shaped({rows, columns}, name).data(), rows, columns}; }
    MatrixResult writable_matrix(size_t rows, size_t columns, const char* name) const {
        return {writable({rows, columns}, name).data(), rows, columns};
    }

    // A finite number of at least 0.
    double gain(const char* name) const;
    Numbers gains(size_t size, const char* name) const;

    // Numbers of at least 0, or infinite.
    Numbers limits(size_t size, const char* name) const;
};

}  // namespace armctl
