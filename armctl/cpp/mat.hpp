// Matrices that own their numbers, and formulas of matrices.
//
// A formula such as `J.transposed() * J` has no memory of its own: its elements are computed where it is assigned or added, their sums
// from left to right. `y += A * x` adds one product after the other to each number of y.
#pragma once
#include <algorithm>
#include <concepts>
#include <vector>

#include "spans.hpp"

namespace armctl {

using Numbers = std::vector<double>;

// What has rows, columns and elements: a span, or a formula.
template <class M>
concept Formula = requires(const M& m, size_t i) {
    { m.rows } -> std::convertible_to<size_t>;
    { m.columns } -> std::convertible_to<size_t>;
    { m(i, i) } -> std::convertible_to<double>;
};

template <Formula M>
struct Transposed {
    M of;
    size_t rows = of.columns;
    size_t columns = of.rows;

    double operator()(size_t i, size_t k) const { return of(k, i); }
};

template <Formula A, Formula B>
struct Product {
    A left;
    B right;
    size_t rows = left.rows;
    size_t columns = right.columns;

    double operator()(size_t i, size_t k) const { return added(0.0, i, k); }

    // The element added to, or subtracted from, a total.
    double added(double total, size_t i, size_t k) const {
        for (size_t j = 0; j < left.columns; ++j) { total += left(i, j) * right(j, k); }
        return total;
    }
    double subtracted(double total, size_t i, size_t k) const {
        for (size_t j = 0; j < left.columns; ++j) { total -= left(i, j) * right(j, k); }
        return total;
    }
};

template <Formula M>
struct Scaled {
    double factor;
    M of;
    size_t rows = of.rows;
    size_t columns = of.columns;

    double operator()(size_t i, size_t k) const { return factor * of(i, k); }
};

template <Formula A, Formula B>
struct Difference {
    A left;
    B right;
    size_t rows = left.rows;
    size_t columns = left.columns;

    double operator()(size_t i, size_t k) const { return left(i, k) - right(i, k); }
};

// diag(d) M and M diag(d).
template <Formula M>
struct ScaledRows {
    Vector factors;
    M of;
    size_t rows = of.rows;
    size_t columns = of.columns;

    double operator()(size_t i, size_t k) const { return factors[i] * of(i, k); }
};
template <Formula M>
struct ScaledColumns {
    M of;
    Vector factors;
    size_t rows = of.rows;
    size_t columns = of.columns;

    double operator()(size_t i, size_t k) const { return of(i, k) * factors[k]; }
};

struct Diagonal {
    Vector factors;
};

// A matrix that owns its numbers, row by row.
class Mat {
public:
    Mat() = default;
    Mat(size_t rows, size_t columns) : rows_(rows), columns_(columns), numbers_(rows * columns) {}

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
    Transposed<Matrix> transposed() const { return {*this}; }
    Matrix top(size_t count) const { return {numbers_.data(), count, columns_}; }

    // The numbers of a formula of the same shape, in which this matrix does not occur.
    template <Formula F>
    Mat& operator=(const F& formula) {
        for (size_t i = 0; i < rows_; ++i) {
            for (size_t k = 0; k < columns_; ++k) { (*this)(i, k) = formula(i, k); }
        }
        return *this;
    }

    template <Formula F>
    void set_block(size_t row, size_t column, const F& formula) {
        for (size_t i = 0; i < formula.rows; ++i) {
            for (size_t k = 0; k < formula.columns; ++k) { (*this)(row + i, column + k) = formula(i, k); }
        }
    }

    template <class A, class B>
    Mat& operator+=(const Product<A, B>& product) {
        for (size_t i = 0; i < rows_; ++i) {
            for (size_t k = 0; k < columns_; ++k) { (*this)(i, k) = product.added((*this)(i, k), i, k); }
        }
        return *this;
    }
    template <class A, class B>
    Mat& operator-=(const Product<A, B>& product) {
        for (size_t i = 0; i < rows_; ++i) {
            for (size_t k = 0; k < columns_; ++k) { (*this)(i, k) = product.subtracted((*this)(i, k), i, k); }
        }
        return *this;
    }

private:
    size_t rows_ = 0;
    size_t columns_ = 0;
    Numbers numbers_;
};

// An operand of a formula: a matrix is seen, not copied.
inline Matrix operand(Matrix matrix) { return matrix; }
inline Matrix operand(Vector column) { return {column.data(), column.size(), 1}; }
template <Formula F>
    requires(!std::convertible_to<F, Matrix>)
F operand(const F& formula) {
    return formula;
}

template <class M>
concept MatrixOperand = std::same_as<M, Mat> || Formula<M>;

template <MatrixOperand A, class B>
    requires MatrixOperand<B> || std::convertible_to<B, Vector>
auto operator*(const A& left, const B& right) {
    return Product{operand(left), operand(right)};
}
template <MatrixOperand M>
auto operator*(double factor, const M& matrix) {
    return Scaled{factor, operand(matrix)};
}
template <MatrixOperand M>
auto operator*(Diagonal diagonal, const M& matrix) {
    return ScaledRows{diagonal.factors, operand(matrix)};
}
template <MatrixOperand M>
auto operator*(const M& matrix, Diagonal diagonal) {
    return ScaledColumns{operand(matrix), diagonal.factors};
}
template <MatrixOperand A, MatrixOperand B>
auto operator-(const A& left, const B& right) {
    return Difference{operand(left), operand(right)};
}
template <MatrixOperand M>
auto transposed(const M& matrix) {
    return Transposed{operand(matrix)};
}

// Adds to, or subtracts from, each number of a vector what a formula of one column has there.
template <class A, class B>
void operator+=(Result y, const Product<A, B>& product) {
    for (size_t i = 0; i < y.size(); ++i) { y[i] = product.added(y[i], i, 0); }
}
template <class A, class B>
void operator-=(Result y, const Product<A, B>& product) {
    for (size_t i = 0; i < y.size(); ++i) { y[i] = product.subtracted(y[i], i, 0); }
}

}  // namespace armctl
