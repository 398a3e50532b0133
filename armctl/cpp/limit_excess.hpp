// How far piecewise polynomials leave their bounds.
//
// A polynomial on an interval lies between the least and the greatest of its Bernstein coefficients (Farouki, "The Bernstein
// polynomial basis: a centennial retrospective", Computer Aided Geometric Design 29(6), 2012). Most pieces are inside their
// bounds by that alone. The others are halved, by de Casteljau's rule, until no part can exceed what has been found at the ends
// of parts.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>

#include "spans.hpp"

namespace armctl {

constexpr size_t max_polynomial_degree = 15;

// The polynomials of each joint in each piece of a motion: (pieces, degree + 1, joints) coefficients, constant first. The
// degree is at most max_polynomial_degree.
struct PolynomialSpan {
    Vector coefficients;
    size_t pieces;
    size_t degree;
    size_t joints;

    double operator()(size_t piece, size_t power, size_t joint) const {
        return coefficients[(piece * (degree + 1) + power) * joints + joint];
    }
};

constexpr size_t max_parts = 63;  // of a piece that wait to be halved: halving one leaves one more
constexpr int max_halvings = 400;
constexpr double rounding = 1e-14;  // relative to the largest coefficient

// Bernstein coefficients of a polynomial on its interval.
using Bernstein = std::array<double, max_polynomial_degree + 1>;

struct ValueBounds {
    double low;
    double high;

    double excess(double value) const { return std::max(value - high, low - value); }
};

// From powers to the Bernstein basis: element (i, k) is C(i, k) / C(degree, k).
using BasisChange = std::array<Bernstein, max_polynomial_degree + 1>;

inline BasisChange basis_change(size_t degree) {
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
inline double excess_of_hull(const Bernstein& b, size_t degree, const ValueBounds& bounds) {
    double most = bounds.excess(b[0]);
    for (size_t i = 1; i <= degree; ++i) { most = std::max(most, bounds.excess(b[i])); }
    return most;
}

// Replaces a polynomial by its left half; `right` becomes its right half.
inline void halve(Bernstein& b, size_t degree, Bernstein& right) {
    right[degree] = b[degree];
    for (size_t level = 1; level <= degree; ++level) {
        for (size_t i = degree; i >= level; --i) { b[i] = 0.5 * (b[i] + b[i - 1]); }
        right[degree - level] = b[degree];
    }
}

// How far a polynomial leaves its bounds; at most 0 where it does not.
inline double exact_excess(const Bernstein& b, size_t degree, const ValueBounds& bounds) {
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

// How far a derivative of each joint leaves [low, high] in each piece, (pieces, joints): exact where it is greater than 0, else
// any number of at most 0. The powers of the polynomials are those of the time since their piece began; `steps` (pieces) s are
// the lengths of the pieces.
inline void limit_excess(const PolynomialSpan& motion, Vector steps, size_t order, Matrix low, Matrix high, MatrixResult excess) {
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
            excess(p, i) = exact_excess(b, degree, ValueBounds{low(p, i), high(p, i)});
        }
    }
}

}  // namespace armctl
