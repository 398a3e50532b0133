#include "polynomials.hpp"

#include <algorithm>
#include <array>
#include <cmath>

namespace armctl {

namespace {

constexpr int bisections = 46;

struct Polynomial {
    std::array<double, max_polynomial_degree + 1> c{};
    size_t degree = 0;

    double operator()(double x) const {
        double value = c[degree];
        for (size_t k = degree; k-- > 0;) { value = value * x + c[k]; }
        return value;
    }

    Polynomial derivative() const {
        Polynomial slope;
        slope.degree = degree > 0 ? degree - 1 : 0;
        for (size_t k = 1; k <= degree; ++k) { slope.c[k - 1] = c[k] * static_cast<double>(k); }
        return slope;
    }
};

// As many numbers in [0, 1] as the degree of a polynomial, its roots in [0, 1] among them.
using Roots = std::array<double, max_polynomial_degree>;

// A number in [0, 1]; 0 in place of NaN, which is a division of zero by zero.
double clamped(double x) { return std::isnan(x) ? 0.0 : std::min(std::max(x, 0.0), 1.0); }

// The roots of degree 2 without the cancellation of the schoolbook formula.
Roots roots_of_quadratic(const Polynomial& p) {
    const double c = p.c[0];
    const double b = p.c[1];
    const double a = p.c[2];
    const double root = std::sqrt(std::max(b * b - 4 * a * c, 0.0));
    const double half = -0.5 * (b + (b < 0 ? -root : root));
    return {clamped(half / a), clamped(c / half)};
}

// Between two neighbouring turning points a polynomial is monotone and has at most one root, which bisection finds.
Roots roots_of(const Polynomial& p) {
    if (p.degree == 0) { return {}; }
    if (p.degree == 1) { return {clamped(-p.c[0] / p.c[1])}; }
    if (p.degree == 2) { return roots_of_quadratic(p); }
    Roots turns = roots_of(p.derivative());
    std::sort(turns.begin(), turns.begin() + p.degree - 1);
    Roots roots{};
    for (size_t k = 0; k < p.degree; ++k) {
        double low = k == 0 ? 0.0 : turns[k - 1];
        double high = k == p.degree - 1 ? 1.0 : turns[k];
        const bool is_positive = p(low) > 0;
        for (int i = 0; i < bisections; ++i) {
            const double middle = 0.5 * (low + high);
            (p(middle) > 0) == is_positive ? low = middle : high = middle;
        }
        roots[k] = 0.5 * (low + high);
    }
    return roots;
}

// The largest power that any of the polynomials has.
size_t largest_power(const PolynomialSpan& polynomials) {
    for (size_t power = polynomials.degree; power > 0; --power) {
        for (size_t piece = 0; piece < polynomials.pieces; ++piece) {
            for (size_t joint = 0; joint < polynomials.joints; ++joint) {
                if (polynomials(piece, power, joint) != 0.0) { return power; }
            }
        }
    }
    return 0;
}

}  // namespace

void polynomial_extremes(const PolynomialSpan& polynomials, size_t order, MatrixResult places, MatrixResult values) {
    const size_t power = largest_power(polynomials);
    const size_t turning_points = power > order + 1 ? power - order - 1 : 0;
    for (size_t piece = 0; piece < polynomials.pieces; ++piece) {
        for (size_t joint = 0; joint < polynomials.joints; ++joint) {
            Polynomial p;
            p.degree = polynomials.degree;
            for (size_t k = 0; k <= p.degree; ++k) { p.c[k] = polynomials(piece, k, joint); }
            for (size_t i = 0; i < order; ++i) { p = p.derivative(); }
            Polynomial slope = p.derivative();
            slope.degree = turning_points;
            const Roots turns = roots_of(slope);
            const size_t row = piece * polynomials.joints + joint;
            for (size_t k = 0; k < places.columns; ++k) {
                const bool is_turn = k >= 2 && k < 2 + turning_points;
                places(row, k) = is_turn ? turns[k - 2] : k == 1 ? 1.0 : 0.0;
                values(row, k) = p(places(row, k));
            }
        }
    }
}

}  // namespace armctl
