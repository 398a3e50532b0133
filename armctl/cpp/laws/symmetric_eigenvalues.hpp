// Eigenvalues and eigenvectors of a small symmetric matrix.
#pragma once
#include "../spans.hpp"

namespace armctl {

// Replaces a symmetric matrix A by a diagonal one, and V by its eigenvectors (columns): cyclic Jacobi rotations.
//
// Source: Golub and Van Loan, Matrix Computations (2013), 8.5. Small eigenvalues keep their relative accuracy.
void diagonalize(MatrixResult A, MatrixResult V);

}  // namespace armctl
