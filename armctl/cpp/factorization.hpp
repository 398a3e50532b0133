// Symmetric positive definite matrices, of which the lower triangle counts, as L D L^T in place.
//
// Source: Golub and Van Loan, Matrix Computations (2013), 4.1.2. There is one division per row, and no root.
#pragma once
#include "spans.hpp"

namespace armctl {

// The lower triangle becomes that of L, whose diagonal is 1, the diagonal the inverse of D, and the upper triangle D L^T.
void factorize(MatrixResult M);

// Replaces the lower triangle of what `factorize` leaves by the Cholesky factor L D^1/2; `solve` cannot use it.
void take_roots(MatrixResult factors);

// Replaces x by the solution of M solution = x, with M as `factorize` leaves it.
void solve(Matrix factors, Result x);

// product = M x, with M as `factorize` leaves it.
void multiply(Matrix factors, Vector x, Result product);

}  // namespace armctl
