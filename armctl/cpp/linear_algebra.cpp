#include "linear_algebra.hpp"

#include <cmath>
#include <limits>

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

void multiply(Matrix factors, Vector x, Result product) {
    const size_t n = x.size();
    for (size_t i = 0; i < n; ++i) {
        product[i] = x[i] / factors(i, i);
        for (size_t k = i + 1; k < n; ++k) { product[i] += factors(i, k) * x[k]; }
    }
    for (size_t i = n; i-- > 0;) {
        for (size_t k = 0; k < i; ++k) { product[i] += factors(i, k) * product[k]; }
    }
}

namespace {

constexpr int max_sweeps = 30;  // both iterations converge in about 6

void turn_columns(MatrixResult A, size_t i, size_t k, double cosine, double sine) {
    for (size_t j = 0; j < A.rows; ++j) { turn(A(j, i), A(j, k), cosine, sine); }
}

// Calls `rotate` for each pair of indices below n, again and again until it returns false for all of them.
template <class Rotate>
void rotate_pairs(size_t n, Rotate rotate) {
    bool has_rotated = true;
    for (int sweep = 0; has_rotated && sweep < max_sweeps; ++sweep) {
        has_rotated = false;
        for (size_t i = 0; i + 1 < n; ++i) {
            for (size_t k = i + 1; k < n; ++k) { has_rotated |= rotate(i, k); }
        }
    }
}

}  // namespace

void diagonalize(MatrixResult A, MatrixResult V) {
    set_identity(V);
    rotate_pairs(A.rows, [A, V](size_t p, size_t r) {
        if (std::abs(A(p, r)) <= 1e-17 * std::sqrt(std::abs(A(p, p) * A(r, r)))) { return false; }
        const double half = 0.5 * (A(r, r) - A(p, p));
        double tangent = A(p, r) / (std::abs(half) + std::sqrt(half * half + A(p, r) * A(p, r)));
        if (half < 0.0) { tangent = -tangent; }
        const double cosine = 1.0 / std::sqrt(1.0 + tangent * tangent);
        const double sine = tangent * cosine;
        turn_columns(A, p, r, cosine, sine);
        turn_columns(V, p, r, cosine, sine);
        turn_rows(A, p, r, cosine, sine);
        A(p, r) = 0.0;
        A(r, p) = 0.0;
        return true;
    });
}

void solve_least_squares(MatrixResult A, Vector b, MatrixResult rotations, Result x) {
    set_identity(rotations);
    rotate_pairs(A.rows, [A, rotations](size_t i, size_t k) {
        const double first = dot(A.row(i), A.row(i));
        const double second = dot(A.row(k), A.row(k));
        const double both = dot(A.row(i), A.row(k));
        if (!(std::abs(both) > 1e-15 * std::sqrt(first * second))) { return false; }
        const double half = 0.5 * (second - first) / both;
        const double tangent = std::copysign(1.0, half) / (std::abs(half) + std::sqrt(1.0 + half * half));
        const double cosine = 1.0 / std::sqrt(1.0 + tangent * tangent);
        const double sine = cosine * tangent;
        turn_rows(A, i, k, cosine, sine);
        turn_rows(rotations, i, k, cosine, sine);
        return true;
    });
    double largest = 0.0;
    for (size_t i = 0; i < A.rows; ++i) { largest = std::max(largest, dot(A.row(i), A.row(i))); }
    const double threshold = std::numeric_limits<double>::epsilon() * static_cast<double>(std::max(A.rows, A.columns));
    for (size_t i = 0; i < A.rows; ++i) {
        const double squared = dot(A.row(i), A.row(i));
        if (squared > threshold * threshold * largest) {
            const double along = dot(A.row(i), b);
            for (size_t k = 0; k < A.rows; ++k) { x[k] += rotations(i, k) * along / squared; }
        }
    }
}

}  // namespace armctl
