// How far piecewise polynomials leave their bounds.
//
// A polynomial on an interval lies between the least and the greatest of its Bernstein coefficients (Farouki, "The Bernstein
// polynomial basis: a centennial retrospective", Computer Aided Geometric Design 29(6), 2012). Most pieces are inside their
// bounds by that alone. The others are halved, by de Casteljau's rule, until no part can exceed what has been found at the ends
// of parts.
#pragma once

#include "polynomials.hpp"

namespace armctl {

// How far a derivative of each joint leaves [low, high] in each piece, (pieces, joints): exact where it is greater than 0, else
// any number of at most 0. The powers of the polynomials are those of the time since their piece began; `steps` (pieces) s are
// the lengths of the pieces.
void limit_excess(const PolynomialSpan& motion, Vector steps, size_t order, Matrix low, Matrix high, MatrixResult excess);

}  // namespace armctl
