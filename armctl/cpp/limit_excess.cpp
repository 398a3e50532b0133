#include "limit_excess.hpp"

#include <algorithm>
#include <array>
#include <cmath>

namespace armctl {

namespace {

constexpr size_t max_parts = 63;  // of a piece that wait to be halved: halving one leaves one more
constexpr int max_halvings = 400;
constexpr double rounding = 1e-14;  // relative to the largest coefficient

// Bernstein coefficients of a polynomial on its interval.
using Bernstein = std::array<double, max_polynomial_degree + 1>;

struct Bounds {
    double low;
    double high;

    double excess(double value) const { return std::max(value - high, low - value); }
};

// From powers to the Bernstein basis: element (i, k) is C(i, k) / C(degree, k).
using BasisChange = std::array<Bernstein, max_polynomial_degree + 1>;

BasisChange basis_change(size_t degree) {
    BasisChange change{};
    for (size_t k = 0; k <= degree; ++k) {
        double weight = 1.0;
        for (size_t i = k; i <= degree; ++i) {
            change[i][k] = weight;
            weight *= static_cast<double>(i + 1) / static_cast<double>(i + 1 - k);
        }
        for (size_t i = k; i < degree; ++i) { change[i][k] /= change[degree][k]; }
        change[degree][k] = 1.0;
    }
    return change;
}

// An upper bound on how far a polynomial leaves its bounds.
double excess_of_hull(const Bernstein& b, size_t degree, const Bounds& bounds) {
    double most = bounds.excess(b[0]);
    for (size_t i = 1; i <= degree; ++i) { most = std::max(most, bounds.excess(b[i])); }
    return most;
}

// Replaces a polynomial by its left half; `right` becomes its right half.
void halve(Bernstein& b, size_t degree, Bernstein& right) {
    right[degree] = b[degree];
    for (size_t level = 1; level <= degree; ++level) {
        for (size_t i = degree; i >= level; --i) { b[i] = 0.5 * (b[i] + b[i - 1]); }
        right[degree - level] = b[degree];
    }
}

// How far a polynomial leaves its bounds; at most 0 where it does not.
double exact_excess(const Bernstein& b, size_t degree, const Bounds& bounds) {
    const double most = excess_of_hull(b, degree, bounds);
    if (most <= 0.0) { return most; }
    double size = 0.0;
    for (size_t i = 0; i <= degree; ++i) { size = std::max(size, std::abs(b[i])); }
    double found = std::max(bounds.excess(b[0]), bounds.excess(b[degree]));
    double threshold = std::max(found, 0.0) + rounding * size;
    std::array<Bernstein, max_parts + 1> parts;
    parts[0] = b;
    size_t count = most > threshold ? 1 : 0;
    for (int halving = 0; halving < max_halvings && count > 0 && count < max_parts; ++halving) {
        --count;
        Bernstein& left = parts[count];
        Bernstein& right = parts[count + 1];
        halve(left, degree, right);
        found = std::max(found, bounds.excess(left[degree]));
        threshold = std::max(found, 0.0) + rounding * size;
        const bool keeps_left = excess_of_hull(left, degree, bounds) > threshold;
        const bool keeps_right = excess_of_hull(right, degree, bounds) > threshold;
        if (keeps_right && !keeps_left) { left = right; }
        count += static_cast<size_t>(keeps_left) + static_cast<size_t>(keeps_right);
    }
    // The parts that are left may exceed what has been found: the result is a bound then, and not exact.
    for (size_t k = 0; k < count; ++k) { found = std::max(found, excess_of_hull(parts[k], degree, bounds)); }
    return found;
}

}  // namespace

void limit_excess(const PolynomialSpan& motion, Vector steps, size_t order, Matrix low, Matrix high, MatrixResult excess) {
    const size_t degree = motion.degree - order;
    const BasisChange change = basis_change(degree);
    Bernstein factors{};  // of the coefficients of the derivative
    for (size_t k = 0; k <= degree; ++k) {
        factors[k] = 1.0;
        for (size_t r = 0; r < order; ++r) { factors[k] *= static_cast<double>(k + 1 + r); }
    }
    for (size_t p = 0; p < steps.size(); ++p) {
        for (size_t i = 0; i < motion.joints; ++i) {
            Bernstein powers{};  // of the share of the piece
            double power = 1.0;
            for (size_t k = 0; k <= degree; ++k) {
                powers[k] = factors[k] * motion(p, k + order, i) * power;
                power *= steps[p];
            }
            Bernstein b{};
            for (size_t r = 0; r <= degree; ++r) {
                for (size_t k = 0; k <= r; ++k) { b[r] += change[r][k] * powers[k]; }
            }
            excess(p, i) = exact_excess(b, degree, Bounds{low(p, i), high(p, i)});
        }
    }
}

}  // namespace armctl
