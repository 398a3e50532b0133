// Many polynomials of one degree, and where they are greatest and least on [0, 1].
#pragma once

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

// The points where derivatives of polynomials may be greatest or least on [0, 1], and their values there: both ends and every
// turning point between them. The results have a row for each piece and joint, of as many columns as the derivative has
// coefficients, but at least 2; a column that is not needed repeats the point 0.
void polynomial_extremes(const PolynomialSpan& polynomials, size_t order, MatrixResult places, MatrixResult values);

}  // namespace armctl
