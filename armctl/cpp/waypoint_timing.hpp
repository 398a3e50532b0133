// Times of the sections and velocities and accelerations at the waypoints that make a motion through them fast.
//
// A joint with given states at both ends of a section of given time can cover any displacement between a least and a greatest
// one. The greatest is concave in those states: its acceleration rises to its limit, falls along a line c - j t and rises
// again, and if that is too fast it cruises at its greatest speed. So a motion is possible exactly if the displacement of every
// joint in every section lies between the two, and the fastest one is found by an interior-point method: the sum of the times
// plus a logarithmic barrier. A bound involves the two ends of a section and its time only, so that a Newton step factorizes a
// band matrix, in time in proportion to the number of waypoints. The Hessian leaves out the curvature of the bounds.
//
// That optimal profiles are such ramps and plateaus is Pontryagin's principle, e.g. Bryson and Ho, "Applied Optimal Control",
// chapter 3.
#pragma once
#include <array>
#include <cmath>

#include "arguments.hpp"
#include "interior_point.hpp"

namespace armctl {

// Weights of all barriers together, relative to the duration: the first, the last, and the factor from one to the next.
constexpr double waypoint_barrier_first = 10.0;
constexpr double waypoint_barrier_last = 3e-4;
constexpr double waypoint_barrier_factor = 0.2;
constexpr double centered_share = 0.3;     // of the barrier
constexpr double position_margin = 1e-9;   // rad (m), kept from every displacement, against rounding
constexpr double ridge = 1e-10;            // of the Hessian's diagonal, against rounding
constexpr double negligible_peak = 1e-12;  // rad/s^2, of the acceleration on the way to another speed
constexpr double line_tolerance = 1e-9;    // relative, of the place of the falling line

struct JointBounds {
    double v_max;
    double a_max;
    double j_max;
};

struct EndState {
    double v;
    double a;
};

// The greatest displacement of a joint in a section, NaN if there is none, and its derivatives.
struct Displacement {
    double distance;
    double by_time = 0.0;
    EndState by_start = {0.0, 0.0};
    EndState by_end = {0.0, 0.0};
};

// Waypoints q (K, n), the limits of the n joints, and the greatest velocity and acceleration of each joint at each waypoint,
// (K, n): 0 holds it at 0.
struct Waypoints {
    explicit Waypoints(const Arguments& a) : arguments(a) {}

