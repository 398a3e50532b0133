#include "least_squares.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace armctl {

namespace {

constexpr int MAX_SWEEPS = 30;  // the orthogonalization converges in about 6

double product(Vector a, Vector b) {
    double total = 0.0;
    for (size_t j = 0; j < a.size(); ++j) { total += a[j] * b[j]; }
    return total;
}

void rotate(Result first, Result second, double cosine, double sine) {
    for (size_t j = 0; j < first.size(); ++j) {
        const double x = first[j];
        const double y = second[j];
        first[j] = cosine * x - sine * y;
        second[j] = sine * x + cosine * y;
    }
}

// Rotates two rows of A until they are orthogonal; false if they were.
bool orthogonalize(MatrixResult A, MatrixResult rotations, size_t i, size_t k) {
    const double first = product(A.row(i), A.row(i));
    const double second = product(A.row(k), A.row(k));
    const double both = product(A.row(i), A.row(k));
    if (!(std::abs(both) > 1e-15 * std::sqrt(first * second))) { return false; }
    const double half = 0.5 * (second - first) / both;
    const double tangent = std::copysign(1.0, half) / (std::abs(half) + std::sqrt(1.0 + half * half));
    const double cosine = 1.0 / std::sqrt(1.0 + tangent * tangent);
    const double sine = cosine * tangent;
    rotate(A.row(i), A.row(k), cosine, sine);
    rotate(rotations.row(i), rotations.row(k), cosine, sine);
    return true;
}

// Rotates each pair of rows once; whether all were orthogonal.
bool sweep(MatrixResult A, MatrixResult rotations) {
    bool is_orthogonal = true;
    for (size_t i = 0; i + 1 < A.rows; ++i) {
        for (size_t k = i + 1; k < A.rows; ++k) {
            if (orthogonalize(A, rotations, i, k)) { is_orthogonal = false; }
        }
    }
    return is_orthogonal;
}

}  // namespace

void solve_least_squares(MatrixResult A, Vector b, MatrixResult rotations, Result x) {
    for (size_t i = 0; i < A.rows; ++i) {
        for (size_t k = 0; k < A.rows; ++k) { rotations(i, k) = i == k ? 1.0 : 0.0; }
    }
    for (int sweeps = 0; sweeps < MAX_SWEEPS && !sweep(A, rotations); ++sweeps) {}
    double largest = 0.0;
    for (size_t i = 0; i < A.rows; ++i) { largest = std::max(largest, product(A.row(i), A.row(i))); }
    const double threshold = std::numeric_limits<double>::epsilon() * static_cast<double>(std::max(A.rows, A.columns));
    for (size_t i = 0; i < A.rows; ++i) {
        const double squared = product(A.row(i), A.row(i));
        if (squared > threshold * threshold * largest) {
            const double along = product(A.row(i), b);
            for (size_t k = 0; k < A.rows; ++k) { x[k] += rotations(i, k) * along / squared; }
        }
    }
}

}  // namespace armctl
