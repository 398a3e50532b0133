#include <algorithm>
#include <cmath>

#include "clearance_proof.hpp"
#include "errors.hpp"

namespace armctl {

namespace {

constexpr double UNIT_KNOTS[] = {0.0, 1.0};

}  // namespace

void PolynomialMotion::set(Vector knots, Vector coefficients, size_t joints) {
    if (knots.size() < 2) { throw InputError("knots: need at least two"); }
    joints_ = joints;
    powers_ = joints > 0 ? coefficients.size() / ((knots.size() - 1) * joints) : 2;
    if (powers_ < 2 || powers_ > MAX_DEGREE + 1) { throw InputError("coefficients: need polynomials of degree 1 to 5"); }
    knots_.assign(knots.begin(), knots.end());
    coefficients_.assign(coefficients.begin(), coefficients.end());
    bound_ranges();
}

void PolynomialMotion::set_line(Vector start, Vector end) {
    std::vector<double> coefficients(start.begin(), start.end());
    for (size_t i = 0; i < start.size(); ++i) { coefficients.push_back(end[i] - start[i]); }
    set(UNIT_KNOTS, coefficients, start.size());
}

void PolynomialMotion::bound_ranges() {
    range_middles_.resize(pieces() * joints_);
    range_deltas_.resize(pieces() * joints_);
    for (size_t piece = 0; piece < pieces(); ++piece) {
        const double half = 0.5 * (knots_[piece + 1] - knots_[piece]);
        bound_interval(piece, half, half, {range_middles_.data() + piece * joints_, joints_},
                       {range_deltas_.data() + piece * joints_, joints_});
    }
}

size_t PolynomialMotion::piece_at(double time, size_t piece) const {
    while (piece + 1 < pieces() && knots_[piece + 1] <= time) { ++piece; }
    return piece;
}

void PolynomialMotion::evaluate(size_t piece, double time, Result positions) const {
    for (size_t i = 0; i < joints_; ++i) {
        double value = 0.0;
        for (size_t power = powers_; power > 0; --power) { value = value * time + coefficient(piece, power - 1, i); }
        positions[i] = value;
    }
}

// The sum of |derivative k / k!| half^k; these Taylor coefficients at the middle come from repeated synthetic division (the
// Horner scheme).
void PolynomialMotion::bound_interval(size_t piece, double middle, double half, Result positions, Result delta) const {
    for (size_t i = 0; i < joints_; ++i) {
        const double c0 = coefficient(piece, 0, i);
        const double c1 = coefficient(piece, 1, i);
        if (powers_ == 2) {
            positions[i] = c0 + middle * c1;
            delta[i] = std::abs(c1) * half;
            continue;
        }
        const double c2 = coefficient(piece, 2, i);
        const double c3 = powers_ > 3 ? coefficient(piece, 3, i) : 0.0;
        const double c4 = powers_ > 4 ? coefficient(piece, 4, i) : 0.0;
        const double c5 = powers_ > 5 ? coefficient(piece, 5, i) : 0.0;
        positions[i] = c0 + middle * (c1 + middle * (c2 + middle * (c3 + middle * (c4 + middle * c5))));
        const double d1 = c1 + middle * (2.0 * c2 + middle * (3.0 * c3 + middle * (4.0 * c4 + middle * 5.0 * c5)));
        const double d2 = c2 + middle * (3.0 * c3 + middle * (6.0 * c4 + middle * 10.0 * c5));
        const double d3 = c3 + middle * (4.0 * c4 + middle * 10.0 * c5);
        const double d4 = c4 + middle * 5.0 * c5;
        delta[i] = half * (std::abs(d1) + half * (std::abs(d2) + half * (std::abs(d3) + half * (std::abs(d4) + half * std::abs(c5)))));
    }
}

void PolynomialMotion::bound_pieces(size_t first, size_t last, double middle, Result positions, Result delta) const {
    const size_t at = piece_at(middle, first);
    evaluate(at, middle - knots_[at], positions);
    std::fill(delta.begin(), delta.end(), 0.0);
    for (size_t piece = first; piece <= last; ++piece) {
        for (size_t i = 0; i < joints_; ++i) {
            const size_t at_range = piece * joints_ + i;
            delta[i] = std::max(delta[i], std::abs(range_middles_[at_range] - positions[i]) + range_deltas_[at_range]);
        }
    }
}

}  // namespace armctl
