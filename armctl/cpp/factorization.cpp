#include "factorization.hpp"

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

}  // namespace armctl
