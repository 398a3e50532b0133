#include "path_timing.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "interior_point.hpp"

namespace armctl {

namespace {

// Weights of the barrier relative to the duration: the first from a constant path speed or from near the
// solution, and the last.
constexpr double barrier_from_constant = 2e-5;
constexpr double barrier_from_near = 1e-7;
constexpr double barrier_last = 5e-9;
constexpr double barrier_factor = 0.05;
constexpr double smallest_product = 1e-200;  // a product of slacks is replaced by its logarithm before it underflows

constexpr double start_constant = 0.9;  // of the smallest bound on the squared path speed
constexpr double start_near = 0.98;     // of a solution for bounds that are a little different
constexpr double start_factor = 0.8;    // until the start is inside all bounds

constexpr double infinity = std::numeric_limits<double>::infinity();

using Three = std::span<const double, 3>;

Three three_from(Vector c, size_t interval) { return c.subspan(interval).first<3>(); }

double dot(const SplineWeights& weights, Three c) { return weights[0] * c[0] + weights[1] * c[1] + weights[2] * c[2]; }

// Adds the derivatives of a function of g . c[k : k + 3] with this slope and curvature.
void add(size_t k, const SplineWeights& g, double slope, double curvature, Result gradient, BandMatrix& hessian) {
    for (size_t row = 0; row < 3; ++row) {
        gradient[k + row] += slope * g[row];
        for (size_t column = row; column < 3; ++column) { hessian.at(k + row, column - row) += curvature * g[row] * g[column]; }
    }
}

// A bound on |b'| at a node, from the force row that bounds it most.
double max_slope_at(const PathNodes& nodes, size_t k) {
    const double b = nodes.b_max[k];
    const double w = std::sqrt(b);
    double max_slope = infinity;
    for (size_t i = 0; i < nodes.alpha.columns; ++i) {
        const double side = 0.5 * std::abs(nodes.alpha(k, i));
        if (side > 0.0) {
            const double bound = std::max(nodes.high(k, i), -nodes.low(k, i));
            max_slope = std::min(max_slope, (bound + std::abs(nodes.beta(k, i)) * b + std::abs(nodes.delta(k, i)) * w) / side);
        }
    }
    return max_slope;
}

}  // namespace

PathTiming::PathTiming(double interval_length, const PathPieces& pieces, const PathNodes& nodes) : h_(interval_length), intervals_(0) {
    const size_t count = pieces.interval.size();
    points_.reserve(2 * count);
    for (size_t p = 0; p < 2 * count; ++p) {
        const size_t piece = p / 2;
        const bool at_begin = p % 2 == 0;
        const size_t node = at_begin ? piece : piece + 1;
        const SpeedWeights weights = weights_at(at_begin ? pieces.begin[piece] : pieces.end[piece]);
        const double max_slope = max_slope_at(nodes, node);
        double b_max = 0.0;
        if (at_begin || p == 2 * count - 1) {
            b_max = nodes.b_max[node];
            add_forces(nodes, node, max_slope, weights);
        }
        add_jerks(nodes, node, at_begin ? nodes.q3_after.row(piece) : nodes.q3_before.row(piece), max_slope, weights);
        const auto interval = static_cast<size_t>(pieces.interval[piece]);
        intervals_ = std::max(intervals_, interval + 1);
        points_.push_back(Point{interval, weights.value, b_max, forces_.size(), jerks_.size()});
    }
}

PathTiming::SpeedWeights PathTiming::weights_at(double x) const {
    return SpeedWeights{
        .value = {0.5 * (1 - x) * (1 - x), 0.5 + x * (1 - x), 0.5 * x * x},
        .slope = {(x - 1) / h_, (1 - 2 * x) / h_, x / h_},
        .curvature = {1 / (h_ * h_), -2 / (h_ * h_), 1 / (h_ * h_)},
    };
}

// Adds the force rows of a node that can become active.
void PathTiming::add_forces(const PathNodes& nodes, size_t k, double max_slope, const SpeedWeights& weights) {
    const double b = nodes.b_max[k];
    const double w = std::sqrt(b);
    for (size_t i = 0; i < nodes.alpha.columns; ++i) {
        const double side = 0.5 * nodes.alpha(k, i);
        const double beta = nodes.beta(k, i);
        const double delta = nodes.delta(k, i);
        const double bound = std::min(nodes.high(k, i), -nodes.low(k, i));
        const double others = std::abs(beta) * b + std::abs(delta) * w;
        const double largest = side == 0.0 ? others : std::abs(side) * max_slope + others;
        if (largest < bound) { continue; }
        ForceBound force{{}, delta, nodes.low(k, i), nodes.high(k, i)};
        for (size_t r = 0; r < 3; ++r) { force.weights[r] = side * weights.slope[r] + beta * weights.value[r]; }
        forces_.push_back(force);
    }
}

// Adds the rows of the jerk at an end of a piece that can become active.
void PathTiming::add_jerks(const PathNodes& nodes, size_t k, Vector q3, double max_slope, const SpeedWeights& weights) {
    const double b = nodes.b_max[k];
    const double w = std::sqrt(b);
    const Vector q1 = nodes.q1.row(k);
    const Vector q2 = nodes.q2.row(k);
    const Vector j_max = nodes.j_max.row(k);
    const auto others = [&](size_t i) { return w * (std::abs(q3[i]) * b + 1.5 * std::abs(q2[i]) * max_slope); };
    double max_curvature = infinity;  // a bound on |b''| w
    for (size_t i = 0; i < q3.size(); ++i) {
        const double side = 0.5 * std::abs(q1[i]);
        if (side > 0.0) { max_curvature = std::min(max_curvature, (j_max[i] + others(i)) / side); }
    }
    for (size_t i = 0; i < q3.size(); ++i) {
        const double side = 0.5 * std::abs(q1[i]);
        const double largest = side == 0.0 ? others(i) : side * max_curvature + others(i);
        if (largest < j_max[i]) { continue; }
        JerkBound jerk{{}, j_max[i]};
        for (size_t r = 0; r < 3; ++r) {
            jerk.weights[r] = q3[i] * weights.value[r] + 1.5 * q2[i] * weights.slope[r] + 0.5 * q1[i] * weights.curvature[r];
        }
        jerks_.push_back(jerk);
    }
}

bool PathTiming::solve(Result c, bool from_near) const {
    double smallest_bound = infinity;
    for (const Point& point : points_) {
        if (point.b_max > 0) { smallest_bound = std::min(smallest_bound, point.b_max); }
    }
    for (double& value : c) { value = from_near ? start_near * value : start_constant * smallest_bound; }
    while (!std::isfinite(cost(c, 1.0))) {
        for (double& value : c) { value *= start_factor; }
        const double largest = *std::max_element(c.begin(), c.end());
        if (!(largest > std::numeric_limits<double>::min() && largest < infinity)) { return false; }
    }
    const double first = from_near ? barrier_from_near : barrier_from_constant;
    minimize_with_barriers(*this, c, BarrierSchedule{.first = first * duration(), .factor = barrier_factor, .centered = 1.0});
    return true;
}

bool PathTiming::is_last(Vector, double barrier) const { return barrier <= barrier_last * duration(); }

double PathTiming::cost(Vector c, double barrier) const {
    double time = 0.0;
    for (size_t m = 0; m < intervals_; ++m) {
        const double left = 0.5 * (c[m] + c[m + 1]);
        const double middle = (c[m] + 6 * c[m + 1] + c[m + 2]) / 8;
        const double right = 0.5 * (c[m + 1] + c[m + 2]);
        if (left <= 0 || middle <= 0 || right <= 0) { return infinity; }
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
    for (const Point& point : points_) {
        const Three three = three_from(c, point.interval);
        const double b = dot(point.weights, three);
        if (b <= 0) { return infinity; }
        if (point.b_max > 0) {
            if (b >= point.b_max) { return infinity; }
            product *= 1 - b / point.b_max;
        }
        const double w = std::sqrt(b);
        for (; force < point.force_end; ++force) {
            const ForceBound& bound = forces_[force];
            const double y = dot(bound.weights, three) + bound.damping * w;
            const double above = bound.high - y;
            const double below = y - bound.low;
            if (above <= 0 || below <= 0) { return infinity; }
            const double width = bound.high - bound.low;
            multiply(above * below / (width * width));
        }
        for (; jerk < point.jerk_end; ++jerk) {
            const JerkBound& bound = jerks_[jerk];
            const double y = dot(bound.weights, three) * w / bound.max;
            const double slack = 1 - y * y;
            if (slack <= 0) { return infinity; }
            multiply(slack);
        }
    }
    return time - barrier * (logs + std::log(product));
}

void PathTiming::add_derivatives(Vector c, double barrier, Result gradient, BandMatrix& hessian) const {
    add_duration(c, gradient, hessian);
    size_t force = 0;
    size_t jerk = 0;
    for (const Point& point : points_) {
        const size_t m = point.interval;
        const Three three = three_from(c, m);
        const SplineWeights& x = point.weights;
        const double b = dot(x, three);
        const double w = std::sqrt(b);
        if (point.b_max > 0) {
            const double slack = point.b_max - b;
            add(m, x, barrier / slack, barrier / (slack * slack), gradient, hessian);
        }
        for (; force < point.force_end; ++force) {
            const ForceBound& bound = forces_[force];
            const double y = dot(bound.weights, three) + bound.damping * w;
            const double damping = 0.5 * bound.damping / w;
            const double above = 1 / (bound.high - y);
            const double below = 1 / (y - bound.low);
            const SplineWeights g = {bound.weights[0] + damping * x[0], bound.weights[1] + damping * x[1],
                                     bound.weights[2] + damping * x[2]};
            // The curvature of w is left out: the Hessian stays positive definite without it.
            add(m, g, barrier * (above - below), barrier * (above * above + below * below), gradient, hessian);
        }
        for (; jerk < point.jerk_end; ++jerk) {
            const JerkBound& bound = jerks_[jerk];
            const double y = dot(bound.weights, three);
            const double max = bound.max / w;
            const double decrease = 0.5 * max / b;  // of this bound, with b
            for (const double sign : {-1.0, 1.0}) {
                const double inverse = 1 / (max - sign * y);
                const SplineWeights g = {sign * bound.weights[0] + decrease * x[0], sign * bound.weights[1] + decrease * x[1],
                                         sign * bound.weights[2] + decrease * x[2]};
                add(m, g, barrier * inverse, barrier * inverse * inverse, gradient, hessian);
            }
        }
    }
}

// The duration, by Simpson's rule in each interval.
void PathTiming::add_duration(Vector c, Result gradient, BandMatrix& hessian) const {
    struct SimpsonNode {
        double weight;
        SplineWeights of_c;  // in b
    };
    constexpr SimpsonNode nodes[] = {{1.0, {0.5, 0.5, 0.0}}, {4.0, {0.125, 0.75, 0.125}}, {1.0, {0.0, 0.5, 0.5}}};
    for (size_t m = 0; m < intervals_; ++m) {
        for (const SimpsonNode& node : nodes) {
            const double b = dot(node.of_c, three_from(c, m));
            const double slope = -0.5 * node.weight * h_ / 6.0 / (b * std::sqrt(b));
            add(m, node.of_c, slope, -1.5 * slope / b, gradient, hessian);
        }
    }
}

}  // namespace armctl