    const Arguments& arguments;
    size_t K = arguments.length("q");
    size_t n = arguments.length("v_max");
    Matrix q = arguments.matrix(K, n, "q");
    Vector v_max = arguments.vector(n, "v_max");
    Vector a_max = arguments.vector(n, "a_max");
    Vector j_max = arguments.vector(n, "j_max");
    Matrix v_bound = arguments.matrix(K, n, "v_bound");
    Matrix a_bound = arguments.matrix(K, n, "a_bound");
};

// The c of the falling line c - j t of the acceleration that goes furthest; NaN if no acceleration makes this change of velocity.
inline double falling_line(double time, EndState start, EndState end, const JointBounds& joint) {
    const double a_max = joint.a_max;
    const double j_max = joint.j_max;
    const double below = start.a;
    const double above = end.a + j_max * time;
    if (above < below || end.a - j_max * time > start.a) { return NOT_A_NUMBER; }
    const double flat_top = 2 * a_max - start.a;  // c above and below which a limit is reached
    const double flat_bottom = j_max * time - end.a - 2 * a_max;
    double left = below;
    for (double right : {std::min(flat_top, flat_bottom), std::max(flat_top, flat_bottom), above}) {
        right = std::min(std::max(right, below), above);
        const double top = std::min(a_max, 0.5 * (right + start.a));
        const double bottom = std::max(-a_max, 0.5 * (right + end.a) - 0.5 * j_max * time);
        double change = (2 * (top * top - bottom * bottom) + end.a * end.a - start.a * start.a) / (2 * j_max);
        change += a_max * (std::max(0.0, right - flat_top) - std::max(0.0, flat_bottom - right)) / j_max;
        if (change >= end.v - start.v) {  // between left and right the change of velocity is quadratic in c
            const double middle = 0.5 * (left + right);
            const double bend = (middle < flat_top ? 0.5 : 0.0) - (middle > flat_bottom ? 0.5 : 0.0);
            const double slope = top - bottom;
            const double over = j_max * (change - end.v + start.v);
            const double root = slope + std::sqrt(std::max(slope * slope - 2 * bend * over, 0.0));
            const double c = right - (over > 0 ? 2 * over / root : 0.0);
            return c >= left - line_tolerance * (1 + std::abs(left)) ? c : NOT_A_NUMBER;
        }
        left = right;
    }
    return NOT_A_NUMBER;
}

// How far behind a joint falls on its way to another speed, and the derivatives.
struct Lag {
    double distance = 0.0;
    double by_speed = 0.0;
    double by_acceleration = 0.0;
};

// The lag on the way to a speed u above the joint's own, from the acceleration a.
inline Lag lag_to_speed(double u, double a, double a_max, double j_max) {
    double top = std::sqrt(std::max(j_max * u + 0.5 * a * a, 0.0));
    if (top < negligible_peak) { return {}; }
    double flat = 0.0;
    if (top > a_max) {
        top = a_max;
        flat = (u - (a_max * a_max - 0.5 * a * a) / j_max) / a_max;
    }
    const double rise = (top - a) / j_max;
    const double fall = top * top / (2 * j_max);  // the change of speed in it
    Lag lag;
    lag.distance = fall * top / (3 * j_max) + flat * (fall + 0.5 * top * flat);
    lag.distance += rise * (fall + top * flat + rise * (0.5 * top - j_max * rise / 6));
    if (flat > 0.0) {
        lag.by_speed = (fall + top * flat + top * rise) / top;
    } else {
        lag.by_speed = (fall / j_max + top * rise / j_max + 0.5 * rise * rise + u / j_max) * j_max / (2 * top);
    }
    lag.by_acceleration = lag.by_speed * a / j_max - u / j_max;
    return lag;
}

// One unknown that a bound depends on, and the derivative of the bound's slack.
struct Dependence {
    size_t row;
    double slope;
};

// Adds the derivatives of the barrier of a bound, whose unknowns are in ascending order.
template <size_t count>
void add_bound(const std::array<Dependence, count>& unknowns, double barrier, double slack, Result gradient, BandMatrix& hessian) {
    for (size_t r = 0; r < count; ++r) {
        const double slope = barrier / slack * unknowns[r].slope;
        if (slope == 0.0) { continue; }
        gradient[unknowns[r].row] -= slope;
        for (size_t c = r; c < count; ++c) {
            hessian.at(unknowns[r].row, unknowns[c].row - unknowns[r].row) += slope * unknowns[c].slope / slack;
        }
    }
}

inline Displacement farthest_displacement(double time, EndState start, EndState end, const JointBounds& joint) {
    const double v_max = joint.v_max;
    const double a_max = joint.a_max;
    const double j_max = joint.j_max;
    const double c = falling_line(time, start, end, joint);
    if (std::isnan(c)) { return {.distance = NOT_A_NUMBER}; }
    const double top = std::min(a_max, 0.5 * (c + start.a));
    const double bottom = std::max(-a_max, 0.5 * (c + end.a) - 0.5 * j_max * time);
    const double rise = (top - start.a) / j_max;
    const double fall = (top - bottom) / j_max;
    const double last_rise = (end.a - bottom) / j_max;
    const double high = std::max(0.0, (c + start.a - 2 * a_max) / j_max);
    const double low = std::max(0.0, (j_max * time - end.a - 2 * a_max - c) / j_max);
    const double peak_velocity = start.v + (2 * top * top - start.a * start.a) / (2 * j_max) + top * high;
    if (top > 0.0 && 0.0 > bottom && peak_velocity > v_max) {
        const Lag before = lag_to_speed(v_max - start.v, start.a, a_max, j_max);
        const Lag after = lag_to_speed(v_max - end.v, -end.a, a_max, j_max);
        return {
            .distance = v_max * time - before.distance - after.distance,
            .by_time = v_max,
            .by_start = {before.by_speed, -before.by_acceleration},
            .by_end = {after.by_speed, after.by_acceleration},
        };
    }
    struct Phase {
        double time;
        double jerk;
    };
    double q = 0.0;
    EndState now = start;
    for (const auto [h, j] : {Phase{rise, j_max}, Phase{high, 0.0}, Phase{fall, -j_max}, Phase{low, 0.0}, Phase{last_rise, j_max}}) {
        q += h * (now.v + h * (now.a / 2 + h * j / 6));
        now.v += h * (now.a + h * j / 2);
        now.a += h * j;
    }
    // An earlier or later line moves the middle of the fall.
    const double middle = rise + high + 0.5 * fall;
    const double left = time - middle;
    return {
        .distance = q,
        .by_time = end.v - 0.5 * j_max * last_rise * last_rise - left * bottom,
        .by_start = {middle, rise * (middle - 0.5 * rise)},
        .by_end = {left, -last_rise * (left - 0.5 * last_rise)},
    };
}

// The problem for `minimize_with_barriers`: time plus barrier.
class WaypointTiming {
public:
    explicit WaypointTiming(const Waypoints& waypoints) : waypoints_(waypoints), n_(waypoints.n) {}

