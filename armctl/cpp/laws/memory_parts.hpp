// Named parts of the memory of a law.
#pragma once
#include "../spans.hpp"

namespace armctl {

// Takes parts off the front of a block of numbers.
class MemoryParts {
public:
    explicit MemoryParts(std::span<double> numbers) : rest_(numbers) {}

    Result vector(size_t size) {
        const Result part = rest_.first(size);
        rest_ = rest_.subspan(size);
        return part;
    }

    MatrixResult matrix(size_t rows, size_t columns) { return {vector(rows * columns).data(), rows, columns}; }

    double& number() { return vector(1)[0]; }

private:
    std::span<double> rest_;
};

}  // namespace armctl
