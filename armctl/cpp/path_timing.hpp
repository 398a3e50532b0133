// The time-optimal speed along a given motion.
//
// A motion q(u) runs at another speed, du/dt = w(u). The unknown is b = w^2, a quadratic B-spline over intervals of length h
// with coefficients c. With ' for d/du:
//
//     v = q' w,   a = q'' b + q' b'/2,   j = w (q''' b + 3/2 q'' b' + q' b''/2)
//
// Speed bounds b. A torque has the form of an acceleration: alpha b'/2 + beta b + delta w. The bounds are held at points: both
// ends of the pieces into which nodes cut the motion. Each bound involves three neighbouring coefficients, so that the Hessian
// of time plus logarithmic barrier has five diagonals, and a Newton step takes time in proportion to the number of nodes.
//
// That b makes speed and acceleration convex is Verscheure et al., "Time-optimal path tracking for robots: a convex
// optimization approach", IEEE Trans. Automatic Control 54(10), 2009.
#pragma once

#include "arguments.hpp"

namespace armctl {

// The bounds at P points, each of which lies in an interval; the weights are those of its three coefficients.
struct SpeedBounds {
    explicit SpeedBounds(const Arguments& a) : arguments(a) {}

    const Arguments& arguments;
    size_t P = arguments.length("interval");
    Integers interval = arguments.integers(P, "interval");
    Matrix weights = arguments.matrix(P, 3, "weights");       // of c in b
    Vector b_max = arguments.vector(P, "b_max");              // 0 where another point bounds b
    Integers force_end = arguments.integers(P, "force_end");  // behind the last of its force bounds
    size_t F = arguments.length("damping");                   // low <= weights . c + damping w <= high
    Matrix force_weights = arguments.matrix(F, 3, "force_weights");
    Vector damping = arguments.vector(F, "damping");
    Vector low = arguments.vector(F, "low");
    Vector high = arguments.vector(F, "high");
    Integers jerk_end = arguments.integers(P, "jerk_end");  // behind the last of its jerk bounds
    size_t J = arguments.length("j_max");                   // |weights . c| w <= j_max
    Matrix jerk_weights = arguments.matrix(J, 3, "jerk_weights");
    Vector j_max = arguments.vector(J, "j_max");
};

// Fills the coefficients of b for the least time; false if no path speed is found that keeps the bounds.
//
// From near the solution, `c` holds the solution for bounds that are a little different; otherwise the search starts from a
// constant speed.
bool fastest_path_speed(double interval_length, const SpeedBounds& bounds, bool from_near, Result c);

}  // namespace armctl
