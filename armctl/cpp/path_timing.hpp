// The time-optimal speed along a given motion.
//
// A motion q(u) runs at another speed, du/dt = w(u). The unknown is b = w^2, a quadratic B-spline over intervals of length h
// with coefficients c. With ' for d/du:
//
//     v = q' w,   a = q'' b + q' b'/2,   j = w (q''' b + 3/2 q'' b' + q' b''/2)
//
// Speed bounds b. A torque has the form of an acceleration: alpha b'/2 + beta b + delta w. The bounds are held at both ends of
// the pieces into which nodes cut the motion: the edges of the intervals, and wherever the jerk of q(u) jumps. Each bound
// involves three neighbouring coefficients, so that the Hessian of time plus logarithmic barrier has five diagonals, and a
// Newton step takes time in proportion to the number of nodes.
//
// That b makes speed and acceleration convex is Verscheure et al., "Time-optimal path tracking for robots: a convex
// optimization approach", IEEE Trans. Automatic Control 54(10), 2009.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "band_matrix.hpp"
#include "spans.hpp"

namespace armctl {

// The pieces between N nodes: piece k lies in an interval, from one share of its length to another. Each has N - 1 elements.
struct PathPieces {
    std::span<const std::int64_t> interval;
    Vector begin;
    Vector end;
};

// A motion of n joints at N nodes, and its bounds there.
struct PathNodes {
    Matrix q1;         // (N, n) first derivative
    Matrix q2;         // (N, n) second derivative
    Matrix q3_after;   // (N - 1, n) third derivative at the start of each piece
    Matrix q3_before;  // (N - 1, n) third derivative at the end of each piece
    Vector b_max;      // (N) greatest square of the path speed
    Matrix j_max;      // (N, n) greatest jerk
    // (N, r) each: low <= alpha b'/2 + beta b + delta sqrt(b) <= high, with low < 0 < high
    Matrix alpha;
    Matrix beta;
    Matrix delta;
    Matrix low;
    Matrix high;
};

// Weights of the three coefficients of an interval.
using SplineWeights = std::array<double, 3>;

class PathTiming {
public:
    // Bounds that no path speed can make active are left out.
    PathTiming(double interval_length, const PathPieces& pieces, const PathNodes& nodes);

    // Fills the coefficients of b for the least time; false if no path speed is found that keeps the bounds. From near the
    // solution, `c` holds the solution for bounds that are a little different; otherwise the search starts from a constant
    // speed.
    bool solve(Result c, bool from_near) const;

    size_t coefficient_count() const { return intervals_ + 2; }

    // The problem for `minimize_with_barriers`: time plus barrier.
    double cost(Vector c, double barrier) const;
    void add_derivatives(Vector c, double barrier, Result gradient, BandMatrix& hessian) const;
    bool is_last(Vector c, double barrier) const;
    size_t band_width() const { return 3; }

private:
    // low <= weights . c + damping w <= high
    struct ForceBound {
        SplineWeights weights;
        double damping;
        double low;
        double high;
    };

    // |weights . c| w <= max
    struct JerkBound {
        SplineWeights weights;
        double max;
    };

    // An end of a piece. Its bounds follow those of the point before it.
    struct Point {
        size_t interval;
        SplineWeights weights;  // of c in b
        double b_max;           // 0 where another point bounds b
        size_t force_end;       // behind its last element of forces_
        size_t jerk_end;        // behind its last element of jerks_
    };

    // The weights of the coefficients in b, b' and b'' at a share of an interval.
    struct SpeedWeights {
        SplineWeights value;
        SplineWeights slope;
        SplineWeights curvature;
    };

    // At the path speed 1.
    double duration() const { return h_ * static_cast<double>(intervals_); }

    SpeedWeights weights_at(double share) const;
    void add_forces(const PathNodes& nodes, size_t node, double max_slope, const SpeedWeights& weights);
    void add_jerks(const PathNodes& nodes, size_t node, Vector q3, double max_slope, const SpeedWeights& weights);
    void add_duration(Vector c, Result gradient, BandMatrix& hessian) const;

    double h_;
    size_t intervals_;
    std::vector<Point> points_;
    std::vector<ForceBound> forces_;
    std::vector<JerkBound> jerks_;
};

}  // namespace armctl
