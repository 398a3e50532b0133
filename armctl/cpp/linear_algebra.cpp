#include "linear_algebra.hpp"

#include <cmath>

namespace armctl {

void factorize(MatrixResult M) {
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

void take_roots(MatrixResult factors) {
    for (size_t j = 0; j < factors.rows; ++j) {
        const double root = 1.0 / std::sqrt(factors(j, j));
        factors(j, j) = root;
        for (size_t i = j + 1; i < factors.rows; ++i) { factors(i, j) *= root; }
    }
}

void solve(Matrix factors, Result x) {
    const size_t n = x.size();
    for (size_t i = 1; i < n; ++i) {
        for (size_t k = 0; k < i; ++k) { x[i] -= factors(i, k) * x[k]; }
    }
    for (size_t i = 0; i < n; ++i) { x[i] *= factors(i, i); }
    for (size_t i = n; i-- > 0;) {
        for (size_t k = i + 1; k < n; ++k) { x[i] -= factors(k, i) * x[k]; }
    }
}

void diagonalize(MatrixResult A, MatrixResult V) {
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
