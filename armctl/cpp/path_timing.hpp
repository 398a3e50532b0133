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
#include "errors.hpp"
#include "interior_point.hpp"
#include "vectors.hpp"

namespace armctl {

// Weights of the barrier relative to the duration: the first from a constant path speed or from near the solution, and the last.
constexpr double barrier_from_constant = 2e-5;
constexpr double barrier_from_near = 1e-7;
constexpr double path_barrier_last = 5e-9;
constexpr double path_barrier_factor = 0.05;
constexpr double start_constant = 0.9;  // of the smallest bound on the squared path speed
constexpr double start_near = 0.98;     // of a solution for bounds that are a little different
constexpr double start_factor = 0.8;    // until the start is inside all bounds

// The three coefficients of an interval.
inline Vec3 coefficients_of(Vector c, size_t interval) { return vec3(c.subspan(interval, 3)); }

// Adds the derivatives of a function of g . c[k : k + 3] with this slope and curvature.
inline void add(size_t k, Vec3 weights, double slope, double curvature, Result gradient, BandMatrix& hessian) {
    const double g[3] = {weights.x, weights.y, weights.z};
    for (size_t row = 0; row < 3; ++row) {
        gradient[k + row] += slope * g[row];
        for (size_t column = row; column < 3; ++column) { hessian.at(k + row, column - row) += curvature * g[row] * g[column]; }
    }
}

// Bounds at P points, each of which lies in an interval; the weights are those of its three coefficients. The arrays are the caller's.
struct PathBounds {
    Integers interval;   // (P,)
    Matrix weights;      // (P, 3) of c in b
    Vector b_max;        // (P,) 0 where another point bounds b
    Integers force_end;  // (P,) behind the last of its force bounds
    // F force bounds: low <= force_weights . c + damping w <= high.
    Matrix force_weights;  // (F, 3)
    Vector damping;
    Vector low;
    Vector high;
    Integers jerk_end;  // (P,) behind the last of its jerk bounds
    // J jerk bounds: |jerk_weights . c| w <= j_max.
    Matrix jerk_weights;  // (J, 3)
    Vector j_max;
};

// The problem for `minimize_with_barriers`: time plus barrier.
class PathTiming {
public:
    PathTiming(const PathBounds& bounds, double interval_length, size_t coefficients) : bounds_(bounds), h_(interval_length) {
        if (coefficients < 3) { throw InputError("coefficients: need at least 3, of one interval"); }
        intervals_ = coefficients - 2;
        for (size_t p = 0; p < bounds_.interval.size(); ++p) {
            checked_index(bounds_.interval[p], intervals_, "interval");
            checked_index(bounds_.force_end[p], bounds_.damping.size() + 1, "force_end");
            checked_index(bounds_.jerk_end[p], bounds_.j_max.size() + 1, "jerk_end");
        }
    }

    // Fills the coefficients of b for the least time; false if no path speed is found that keeps the bounds.
    //
    // From near the solution, `c` holds the solution for bounds that are a little different; otherwise the search starts from a
    // constant speed.
    bool solve(bool from_near, Result c) const {
        double smallest_bound = INFINITE;
        for (const double b_max : bounds_.b_max) {
            if (b_max > 0) { smallest_bound = std::min(smallest_bound, b_max); }
        }
        for (double& value : c) { value = from_near ? start_near * value : start_constant * smallest_bound; }
        while (!std::isfinite(cost(c, 1.0))) {
            for (double& value : c) { value *= start_factor; }
            const double largest = *std::max_element(c.begin(), c.end());
            if (!(largest > std::numeric_limits<double>::min() && largest < INFINITE)) { return false; }
        }
        const double duration = h_ * static_cast<double>(intervals_);  // at the path speed 1
        const double first = from_near ? barrier_from_near : barrier_from_constant;
        minimize_with_barriers(*this, c, 3, {first * duration, path_barrier_last * duration, path_barrier_factor, 1.0});
        return true;
    }

    double cost(Vector c, double barrier) const {
        double time = 0.0;
        for (size_t m = 0; m < intervals_; ++m) {
            for (const SimpsonNode& node : simpson_nodes) {
                time += h_ / 6.0 * node.weight / std::sqrt(dot(node.of_c, coefficients_of(c, m)));
            }
        }
        LogarithmSum logs;
        const bool is_inside = visit_bounds(c, [&logs](size_t, double slack, Vec3) { return logs.add(slack); });
        return is_inside ? time - barrier * logs.sum() : INFINITE;
    }

    void add_derivatives(Vector c, double barrier, Result gradient, BandMatrix& hessian) const {
        for (size_t m = 0; m < intervals_; ++m) {
            for (const SimpsonNode& node : simpson_nodes) {
                const double b = dot(node.of_c, coefficients_of(c, m));
                const double slope = -0.5 * node.weight * h_ / 6.0 / (b * std::sqrt(b));
                add(m, node.of_c, slope, -1.5 * slope / b, gradient, hessian);
            }
        }
        // The curvature of the bounds is left out: the Hessian is positive definite without it.
        visit_bounds(c, [&](size_t m, double slack, Vec3 slope) {
            add(m, slope, -barrier / slack, barrier / (slack * slack), gradient, hessian);
            return true;
        });
    }

    static void move(Vector c, Vector step, double share, Result moved) {
        for (size_t k = 0; k < c.size(); ++k) { moved[k] = c[k] + share * step[k]; }
    }

private:
    // The duration comes from Simpson's rule in each interval.
    struct SimpsonNode {
        double weight;
        Vec3 of_c;  // in b
    };
    static constexpr SimpsonNode simpson_nodes[] = {{1.0, {0.5, 0.5, 0.0}}, {4.0, {0.125, 0.75, 0.125}}, {1.0, {0.0, 0.5, 0.5}}};

    // Calls visit(interval, slack, slope) for every bound as long as it returns true. The slack is positive inside; the slope is
    // that by the coefficients.
    template <class Visit>
    bool visit_bounds(Vector c, const Visit& visit) const {
        size_t force = 0;
        size_t jerk = 0;
        for (size_t p = 0; p < bounds_.interval.size(); ++p) {
            const auto m = static_cast<size_t>(bounds_.interval[p]);
            const Vec3 three = coefficients_of(c, m);
            const Vec3 x = vec3(bounds_.weights.row(p));
            const double b = dot(x, three);
            const double w = std::sqrt(b);
            if (bounds_.b_max[p] > 0 && !visit(m, bounds_.b_max[p] - b, -x)) { return false; }
            for (; force < static_cast<size_t>(bounds_.force_end[p]); ++force) {
                const Vec3 weights = vec3(bounds_.force_weights.row(force));
                const double y = dot(weights, three) + bounds_.damping[force] * w;
                const Vec3 slope = weights + 0.5 * bounds_.damping[force] / w * x;
                if (!visit(m, bounds_.high[force] - y, -slope) || !visit(m, y - bounds_.low[force], slope)) { return false; }
            }
            for (; jerk < static_cast<size_t>(bounds_.jerk_end[p]); ++jerk) {
                const Vec3 weights = vec3(bounds_.jerk_weights.row(jerk));
                const double y = dot(weights, three) * w / bounds_.j_max[jerk];
                const Vec3 slope = w / bounds_.j_max[jerk] * weights + 0.5 * y / b * x;
                if (!visit(m, 1.0 - y, -slope) || !visit(m, 1.0 + y, slope)) { return false; }
            }
        }
        return true;
    }

    PathBounds bounds_;
    double h_;
    size_t intervals_;
};

}  // namespace armctl
