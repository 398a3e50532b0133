// Times of the sections and velocities and accelerations at the waypoints that make a motion through them fast.
//
// A joint with given states at both ends of a section of given time can cover any displacement between a least and a greatest
// one. The greatest is concave in those states: its acceleration rises to its limit, falls along a line c - j t and rises
// again, and if that is too fast it cruises at its greatest speed. So a motion is possible exactly if the displacement of every
// joint in every section lies between the two, and the fastest one is found by an interior-point method: the sum of the times
// plus a logarithmic barrier. A bound involves the two ends of a section and its time only, so that a Newton step factorizes a
// band matrix, in time in proportion to the number of waypoints. The Hessian leaves out the curvature of the bounds.
//
// Where waypoints are dense, the bounds leave a narrow valley: velocity times duration must be the distance of two waypoints. It is
// curved in these unknowns, and a straight step leaves it at once. Distance, velocity times duration and acceleration times duration
// squared do not change if a motion runs slower or faster, so a step keeps to the valley if it changes those, and the logarithms of
// the durations, in a straight line.
//
// That optimal profiles are such ramps and plateaus is Pontryagin's principle, e.g. Bryson and Ho, "Applied Optimal Control",
// chapter 3.
#pragma once
#include <array>
#include <cmath>

#include "errors.hpp"
#include "interior_point.hpp"

