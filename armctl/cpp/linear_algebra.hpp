// Linear algebra of small dense matrices. Sums run from left to right, so the bits of a result depend on no library.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

#include "mat.hpp"

namespace armctl {

inline void copy(Vector from, Result to) { std::ranges::copy(from, to.begin()); }

// total + a . b. The sum of long ones has four parts, which do not wait for each other.
template <class Numbered>
double dot_product(Numbered a, Vector b, double total) {
    size_t i = 0;
    if (b.size() >= 16) {
        double parts[4] = {};
        for (; i + 4 <= b.size(); i += 4) {
            for (size_t k = 0; k < 4; ++k) { parts[k] += a[i + k] * b[i + k]; }
        }
        total += (parts[0] + parts[1]) + (parts[2] + parts[3]);
    }
    for (; i < b.size(); ++i) { total += a[i] * b[i]; }
    return total;
}

// The same for a vector or a row a, and for a column. Arrays become vectors: with their size, compilers warn of long sums.
inline double dot(Vector a, Vector b, double total = 0.0) { return dot_product(a, b, total); }
inline double dot(Column a, Vector b, double total = 0.0) { return dot_product(a, b, total); }

inline void set_identity(MatrixResult M) {
    for (size_t i = 0; i < M.rows; ++i) {
        for (size_t k = 0; k < M.columns; ++k) { M(i, k) = i == k ? 1.0 : 0.0; }
    }
}

// A plane rotation of two numbers.
inline void turn(double& x, double& y, double cosine, double sine) {
    const double before = x;
    x = cosine * before - sine * y;
    y = sine * before + cosine * y;
}

inline void turn_rows(MatrixResult A, size_t i, size_t k, double cosine, double sine) {
    for (size_t j = 0; j < A.columns; ++j) { turn(A(i, j), A(k, j), cosine, sine); }
}

// Replaces x, whose numbers before `first` are zero, by the solution of L solution = x, with a lower triangle L.
inline void forward_substitute(Matrix L, Result x, size_t first = 0) {
    for (size_t i = first; i < x.size(); ++i) {
        x[i] = (x[i] - dot(L.row(i).subspan(first), Vector(x).subspan(first, i - first))) / L(i, i);
    }
}

// Replaces x by the solution of L^T solution = x.
inline void backward_substitute(Matrix L, Result x) {
    for (size_t i = x.size(); i-- > 0;) {
        x[i] /= L(i, i);
        for (size_t k = 0; k < i; ++k) { x[k] -= L(i, k) * x[i]; }
    }
}

// Symmetric positive definite matrices, of which the lower triangle counts, as L D L^T in place.
//
// Source: Golub and Van Loan, Matrix Computations (2013), 4.1.2. There is one division per row, and no root. The lower triangle
// becomes that of L, whose diagonal is 1, the diagonal the inverse of D, and the upper triangle D L^T.
inline void factorize(MatrixResult M) {
    for (size_t i = 0; i < M.rows; ++i) {
        double pivot = M(i, i);
        for (size_t j = 0; j < i; ++j) {
            double rest = M(i, j);
            for (size_t k = 0; k < j; ++k) { rest -= M(k, i) * M(j, k); }
            M(j, i) = rest;
            M(i, j) = rest * M(j, j);
            pivot -= rest * M(i, j);
        }
        M(i, i) = 1.0 / pivot;
    }
}

// Replaces the lower triangle of what `factorize` leaves by the Cholesky factor L D^1/2; `solve` cannot use it.
inline void take_roots(MatrixResult factors) {
    for (size_t j = 0; j < factors.rows; ++j) {
        const double root = 1.0 / std::sqrt(factors(j, j));
        factors(j, j) = root;
        for (size_t i = j + 1; i < factors.rows; ++i) { factors(i, j) *= root; }
    }
}

// Replaces x by the solution of M solution = x, with M as `factorize` leaves it.
inline void solve(Matrix factors, Result x) {
    const size_t n = x.size();
    for (size_t i = 1; i < n; ++i) {
        for (size_t k = 0; k < i; ++k) { x[i] -= factors(i, k) * x[k]; }
    }
    for (size_t i = 0; i < n; ++i) { x[i] *= factors(i, i); }
    for (size_t i = n; i-- > 0;) {
        for (size_t k = i + 1; k < n; ++k) { x[i] -= factors(k, i) * x[k]; }
    }
}

// Replaces a symmetric matrix A by a diagonal one, and V by its eigenvectors (columns): cyclic Jacobi rotations.
//
// Source: Golub and Van Loan, 8.5. Small eigenvalues keep their relative accuracy.
inline void diagonalize(MatrixResult A, MatrixResult V) {
    constexpr int max_sweeps = 30;  // it converges in about 6
    set_identity(V);
    bool has_rotated = true;
    for (int sweep = 0; has_rotated && sweep < max_sweeps; ++sweep) {
        has_rotated = false;
        for (size_t p = 0; p < A.rows; ++p) {
            for (size_t r = p + 1; r < A.rows; ++r) {
                if (std::abs(A(p, r)) <= 1e-17 * std::sqrt(std::abs(A(p, p) * A(r, r)))) { continue; }
                has_rotated = true;
                const double half = 0.5 * (A(r, r) - A(p, p));
                double tangent = A(p, r) / (std::abs(half) + std::sqrt(half * half + A(p, r) * A(p, r)));
                if (half < 0.0) { tangent = -tangent; }
                const double cosine = 1.0 / std::sqrt(1.0 + tangent * tangent);
                const double sine = tangent * cosine;
                for (const MatrixResult& M : {A, V}) {
                    for (size_t j = 0; j < M.rows; ++j) { turn(M(j, p), M(j, r), cosine, sine); }
                }
                turn_rows(A, p, r, cosine, sine);
                A(p, r) = 0.0;
                A(r, p) = 0.0;
            }
        }
    }
}

}  // namespace armctl
