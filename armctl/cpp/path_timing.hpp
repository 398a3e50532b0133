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
    explicit SpeedBounds(const Arguments& arguments);

    Integers interval;     // (P,)
    Matrix weights;        // (P, 3) of c in b
    Vector b_max;          // (P,) 0 where another point bounds b
    Integers force_end;    // (P,) behind the last of its F force bounds: low <= weights . c + damping w <= high
    Matrix force_weights;  // (F, 3)
    Vector damping;        // (F,)
    Vector low;            // (F,)
    Vector high;           // (F,)
    Integers jerk_end;     // (P,) behind the last of its J jerk bounds: |weights . c| w <= j_max
    Matrix jerk_weights;   // (J, 3)
    Vector j_max;          // (J,)
};

// Fills the coefficients of b for the least time; false if no path speed is found that keeps the bounds.
//
// From near the solution, `c` holds the solution for bounds that are a little different; otherwise the search starts from a
// constant speed.
bool fastest_path_speed(double interval_length, const SpeedBounds& bounds, bool from_near, Result c);

}  // namespace armctl