namespace armctl {

// Weights of all barriers together, relative to the duration: the first from a slow motion or from near the solution, the last, and
// the factor from one to the next.
constexpr double waypoint_barrier_from_stops = 10.0;
constexpr double waypoint_barrier_from_near = 0.1;
constexpr double waypoint_barrier_last = 1e-4;
constexpr double waypoint_barrier_factor = 0.2;
constexpr double centered_share = 0.3;    // of the barrier
constexpr double position_margin = 1e-9;  // rad (m), kept from every displacement, against rounding
constexpr double ridge = 1e-10;           // of the Hessian's diagonal, against rounding
constexpr double line_tolerance = 1e-9;   // relative, of the place of the falling line

struct JointBounds {
    double v_max;
    double a_max;
    double j_max;
};

struct EndState {
    double v;
    double a;
};

// The greatest displacement of a joint in a section, NaN if there is none, and its derivatives by the time and the end states.
struct Displacement {
    double distance;
    double by_time = 0.0;
    EndState by_start = {0.0, 0.0};
    EndState by_end = {0.0, 0.0};
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

// The way to a speed that is then kept: the acceleration rises to its peak, stays there, and falls to zero.
struct Ramp {
    double lag;     // distance behind a joint that has this speed already
    double rise;    // s, until the peak
    double middle;  // s, until the middle of the fall
};

// To a speed u above the joint's own, from the acceleration a.
inline Ramp ramp_to_speed(double u, double a, double a_max, double j_max) {
    const double peak = std::sqrt(std::max(j_max * u + 0.5 * a * a, 0.0));
    const double top = std::min(peak, a_max);
    const double flat = peak > a_max ? (u - (top * top - 0.5 * a * a) / j_max) / top : 0.0;
    const double rise = (top - a) / j_max;
    const double fall = top * top / (2 * j_max);  // the change of speed in it
    double lag = fall * top / (3 * j_max) + flat * (fall + 0.5 * top * flat);
    lag += rise * (fall + top * flat + rise * (0.5 * top - j_max * rise / 6));
    return {lag, rise, rise + flat + 0.5 * top / j_max};
}

// One unknown that a bound depends on, and the derivative of the bound's slack.
struct Dependence {
    size_t row;
    double slope;
    double decline = 0.0;  // of the slope; 0 where the Hessian leaves it out
};

// Adds the derivatives of the barrier of a bound, whose unknowns are in ascending order.
template <size_t count>
void add_bound(const std::array<Dependence, count>& unknowns, double barrier, double slack, Result gradient, BandMatrix& hessian) {
    for (size_t r = 0; r < count; ++r) {
        const double slope = barrier / slack * unknowns[r].slope;
        gradient[unknowns[r].row] -= slope;
        hessian.at(unknowns[r].row, 0) += barrier / slack * unknowns[r].decline;
        if (slope == 0.0) { continue; }
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
    // A later fall moves the joint on; so does a change of a state at an end, from there to the middle of the fall.
    const auto displacement = [](double distance, double by_time, double rise, double middle, double last_rise, double left) {
        return Displacement{distance, by_time, {middle, rise * (middle - 0.5 * rise)}, {left, -last_rise * (left - 0.5 * last_rise)}};
    };
    const double top = std::min(a_max, 0.5 * (c + start.a));
    const double bottom = std::max(-a_max, 0.5 * (c + end.a) - 0.5 * j_max * time);
    const double rise = (top - start.a) / j_max;
    const double fall = (top - bottom) / j_max;
    const double last_rise = (end.a - bottom) / j_max;
    const double high = std::max(0.0, (c + start.a - 2 * a_max) / j_max);
    const double low = std::max(0.0, (j_max * time - end.a - 2 * a_max - c) / j_max);
    const double peak_velocity = start.v + (2 * top * top - start.a * start.a) / (2 * j_max) + top * high;
    if (top > 0.0 && 0.0 > bottom && peak_velocity > v_max) {
        const Ramp first = ramp_to_speed(v_max - start.v, start.a, a_max, j_max);
        const Ramp last = ramp_to_speed(v_max - end.v, -end.a, a_max, j_max);  // backwards in time
        return displacement(v_max * time - first.lag - last.lag, v_max, first.rise, first.middle, last.rise, last.middle);
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
    const double middle = rise + high + 0.5 * fall;
    const double by_time = end.v - 0.5 * j_max * last_rise * last_rise - (time - middle) * bottom;
    return displacement(q, by_time, rise, middle, last_rise, time - middle);
}

// K waypoints of n joints; the arrays are the caller's.
struct WaypointBounds {
    Matrix q;      // (K, n)
    Vector v_max;  // (n,) the limits of the joints
    Vector a_max;
    Vector j_max;
    Matrix v_bound;  // (K, n) the greatest velocity at each waypoint; 0 holds it at 0
    Matrix a_bound;  // (K, n) and acceleration
};

// The problem for `minimize_with_barriers`: time plus barrier.
//
// The unknowns x go from waypoint to waypoint: velocity and acceleration of each joint, then the time of the section behind it.
class WaypointTiming {
public:
    WaypointTiming(const WaypointBounds& bounds, bool from_near)
        : from_near_(from_near), K_(bounds.q.rows), n_(bounds.q.columns), bounds_(bounds) {
        if (K_ < 2) { throw InputError("q: need at least 2 waypoints"); }
    }

    size_t unknowns() const { return time_row(K_ - 1); }

    // Replaces a motion by the fastest one. It must be inside all bounds, for example slow enough to stop at every waypoint; from near
    // the solution, a small barrier lets it stay there.
    void solve(Result x) const {
        const double first = from_near_ ? waypoint_barrier_from_near : waypoint_barrier_from_stops;
        const double unit = total_time(x) / (4.0 * static_cast<double>((K_ - 1) * n_));  // four bounds for each joint and section
        minimize_with_barriers(*this, x, 2 * n_ + 3, {first * unit, waypoint_barrier_last * unit, waypoint_barrier_factor, centered_share});
    }

    double cost(Vector x, double barrier) const {
        LogarithmSum logs;
        const bool is_inside = visit_bounds(x, [&logs](double slack, const auto&) { return logs.add(slack); });
        return is_inside ? total_time(x) - barrier * logs.sum() : INFINITE;
    }

    void add_derivatives(Vector x, double barrier, Result gradient, BandMatrix& hessian) const {
        visit_bounds(x, [&](double slack, const auto& unknowns) {
            add_bound(unknowns, barrier, slack, gradient, hessian);
            return true;
        });
        for (size_t k = 0; k + 1 < K_; ++k) {
            gradient[time_row(k)] += 1.0;
            if (from_near_) { hessian.at(time_row(k), 0) += 1.0 / x[time_row(k)]; }  // the duration is convex in its logarithm
        }
        for (size_t row = 0; row < hessian.size(); ++row) { hessian.at(row, 0) *= 1.0 + ridge; }
        for (size_t k = 0; k < K_; ++k) {
            for (size_t i = 0; i < n_; ++i) {
                if (bounds_.v_bound(k, i) == 0.0) { hessian.at(velocity_row(k, i), 0) = INFINITE; }
                if (bounds_.a_bound(k, i) == 0.0) { hessian.at(velocity_row(k, i) + 1, 0) = INFINITE; }
            }
        }
    }

    // Near the solution, durations change by a factor, velocities and accelerations in units of the mean duration of the sections at
    // their waypoint. From stops, where most of the motion changes, straight steps lead to faster motions (by 1 % in random walks).
    void move(Vector x, Vector step, double share, Result moved) const {
        if (!from_near_) {
            for (size_t row = 0; row < x.size(); ++row) { moved[row] = x[row] + share * step[row]; }
            return;
        }
        for (size_t k = 0; k < K_; ++k) {
            double time = 0.0;
            double change = 0.0;
            for (size_t section = k > 0 ? k - 1 : 0; section < std::min(k + 1, K_ - 1); ++section) {
                time += x[time_row(section)];
                change += step[time_row(section)];
            }
            const double rate = change / time;
            const double factor = std::exp(-share * rate);
            for (size_t row = velocity_row(k, 0); row < velocity_row(k, n_); row += 2) {
                moved[row] = factor * (x[row] + share * (step[row] + rate * x[row]));
                moved[row + 1] = factor * factor * (x[row + 1] + share * (step[row + 1] + 2 * rate * x[row + 1]));
            }
            if (k + 1 < K_) { moved[time_row(k)] = x[time_row(k)] * std::exp(share * step[time_row(k)] / x[time_row(k)]); }
        }
    }

private:
    size_t velocity_row(size_t waypoint, size_t joint) const { return waypoint * (2 * n_ + 1) + 2 * joint; }
    size_t time_row(size_t section) const { return velocity_row(section, n_); }
    double total_time(Vector x) const {
        double total = 0.0;
        for (size_t k = 0; k + 1 < K_; ++k) { total += x[time_row(k)]; }
        return total;
    }

    // Calls visit(slack, unknowns) for every bound as long as it returns true. The slack is positive inside; unknowns tell how it
    // changes.
    template <class Visit>
    bool visit_bounds(Vector x, const Visit& visit) const {
        for (size_t k = 0; k < K_; ++k) {
            for (size_t i = 0; i < n_; ++i) {
                for (const double sign : {-1.0, 1.0}) {
                    if (!visit_waypoint(x, k, i, sign, visit) || (k + 1 < K_ && !visit_section(x, k, i, sign, visit))) { return false; }
                }
            }
        }
        return true;
    }

    // The bounds on velocity and acceleration at a waypoint.
    template <class Visit>
    bool visit_waypoint(Vector x, size_t waypoint, size_t joint, double sign, const Visit& visit) const {
        const double v_bound = bounds_.v_bound(waypoint, joint);
        const double a_bound = bounds_.a_bound(waypoint, joint);
        const size_t v_row = velocity_row(waypoint, joint);
        const size_t a_row = v_row + 1;
        const double a = x[a_row];
        if (v_bound > 0.0 && !visit(v_bound - sign * x[v_row], std::array{Dependence{v_row, -sign}})) { return false; }
        if (a_bound > 0.0 && !visit(a_bound - sign * a, std::array{Dependence{a_row, -sign}})) { return false; }
        // The velocity that is reached while the acceleration goes to zero.
        const double peak = sign * x[v_row] + a * a / (2 * bounds_.j_max[joint]);
        const double decline = 1.0 / bounds_.j_max[joint];
        return visit(bounds_.v_max[joint] - peak, std::array{Dependence{v_row, -sign}, Dependence{a_row, -a * decline, decline}});
    }

    // How much further a joint could go in a section, forwards (sign 1) or backwards (-1).
    template <class Visit>
    bool visit_section(Vector x, size_t section, size_t joint, double sign, const Visit& visit) const {
        const size_t start = velocity_row(section, joint);
        const size_t time = time_row(section);
        const size_t end = velocity_row(section + 1, joint);
        const Displacement most = farthest_displacement(x[time], {sign * x[start], sign * x[start + 1]}, {sign * x[end], sign * x[end + 1]},
                                                        {bounds_.v_max[joint], bounds_.a_max[joint], bounds_.j_max[joint]});
        const double way = sign * (bounds_.q(section + 1, joint) - bounds_.q(section, joint));
        const std::array unknowns = {Dependence{start, sign * most.by_start.v}, Dependence{start + 1, sign * most.by_start.a},
                                     Dependence{time, most.by_time}, Dependence{end, sign * most.by_end.v},
                                     Dependence{end + 1, sign * most.by_end.a}};
        return visit(most.distance - way - position_margin, unknowns);
    }

    bool from_near_;
    size_t K_;
    size_t n_;
    WaypointBounds bounds_;
};

}  // namespace armctl
