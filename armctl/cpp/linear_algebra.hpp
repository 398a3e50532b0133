// Small dense matrices. Sums run from left to right, so the bits of a result depend on no library.
#pragma once
#include <algorithm>
#include <vector>

#include "spans.hpp"

namespace armctl {

using Numbers = std::vector<double>;

// A matrix that owns its numbers, row by row.
class DenseMatrix {
public:
    DenseMatrix(size_t rows, size_t columns) : rows_(rows), columns_(columns), numbers_(rows * columns) {}

    double& operator()(size_t row, size_t column) { return numbers_[row * columns_ + column]; }
    double operator()(size_t row, size_t column) const { return numbers_[row * columns_ + column]; }
    Result row(size_t index) { return {numbers_.data() + index * columns_, columns_}; }
    Vector row(size_t index) const { return {numbers_.data() + index * columns_, columns_}; }
    Column column(size_t index) const { return {numbers_.data() + index, columns_}; }
    size_t rows() const { return rows_; }
    size_t columns() const { return columns_; }
    operator MatrixResult() { return {numbers_.data(), rows_, columns_}; }
    operator Matrix() const { return {numbers_.data(), rows_, columns_}; }
    Result numbers() { return numbers_; }
    Vector numbers() const { return numbers_; }
    void set(Matrix other) { std::ranges::copy(other.numbers(), numbers_.begin()); }

private:
    size_t rows_;
    size_t columns_;
    Numbers numbers_;
};

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
void factorize(MatrixResult M);

// Replaces the lower triangle of what `factorize` leaves by the Cholesky factor L D^1/2; `solve` cannot use it.
void take_roots(MatrixResult factors);

// Replaces x by the solution of M solution = x, with M as `factorize` leaves it.
void solve(Matrix factors, Result x);

// Replaces a symmetric matrix A by a diagonal one, and V by its eigenvectors (columns): cyclic Jacobi rotations.
//
// Source: Golub and Van Loan, 8.5. Small eigenvalues keep their relative accuracy.
void diagonalize(MatrixResult A, MatrixResult V);

}  // namespace armctl
