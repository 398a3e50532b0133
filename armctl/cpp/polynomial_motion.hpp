// Motions by polynomials of time, and bounds of them in an interval.
#pragma once
#include <array>
#include <cmath>
#include <vector>

#include "errors.hpp"
#include "spans.hpp"

namespace armctl {

constexpr double UNIT_KNOTS[] = {0.0, 1.0};

// A motion of all joints by polynomials of time, of degree 1 to 5.
class PolynomialMotion {
public:
    static constexpr size_t MAX_DEGREE = 5;

    // `coefficients` (pieces, degree + 1, m), by powers of the time since the knot of the piece, row by row; `knots` (pieces + 1,)
    // s.
    void set(Vector knots, Vector coefficients, size_t joints) {
        if (knots.size() < 2) { throw InputError("knots: need at least two"); }
        joints_ = joints;
        powers_ = joints > 0 ? coefficients.size() / ((knots.size() - 1) * joints) : 2;
        if (powers_ < 2 || powers_ > MAX_DEGREE + 1) { throw InputError("coefficients: need polynomials of degree 1 to 5"); }
        knots_.assign(knots.begin(), knots.end());
        coefficients_.assign(coefficients.begin(), coefficients.end());
    }

    // The straight line of all joints, (m,), in the time from 0 to 1.
    void set_line(Vector start, Vector end) {
        std::vector<double> coefficients(start.begin(), start.end());
        for (size_t i = 0; i < start.size(); ++i) { coefficients.push_back(end[i] - start[i]); }
        set(UNIT_KNOTS, coefficients, start.size());
    }

    size_t pieces() const { return knots_.size() - 1; }
    double knot(size_t index) const { return knots_[index]; }
    double length(size_t piece) const { return knots_[piece + 1] - knots_[piece]; }

    // The positions (m,) in the middle of an interval of one piece, and how far each joint leaves them at most. Times count from
    // the piece's knot.
    //
    // The sum of |derivative k / k!| half^k; these Taylor coefficients at the middle come from repeated synthetic division (the
    // Horner scheme).
    void bound(size_t piece, double middle, double half, Result positions, Result delta) const {
        std::array<double, MAX_DEGREE + 1> taylor{};
        for (size_t i = 0; i < joints_; ++i) {
            for (size_t k = 0; k < powers_; ++k) { taylor[k] = coefficients_[(piece * powers_ + k) * joints_ + i]; }
            for (size_t first = 0; first + 1 < powers_; ++first) {
                for (size_t k = powers_ - 1; k-- > first;) { taylor[k] += middle * taylor[k + 1]; }
            }
            positions[i] = taylor[0];
            delta[i] = 0.0;
            for (size_t k = powers_ - 1; k > 0; --k) { delta[i] = half * (std::abs(taylor[k]) + delta[i]); }
        }
    }

    // What the velocities (m,) in the middle of an interval of one piece move the joints by up to its end.
    void tangent(size_t piece, double middle, double half, Result moves) const {
        for (size_t i = 0; i < joints_; ++i) {
            double velocity = 0.0;
            for (size_t k = powers_ - 1; k > 0; --k) {
                velocity = middle * velocity + static_cast<double>(k) * coefficients_[(piece * powers_ + k) * joints_ + i];
            }
            moves[i] = half * velocity;
        }
    }

private:
    std::vector<double> knots_;
    std::vector<double> coefficients_;
    size_t powers_ = 2;
    size_t joints_ = 0;
};

}  // namespace armctl
