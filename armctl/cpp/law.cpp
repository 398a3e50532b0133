#include "law.hpp"

#include <algorithm>
#include <cmath>
#include <string>

#include "errors.hpp"

namespace armctl {

namespace {

void require_length(const std::vector<double>& values, size_t n, const char* name) {
    if (values.size() != n) {
        throw InputError(std::string(name) + ": need " + std::to_string(n) + " numbers, got " + std::to_string(values.size()));
    }
}

}  // namespace

void Law::reset() { std::ranges::fill(memory(), 0.0); }

double checked_gain(double value, const char* name) {
    if (!(value >= 0.0) || std::isinf(value)) {
        throw InputError(std::string(name) + ": need a finite number of at least 0, got " + std::to_string(value));
    }
    return value;
}

std::vector<double> checked_gains(std::vector<double> values, size_t n, const char* name) {
    require_length(values, n, name);
    for (const double value : values) { checked_gain(value, name); }
    return values;
}

std::vector<double> checked_limits(std::vector<double> values, size_t n, const char* name) {
    require_length(values, n, name);
    for (const double value : values) {
        if (!(value >= 0.0)) { throw InputError(std::string(name) + ": need numbers of at least 0, got " + std::to_string(value)); }
    }
    return values;
}

double checked_period(double dt) { return checked_gain(dt, "dt"); }

}  // namespace armctl
