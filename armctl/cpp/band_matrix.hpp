// A symmetric matrix whose elements are zero away from its diagonal.
#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

#include "spans.hpp"

namespace armctl {

class BandMatrix {
public:
    // `width` is the number of diagonals from the main one to the outermost one, both included.
    BandMatrix(size_t size, size_t width) : size_(size), width_(width), elements_(size * width) {}

    size_t size() const { return size_; }

    // Element (row, row + offset), with offset below the width.
    double& at(size_t row, size_t offset) { return elements_[row * width_ + offset]; }

    void set_zero() { std::fill(elements_.begin(), elements_.end(), 0.0); }

    // Solves A x = b for a positive definite A by an LDL^T factorization, which replaces A. `x` holds b before the call.
    void factorize_and_solve(Result x) {
        for (size_t row = 0; row < size_; ++row) {
            const size_t end = std::min(width_, size_ - row);
            for (size_t below = 1; below < end; ++below) {
                const double factor = at(row, below) / at(row, 0);
                if (factor == 0.0) { continue; }
                for (size_t offset = below; offset < end; ++offset) { at(row + below, offset - below) -= factor * at(row, offset); }
                x[row + below] -= factor * x[row];
            }
        }
        for (size_t row = size_; row-- > 0;) {
            double total = x[row];
            for (size_t offset = 1; offset < std::min(width_, size_ - row); ++offset) { total -= at(row, offset) * x[row + offset]; }
            x[row] = total / at(row, 0);
        }
    }

private:
    size_t size_;
    size_t width_;
    std::vector<double> elements_;
};

}  // namespace armctl
