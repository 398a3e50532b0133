// How far piecewise polynomials leave their bounds.
//
// A polynomial on an interval lies between the least and the greatest of its Bernstein coefficients (Farouki, "The Bernstein
// polynomial basis: a centennial retrospective", Computer Aided Geometric Design 29(6), 2012). Most pieces are inside their
// bounds by that alone. The others are halved, by de Casteljau's rule, until no part can exceed what has been found at the ends
// of parts.
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

// How far a derivative of each joint leaves [low, high] in each piece, (pieces, joints): exact where it is greater than 0, else
// any number of at most 0. The powers of the polynomials are those of the time since their piece began; `steps` (pieces) s are
// the lengths of the pieces.
void limit_excess(const PolynomialSpan& motion, Vector steps, size_t order, Matrix low, Matrix high, MatrixResult excess);

}  // namespace armctl
