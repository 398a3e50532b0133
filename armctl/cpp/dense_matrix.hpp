// A matrix that owns its numbers, row by row.
#pragma once
#include <vector>

#include "spans.hpp"

namespace armctl {

class DenseMatrix {
public:
    DenseMatrix(size_t rows, size_t columns) : rows_(rows), columns_(columns), numbers_(rows * columns) {}

    double& operator()(size_t row, size_t column) { return numbers_[row * columns_ + column]; }
    double operator()(size_t row, size_t column) const { return numbers_[row * columns_ + column]; }
    Result row(size_t index) { return {numbers_.data() + index * columns_, columns_}; }
    Vector row(size_t index) const { return {numbers_.data() + index * columns_, columns_}; }
    size_t rows() const { return rows_; }
    size_t columns() const { return columns_; }

    operator MatrixResult() { return {numbers_.data(), rows_, columns_}; }
    operator Matrix() const { return {numbers_.data(), rows_, columns_}; }

    // All numbers, row by row.
    Result numbers() { return numbers_; }
    Vector numbers() const { return numbers_; }

private:
    size_t rows_;
    size_t columns_;
    std::vector<double> numbers_;
};

}  // namespace armctl
