// The angles at which an equation in their cosine and sine holds.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <numbers>

namespace armctl {

constexpr double NEAR_DOUBLE_ROOT = 1e-6;  // of a cosine from 1: the two roots are closer than 3e-3 rad, and may be one
constexpr int MAX_ROOT_ITERATIONS = 60;
constexpr double ROOT_TOLERANCE = 1e-14;
constexpr double UNIT_CIRCLE_BAND = 1e-3;  // of a root's modulus from 1: rounding moves a double root off the circle, as a pair
constexpr double LEAST_DEGREE = 1e-12;     // relative: below it the coefficients of the double angle are zero
constexpr int NEWTON_ITERATIONS = 3;
constexpr double EXACT_ROOT = 1e-10;  // relative

// Not std::complex, whose products and quotients have other bits on each compiler.
struct Complex {
    double re = 0.0;
    double im = 0.0;
};

inline Complex operator+(Complex a, Complex b) { return {a.re + b.re, a.im + b.im}; }
inline Complex operator-(Complex a, Complex b) { return {a.re - b.re, a.im - b.im}; }
inline Complex operator*(double factor, Complex a) { return {factor * a.re, factor * a.im}; }
inline Complex operator*(Complex a, Complex b) { return {a.re * b.re - a.im * b.im, a.re * b.im + a.im * b.re}; }
inline bool is_zero(Complex a) { return a.re == 0 && a.im == 0; }
inline double modulus(Complex a) { return std::hypot(a.re, a.im); }

// The divisor's smaller part is divided by the larger one (Smith, Algorithm 116, 1962).
inline Complex operator/(Complex a, Complex b) {
    if (std::abs(b.re) >= std::abs(b.im)) {
        const double ratio = b.im / b.re;
        const double divisor = b.re + b.im * ratio;
        return {(a.re + a.im * ratio) / divisor, (a.im - a.re * ratio) / divisor};
    }
    const double ratio = b.re / b.im;
    const double divisor = b.re * ratio + b.im;
    return {(a.re * ratio + a.im) / divisor, (a.im * ratio - a.re) / divisor};
}

// The complex roots of z^4 + a3 z^3 + a2 z^2 + a1 z + a0, all at once (Aberth).
inline std::array<Complex, 4> polynomial_roots(Complex a3, Complex a2, Complex a1, Complex a0) {
    std::array<Complex, 4> roots;
    for (int i = 0; i < 4; ++i) {
        const double radius = 0.9 + 0.1 * i;
        roots[i] = {radius * std::cos(0.4 + 1.57 * i), radius * std::sin(0.4 + 1.57 * i)};
    }
    for (int iteration = 0; iteration < MAX_ROOT_ITERATIONS; ++iteration) {
        double largest = 0.0;
        for (size_t i = 0; i < roots.size(); ++i) {
            Complex x = roots[i];
            const Complex value = (((x + a3) * x + a2) * x + a1) * x + a0;
            Complex slope = ((4.0 * x + 3.0 * a3) * x + 2.0 * a2) * x + a1;
            if (is_zero(slope)) { slope = {1e-300, 0.0}; }
            const Complex newton = value / slope;
            Complex others;
            for (size_t j = 0; j < roots.size(); ++j) {
                const Complex away = x - roots[j];
                if (j != i && !is_zero(away)) { others = others + Complex{1.0, 0.0} / away; }
            }
            const Complex product = newton * others;
            const Complex repelled{1.0 - product.re, -product.im};
            const Complex step = is_zero(repelled) ? newton : newton / repelled;
            x = x - step;
            roots[i] = x;
            largest = std::max(largest, modulus(step) / std::max(modulus(x), 1e-300));
        }
        if (largest < ROOT_TOLERANCE) { break; }
    }
    return roots;
}

inline constexpr double TINY = 1e-9;  // reaches, or sine of an angle: a circle with that radius is a point

// The angles that solve an equation, and whether their number is doubtful: rounding decides, or all angles are solutions.
struct Roots {
    std::array<double, 4> angles{};
    size_t count = 0;
    bool doubtful = false;
};

// The angles t with a cos t + b sin t = d, at most two.
//
// A cosine up to 1 + slack counts as 1. If every angle is a solution, the preferred one is returned.
inline Roots linear_roots(double a, double b, double d, double slack, double preferred) {
    const double radius = std::sqrt(a * a + b * b);
    if (radius < TINY) { return {.angles = {preferred, preferred}, .count = std::abs(d) <= TINY + slack ? 1u : 0u, .doubtful = true}; }
    const double cos = d / radius;
    const double middle = std::atan2(b, a);
    const bool doubtful = std::abs(cos) > 1.0 - NEAR_DOUBLE_ROOT && std::abs(cos) <= 1.0 + std::max(slack, NEAR_DOUBLE_ROOT);
    if (std::abs(cos) > 1.0) {
        if (std::abs(cos) > 1.0 + slack) { return {.angles = {middle, middle}, .count = 0, .doubtful = doubtful}; }
        const double angle = cos > 0 ? middle : middle + std::numbers::pi;
        return {.angles = {angle, angle}, .count = 1, .doubtful = true};
    }
    const double half = std::acos(cos);
    return {.angles = {middle + half, middle - half}, .count = 2, .doubtful = doubtful};
}

// The coefficients of 1, cos t, sin t, cos 2t and sin 2t.
struct TrigonometricForm {
    double constant = 0.0;
    double cos = 0.0;
    double sin = 0.0;
    double cos2 = 0.0;
    double sin2 = 0.0;

