// The keyword arguments of a call that takes many arrays, as spans that live as long as this object.
#pragma once
#include <deque>

#include "arrays.hpp"

namespace armctl {

class NamedArrays {
public:
    explicit NamedArrays(const nanobind::kwargs& arguments) : arguments_(arguments) {}

    // Arrays of the lengths that are given; the first one may be left out where any is right.
    Vector vector(const char* name) { return vector(name, numbers(name).length(name)); }
    Vector vector(const char* name, size_t size) { return numbers(name).vector(size, name); }
    Matrix matrix(const char* name, size_t columns) { return matrix(name, numbers(name).length(name), columns); }
    Matrix matrix(const char* name, size_t rows, size_t columns) { return numbers(name).matrix(rows, columns, name); }
    Integers integers(const char* name) { return integers(name, whole_numbers(name).length(name)); }
    Integers integers(const char* name, size_t size) { return whole_numbers(name).vector(size, name); }

    // Rotation matrices (count, 3, 3), a row of nine numbers each.
    Matrix rotations(const char* name, size_t count) { return {numbers(name).shaped({count, 3, 3}, name).data(), count, 9}; }

    template <class Value>
    Value value(const char* name) const {
        return nanobind::cast<Value>(argument(name));
    }

    bool has(const char* name) const { return arguments_.contains(name); }

    const In& numbers(const char* name) { return acquired(numbers_, name); }
    const IntegersIn& whole_numbers(const char* name) { return acquired(whole_numbers_, name); }

private:
    nanobind::object argument(const char* name) const {
        if (!has(name)) { throw InputError(std::string(name) + ": missing"); }
        return arguments_[name];
    }

    template <class Arrays>
    typename Arrays::reference acquired(Arrays& arrays, const char* name) const {
        arrays.emplace_back().acquire(argument(name).ptr());
        return arrays.back();
    }

    nanobind::kwargs arguments_;
    std::deque<In> numbers_;
    std::deque<IntegersIn> whole_numbers_;
};

}  // namespace armctl
