// Vectors and matrices of the caller: spans that know their length. A matrix is stored row by row.
#pragma once
#include <cstddef>
#include <cstdint>
#include <span>
#include <type_traits>

namespace armctl {

using Vector = std::span<const double>;  // is read
using Result = std::span<double>;        // is written
using Integers = std::span<const std::int64_t>;

// A column of a matrix.
struct Column {
    const double* data;
    size_t stride;

    double operator[](size_t row) const { return data[row * stride]; }
};

template <class Number>
struct MatrixSpan {
    Number* data = nullptr;
    size_t rows = 0;
    size_t columns = 0;

    Number& operator()(size_t row, size_t column) const { return data[row * columns + column]; }
    std::span<Number> row(size_t index) const { return {data + index * columns, columns}; }
    MatrixSpan from(size_t first) const { return {data + first * columns, rows - first, columns}; }
    Column column(size_t index) const { return {data + index, columns}; }
    std::span<Number> numbers() const { return {data, rows * columns}; }

    // A matrix that may be written can be read.
    operator MatrixSpan<const Number>() const
        requires(!std::is_const_v<Number>)
    {
        return {data, rows, columns};
    }
};

using Matrix = MatrixSpan<const double>;
using MatrixResult = MatrixSpan<double>;

}  // namespace armctl
