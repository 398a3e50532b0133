#include "symmetric_eigenvalues.hpp"

#include <cmath>

namespace armctl {

namespace {

constexpr int max_sweeps = 30;  // the iteration converges in about 6

// One Jacobi rotation, which makes A(p, r) zero.
void rotate(MatrixResult A, MatrixResult V, size_t p, size_t r) {
    const double half = 0.5 * (A(r, r) - A(p, p));
    double tangent = A(p, r) / (std::abs(half) + std::sqrt(half * half + A(p, r) * A(p, r)));
    if (half < 0.0) { tangent = -tangent; }
    const double cosine = 1.0 / std::sqrt(1.0 + tangent * tangent);
    const double sine = tangent * cosine;
    const auto turn = [cosine, sine](double& first, double& second) {
        const double before = first;
        first = cosine * before - sine * second;
        second = sine * before + cosine * second;
    };
    for (size_t k = 0; k < A.rows; ++k) {
        turn(A(k, p), A(k, r));
        turn(V(k, p), V(k, r));
    }
    for (size_t k = 0; k < A.rows; ++k) { turn(A(p, k), A(r, k)); }
    A(p, r) = 0.0;
    A(r, p) = 0.0;
}

}  // namespace

void diagonalize(MatrixResult A, MatrixResult V) {
    const size_t n = A.rows;
    for (size_t i = 0; i < n; ++i) {
        for (size_t k = 0; k < n; ++k) { V(i, k) = i == k ? 1.0 : 0.0; }
    }
    for (int sweep = 0; sweep < max_sweeps; ++sweep) {
        bool is_diagonal = true;
        for (size_t p = 0; p + 1 < n; ++p) {
            for (size_t r = p + 1; r < n; ++r) {
                if (std::abs(A(p, r)) <= 1e-17 * std::sqrt(std::abs(A(p, p) * A(r, r)))) { continue; }
                is_diagonal = false;
                rotate(A, V, p, r);
            }
        }
        if (is_diagonal) { return; }
    }
}

}  // namespace armctl