    void solve(Result x) const {
        const double first = waypoint_barrier_first * total_time(x) / barrier_count();
        minimize_with_barriers(*this, x, BarrierSchedule{.first = first, .factor = waypoint_barrier_factor, .centered = centered_share});
    }

    double cost(Vector x, double barrier) const {
        double logs = 0.0;
        for (size_t k = 0; k < count(); ++k) {
            for (size_t i = 0; i < n_; ++i) {
                const EndState now = state(x, k, i);
                const double v_bound = waypoints_.v_bound(k, i);
                const double a_bound = waypoints_.a_bound(k, i);
                for (const double share : {v_bound > 0.0 ? now.v / v_bound : 0.0, a_bound > 0.0 ? now.a / a_bound : 0.0}) {
                    const double slack = 1.0 - share * share;
                    if (slack <= 0.0) { return INFINITE; }
                    logs += std::log(slack);
                }
                for (const double sign : {-1.0, 1.0}) {
                    const JointBounds joint = bounds(i);
                    const double slack = 1.0 - (sign * now.v + now.a * now.a / (2 * joint.j_max)) / joint.v_max;
                    if (slack <= 0.0) { return INFINITE; }
                    logs += std::log(slack);
                    if (k + 1 < count()) {
                        const double room = slack_of_displacement(x, k, i, sign).distance;
                        if (!(room > 0.0)) { return INFINITE; }
                        logs += std::log(room);
                    }
                }
            }
        }
        return total_time(x) - barrier * logs;
    }

    void add_derivatives(Vector x, double barrier, Result gradient, BandMatrix& hessian) const {
        for (size_t k = 0; k < count(); ++k) {
            for (size_t i = 0; i < n_; ++i) { add_waypoint(x, k, i, barrier, gradient, hessian); }
        }
        for (size_t k = 0; k + 1 < count(); ++k) {
            gradient[time_row(k)] += 1.0;
            for (size_t i = 0; i < n_; ++i) {
                for (const double sign : {-1.0, 1.0}) { add_section(x, k, i, sign, barrier, gradient, hessian); }
            }
        }
        for (size_t row = 0; row < hessian.size(); ++row) { hessian.at(row, 0) *= 1.0 + ridge; }
    }

    bool is_last(Vector x, double barrier) const { return barrier_count() * barrier <= waypoint_barrier_last * total_time(x); }
    size_t band_width() const { return 2 * n_ + 3; }

private:
    size_t count() const { return waypoints_.q.rows; }
    JointBounds bounds(size_t joint) const { return {waypoints_.v_max[joint], waypoints_.a_max[joint], waypoints_.j_max[joint]}; }
    size_t velocity_row(size_t waypoint, size_t joint) const { return waypoint * (2 * n_ + 1) + 2 * joint; }
    size_t time_row(size_t section) const { return velocity_row(section, n_); }
    EndState state(Vector x, size_t waypoint, size_t joint) const {
        const size_t row = velocity_row(waypoint, joint);
        return {x[row], x[row + 1]};
    }
    double total_time(Vector x) const {
        double total = 0.0;
        for (size_t k = 0; k + 1 < count(); ++k) { total += x[time_row(k)]; }
        return total;
    }
    // Two for each joint and section, and as many for the states at waypoints.
    double barrier_count() const { return 4.0 * static_cast<double>(count() - 1) * static_cast<double>(n_); }