    // Adds factor (p + q cos t + r sin t)^2.
    void add_square(double p, double q, double r, double factor) {
        constant += factor * (p * p + 0.5 * (q * q + r * r));
        cos += factor * 2.0 * p * q;
        sin += factor * 2.0 * p * r;
        cos2 += factor * 0.5 * (q * q - r * r);
        sin2 += factor * q * r;
    }
};

// The angles at which a form is zero, at most four: the roots on the unit circle of a polynomial of degree four.
inline Roots trigonometric_roots(const TrigonometricForm& form, double slack) {
    const double k0 = form.constant;
    const double k1 = form.cos;
    const double k2 = form.sin;
    const double k3 = form.cos2;
    const double k4 = form.sin2;
    const double scale = std::abs(k0) + std::abs(k1) + std::abs(k2) + std::abs(k3) + std::abs(k4);
    if (scale < TINY * TINY) { return {.angles = {}, .count = 0, .doubtful = true}; }
    if (std::abs(k3) + std::abs(k4) < LEAST_DEGREE * scale) { return linear_roots(k1, k2, -k0, slack, 0.0); }
    const Complex lead{0.5 * k3, -0.5 * k4};
    const std::array<Complex, 4> z = polynomial_roots(Complex{0.5 * k1, -0.5 * k2} / lead, Complex{k0, 0.0} / lead,
                                                      Complex{0.5 * k1, 0.5 * k2} / lead, Complex{0.5 * k3, 0.5 * k4} / lead);
    Roots roots;
    for (size_t i = 0; i < z.size(); ++i) {
        if (!(std::abs(modulus(z[i]) - 1.0) < UNIT_CIRCLE_BAND)) { continue; }
        for (size_t j = 0; j < i; ++j) { roots.doubtful = roots.doubtful || modulus(z[i] - z[j]) < 2.0 * UNIT_CIRCLE_BAND; }
        double angle = std::atan2(z[i].im, z[i].re);
        double best = angle;
        double least = std::numeric_limits<double>::infinity();
        for (int iteration = 0; iteration < NEWTON_ITERATIONS; ++iteration) {
            const double c = std::cos(angle);
            const double s = std::sin(angle);
            const double value = k0 + k1 * c + k2 * s + k3 * (c * c - s * s) + 2.0 * k4 * s * c;
            const double slope = -k1 * s + k2 * c - 4.0 * k3 * s * c + 2.0 * k4 * (c * c - s * s);
            if (std::abs(value) < least) {
                least = std::abs(value);
                best = angle;
            }
            if (std::abs(slope) < TINY * scale) { break; }
            angle -= value / slope;
        }
        if (least <= std::max(EXACT_ROOT, slack) * scale) {
            roots.angles[roots.count] = best;
            ++roots.count;
        }
    }
    return roots;
}

}  // namespace armctl
