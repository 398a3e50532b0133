// Shortest solutions of small linear least-squares problems.
#pragma once
#include "spans.hpp"

namespace armctl {

// Adds to x (r,) the shortest vector that minimizes |A^T x - b|, by one-sided Jacobi rotations of the rows of A (r, n). The
// rows become orthogonal; `rotations` (r, r) is scratch. Rows of less than rounding errors count as zero.
//
// After Hestenes (1958), see Golub and Van Loan, Matrix Computations (2013), 8.6.3.
void solve_least_squares(MatrixResult A, Vector b, MatrixResult rotations, Result x);

}  // namespace armctl
