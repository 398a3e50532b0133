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
#include "errors.hpp"
#include "interior_point.hpp"
#include "vectors.hpp"

namespace armctl {

// Weights of the barrier relative to the duration: the first from a constant path speed or from near the solution, and the last.
constexpr double barrier_from_constant = 2e-5;
constexpr double barrier_from_near = 1e-7;
constexpr double path_barrier_last = 5e-9;
constexpr double path_barrier_factor = 0.05;
constexpr double smallest_product = 1e-200;  // a product of slacks is replaced by its logarithm before it underflows
constexpr double start_constant = 0.9;       // of the smallest bound on the squared path speed
constexpr double start_near = 0.98;          // of a solution for bounds that are a little different
constexpr double start_factor = 0.8;         // until the start is inside all bounds

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

// The problem for `minimize_with_barriers`: time plus barrier.
class PathTiming {
public:
    PathTiming(double interval_length, const SpeedBounds& bounds, size_t intervals)
        : h_(interval_length), intervals_(intervals), bounds_(bounds) {
        for (size_t p = 0; p < bounds.interval.size(); ++p) {
            checked_index(bounds.interval[p], intervals, "interval");
            checked_index(bounds.force_end[p], bounds.low.size() + 1, "force_end");
            checked_index(bounds.jerk_end[p], bounds.j_max.size() + 1, "jerk_end");
        }
    }

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
        const double first = from_near ? barrier_from_near : barrier_from_constant;
        minimize_with_barriers(*this, c, BarrierSchedule{.first = first * duration(), .factor = path_barrier_factor, .centered = 1.0});
        return true;
    }

    double cost(Vector c, double barrier) const {
        double time = 0.0;
        for (size_t m = 0; m < intervals_; ++m) {
            const double left = 0.5 * (c[m] + c[m + 1]);
            const double middle = (c[m] + 6 * c[m + 1] + c[m + 2]) / 8;
            const double right = 0.5 * (c[m + 1] + c[m + 2]);
            if (left <= 0 || middle <= 0 || right <= 0) { return INFINITE; }
            time += h_ / 6.0 * (1 / std::sqrt(left) + 4 / std::sqrt(middle) + 1 / std::sqrt(right));
        }
        double logs = 0.0;
        double product = 1.0;
        const auto multiply = [&](double slack) {
            product *= slack;
            if (product < smallest_product) {
                logs += std::log(product);
                product = 1.0;
            }
        };
        size_t force = 0;
        size_t jerk = 0;
        for (size_t p = 0; p < bounds_.interval.size(); ++p) {
            const Vec3 three = coefficients_of(c, interval(p));
            const double b = dot(vec3(bounds_.weights.row(p)), three);
            const double b_max = bounds_.b_max[p];
            if (b <= 0 || (b_max > 0 && b >= b_max)) { return INFINITE; }
            if (b_max > 0) { product *= 1 - b / b_max; }
            const double w = std::sqrt(b);
            for (; force < force_end(p); ++force) {
                const double y = dot(vec3(bounds_.force_weights.row(force)), three) + bounds_.damping[force] * w;
                const double above = bounds_.high[force] - y;
                const double below = y - bounds_.low[force];
                if (above <= 0 || below <= 0) { return INFINITE; }
                const double width = bounds_.high[force] - bounds_.low[force];
                multiply(above * below / (width * width));
            }
            for (; jerk < jerk_end(p); ++jerk) {
                const double y = dot(vec3(bounds_.jerk_weights.row(jerk)), three) * w / bounds_.j_max[jerk];
                const double slack = 1 - y * y;
                if (slack <= 0) { return INFINITE; }
                multiply(slack);
            }
        }
        return time - barrier * (logs + std::log(product));
    }

    void add_derivatives(Vector c, double barrier, Result gradient, BandMatrix& hessian) const {
        add_duration(c, gradient, hessian);
        size_t force = 0;
        size_t jerk = 0;
        for (size_t p = 0; p < bounds_.interval.size(); ++p) {
            const size_t m = interval(p);
            const Vec3 three = coefficients_of(c, m);
            const Vec3 x = vec3(bounds_.weights.row(p));
            const double b = dot(x, three);
            const double w = std::sqrt(b);
            if (bounds_.b_max[p] > 0) {
                const double slack = bounds_.b_max[p] - b;
                add(m, x, barrier / slack, barrier / (slack * slack), gradient, hessian);
            }
            for (; force < force_end(p); ++force) {
                const Vec3 weights = vec3(bounds_.force_weights.row(force));
                const double y = dot(weights, three) + bounds_.damping[force] * w;
                const double damping = 0.5 * bounds_.damping[force] / w;
                const double above = 1 / (bounds_.high[force] - y);
                const double below = 1 / (y - bounds_.low[force]);
                const Vec3 g = weights + damping * x;
                // The curvature of w is left out: the Hessian stays positive definite without it.
                add(m, g, barrier * (above - below), barrier * (above * above + below * below), gradient, hessian);
            }
            for (; jerk < jerk_end(p); ++jerk) {
                const Vec3 weights = vec3(bounds_.jerk_weights.row(jerk));
                const double y = dot(weights, three);
                const double max = bounds_.j_max[jerk] / w;
                const double decrease = 0.5 * max / b;  // of this bound, with b
                for (const double sign : {-1.0, 1.0}) {
                    const double inverse = 1 / (max - sign * y);
                    const Vec3 g = sign * weights + decrease * x;
                    add(m, g, barrier * inverse, barrier * inverse * inverse, gradient, hessian);
                }
            }
        }
    }

    bool is_last(Vector, double barrier) const { return barrier <= path_barrier_last * duration(); }
    size_t band_width() const { return 3; }

private:
    // At the path speed 1.
    double duration() const { return h_ * static_cast<double>(intervals_); }
    size_t interval(size_t point) const { return static_cast<size_t>(bounds_.interval[point]); }
    size_t force_end(size_t point) const { return static_cast<size_t>(bounds_.force_end[point]); }
    size_t jerk_end(size_t point) const { return static_cast<size_t>(bounds_.jerk_end[point]); }
    // The duration, by Simpson's rule in each interval.
    void add_duration(Vector c, Result gradient, BandMatrix& hessian) const {
        struct SimpsonNode {
            double weight;
            Vec3 of_c;  // in b
        };
        constexpr SimpsonNode nodes[] = {{1.0, {0.5, 0.5, 0.0}}, {4.0, {0.125, 0.75, 0.125}}, {1.0, {0.0, 0.5, 0.5}}};
        for (size_t m = 0; m < intervals_; ++m) {
            for (const SimpsonNode& node : nodes) {
                const double b = dot(node.of_c, coefficients_of(c, m));
                const double slope = -0.5 * node.weight * h_ / 6.0 / (b * std::sqrt(b));
                add(m, node.of_c, slope, -1.5 * slope / b, gradient, hessian);
            }
        }
    }

    double h_;
    size_t intervals_;
    SpeedBounds bounds_;
};

// Fills the coefficients of b for the least time; false if no path speed is found that keeps the bounds.
//
// From near the solution, `c` holds the solution for bounds that are a little different; otherwise the search starts from a
// constant speed.
inline bool fastest_path_speed(double interval_length, const SpeedBounds& bounds, bool from_near, Result c) {
    if (c.size() < 3) { throw InputError("coefficients: need at least 3, of one interval"); }
    return PathTiming(interval_length, bounds, c.size() - 2).solve(from_near, c);
}

}  // namespace armctl
