#include "arguments.hpp"

#include <cmath>

#include "errors.hpp"

namespace armctl {

namespace {

double checked_gain(double value, const char* name) {
    if (!(value >= 0.0) || std::isinf(value)) {
        throw InputError(std::string(name) + ": need a finite number of at least 0, got " + std::to_string(value));
    }
    return value;
}

Numbers sized(const Arguments& given, size_t size, const char* name) {
    const size_t length = given.length(name);
    if (length != size) {
        throw InputError(std::string(name) + ": need " + std::to_string(size) + " numbers, got " + std::to_string(length));
    }
    const Vector values = given.vector(size, name);
    return {values.begin(), values.end()};
}

}  // namespace

double Arguments::gain(const char* name) const { return checked_gain(number(name), name); }

Numbers Arguments::gains(size_t size, const char* name) const {
    Numbers values = sized(*this, size, name);
    for (const double value : values) { checked_gain(value, name); }
    return values;
}

Numbers Arguments::limits(size_t size, const char* name) const {
    Numbers values = sized(*this, size, name);
    for (const double value : values) {
        if (!(value >= 0.0)) { throw InputError(std::string(name) + ": need numbers of at least 0, got " + std::to_string(value)); }
    }
    return values;
}

}  // namespace armctl
