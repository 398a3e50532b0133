// The angles at which an equation in their cosine and sine holds.
#pragma once
#include <array>
#include <cstddef>

namespace armctl {

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
Roots linear_roots(double a, double b, double d, double slack, double preferred);

// The coefficients of 1, cos t, sin t, cos 2t and sin 2t.
struct TrigonometricForm {
    double constant = 0.0;
    double cos = 0.0;
    double sin = 0.0;
    double cos2 = 0.0;
    double sin2 = 0.0;

    // Adds factor (p + q cos t + r sin t)^2.
    void add_square(double p, double q, double r, double factor);
};

// The angles at which a form is zero, at most four: the roots on the unit circle of a polynomial of degree four.
Roots trigonometric_roots(const TrigonometricForm& form, double slack);

}  // namespace armctl