    // How much further a joint could go in a section, forwards (sign 1) or backwards (-1); NaN if it cannot.
    Displacement slack_of_displacement(Vector x, size_t section, size_t joint, double sign) const {
        const EndState start = state(x, section, joint);
        const EndState end = state(x, section + 1, joint);
        const double way = sign * (waypoints_.q(section + 1, joint) - waypoints_.q(section, joint));
        Displacement slack =
            farthest_displacement(x[time_row(section)], {sign * start.v, sign * start.a}, {sign * end.v, sign * end.a}, bounds(joint));
        slack.distance = slack.distance - way - position_margin;
        return slack;
    }

    // The barriers on the velocity and acceleration of a joint at a waypoint.
    void add_waypoint(Vector x, size_t waypoint, size_t joint, double barrier, Result gradient, BandMatrix& hessian) const {
        const EndState now = state(x, waypoint, joint);
        const double v_bound = waypoints_.v_bound(waypoint, joint);
        const double a_bound = waypoints_.a_bound(waypoint, joint);
        const auto [v_max, a_max, j_max] = bounds(joint);
        const size_t v_row = velocity_row(waypoint, joint);
        const size_t a_row = v_row + 1;
        const auto add_symmetric = [&](size_t row, double value, double bound) {
            if (bound == 0.0) {
                hessian.at(row, 0) += 1.0;
            } else {
                const double slack = bound * bound - value * value;
                gradient[row] += barrier * 2 * value / slack;
                hessian.at(row, 0) += barrier * 2 * (bound * bound + value * value) / (slack * slack);
            }
        };
        add_symmetric(v_row, now.v, v_bound);
        add_symmetric(a_row, now.a, a_bound);
        for (const double sign : {-1.0, 1.0}) {
            // The velocity that is reached while the acceleration goes to zero.
            const double slack = v_max - sign * now.v - now.a * now.a / (2 * j_max);
            const Dependence by_v = {v_row, v_bound > 0.0 ? -sign : 0.0};
            const Dependence by_a = {a_row, a_bound > 0.0 ? -now.a / j_max : 0.0};
            add_bound(std::array{by_v, by_a}, barrier, slack, gradient, hessian);
            if (a_bound > 0.0) { hessian.at(a_row, 0) += barrier / slack / j_max; }
        }
    }

    // The barrier on the displacement of a joint in a section.
    void add_section(Vector x, size_t section, size_t joint, double sign, double barrier, Result gradient, BandMatrix& hessian) const {
        const Displacement slack = slack_of_displacement(x, section, joint, sign);
        const auto slope = [](double bound, double value) { return bound > 0.0 ? value : 0.0; };
        const size_t start_row = velocity_row(section, joint);
        const size_t end_row = velocity_row(section + 1, joint);
        const std::array unknowns = {
            Dependence{start_row, slope(waypoints_.v_bound(section, joint), sign * slack.by_start.v)},
            Dependence{start_row + 1, slope(waypoints_.a_bound(section, joint), sign * slack.by_start.a)},
            Dependence{time_row(section), slack.by_time},
            Dependence{end_row, slope(waypoints_.v_bound(section + 1, joint), sign * slack.by_end.v)},
            Dependence{end_row + 1, slope(waypoints_.a_bound(section + 1, joint), sign * slack.by_end.a)},
        };
        add_bound(unknowns, barrier, slack.distance, gradient, hessian);
    }

    Waypoints waypoints_;
    size_t n_;
};

// Replaces a motion by the fastest one. It goes from waypoint to waypoint: velocity and acceleration of each joint, then the
// time of the section behind it, which must be long enough to stop at every waypoint.
inline void make_fastest(const Waypoints& waypoints, Result motion) { WaypointTiming(waypoints).solve(motion); }

}  // namespace armctl
