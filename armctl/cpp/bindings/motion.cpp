// Timing of motions, and how far they leave their limits.
#include <nanobind/nanobind.h>

#include <string>

#include "arrays.hpp"
#include "errors.hpp"
#include "limit_excess.hpp"
#include "path_timing.hpp"
#include "polynomials.hpp"
#include "topics.hpp"
#include "waypoint_timing.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

// Coefficients (pieces, degree + 1, joints), of which a derivative is taken.
PolynomialSpan polynomials_of(const In& coefficients, size_t order) {
    const size_t pieces = coefficients.length("coefficients");
    const size_t count = coefficients.length("coefficients", 1);
    const size_t joints = coefficients.length("coefficients", 2);
    if (count <= order || count > max_polynomial_degree + 1) {
        throw InputError("coefficients: need polynomials of a degree from " + std::to_string(order) + " to " +
                         std::to_string(max_polynomial_degree));
    }
    return {coefficients.shaped({pieces, count, joints}, "coefficients"), pieces, count - 1, joints};
}

void bind_limit_excess(nb::module_& module) {
    module.def(
        "limit_excess",
        [](const In& coefficients, const In& steps, size_t order, const In& low, const In& high, const Out& excess) {
            const PolynomialSpan motion = polynomials_of(coefficients, order);
            const Vector lengths = steps.vector(motion.pieces, "steps");
            const Matrix lows = low.matrix(motion.pieces, motion.joints, "low");
            const Matrix highs = high.matrix(motion.pieces, motion.joints, "high");
            const MatrixResult result = excess.matrix(motion.pieces, motion.joints, "excess");
            const nb::gil_scoped_release release;
            limit_excess(motion, lengths, order, lows, highs, result);
        },
        "coefficients"_a, "steps"_a, "order"_a, "low"_a, "high"_a, "excess"_a,
        "How far a derivative of each joint leaves [low, high] in each piece: exact where greater than 0, else at most 0.");
    module.def(
        "polynomial_extremes",
        [](const In& coefficients, size_t order, const Out& places, const Out& values) {
            const PolynomialSpan polynomials = polynomials_of(coefficients, order);
            const size_t rows = polynomials.pieces * polynomials.joints;
            const size_t columns = std::max<size_t>(2, polynomials.degree - order + 1);
            const MatrixResult at = places.matrix(rows, columns, "places");
            const MatrixResult found = values.matrix(rows, columns, "values");
            const nb::gil_scoped_release release;
            polynomial_extremes(polynomials, order, at, found);
        },
        "coefficients"_a, "order"_a, "places"_a, "values"_a,
        "Both ends of [0, 1] and the turning points of a derivative of each polynomial, and its values there.");
}

PathTiming make_path_timing(double interval_length, const IntegersIn& interval, const In& begin, const In& end, const In& q1, const In& q2,
                            const In& q3_after, const In& q3_before, const In& b_max, const In& j_max, const In& alpha, const In& beta,
                            const In& delta, const In& low, const In& high) {
    const size_t pieces = interval.length("interval");
    const size_t count = pieces + 1;
    const size_t joints = q1.length("q1", 1);
    const size_t rows = alpha.length("alpha", 1);
    const PathPieces places{
        .interval = interval.vector(pieces, "interval"),
        .begin = begin.vector(pieces, "begin"),
        .end = end.vector(pieces, "end"),
    };
    // Every interval has a piece.
    for (const std::int64_t number : places.interval) {
        if (number < 0 || static_cast<size_t>(number) >= pieces) {
            throw InputError("interval: every number must be at least 0 and below the number of pieces, " + std::to_string(pieces));
        }
    }
    const PathNodes nodes{
        .q1 = q1.matrix(count, joints, "q1"),
        .q2 = q2.matrix(count, joints, "q2"),
        .q3_after = q3_after.matrix(pieces, joints, "q3_after"),
        .q3_before = q3_before.matrix(pieces, joints, "q3_before"),
        .b_max = b_max.vector(count, "b_max"),
        .j_max = j_max.matrix(count, joints, "j_max"),
        .alpha = alpha.matrix(count, rows, "alpha"),
        .beta = beta.matrix(count, rows, "beta"),
        .delta = delta.matrix(count, rows, "delta"),
        .low = low.matrix(count, rows, "low"),
        .high = high.matrix(count, rows, "high"),
    };
    return PathTiming(interval_length, places, nodes);
}

void bind_path_timing(nb::module_& module) {
    nb::class_<PathTiming>(module, "PathTiming", "Bounds on the speed along a motion, and the speed that takes the least time.")
        .def(nb::new_(&make_path_timing), nb::kw_only(), "interval_length"_a, "interval"_a, "begin"_a, "end"_a, "q1"_a, "q2"_a,
             "q3_after"_a, "q3_before"_a, "b_max"_a, "j_max"_a, "alpha"_a, "beta"_a, "delta"_a, "low"_a, "high"_a,
             "A motion of n joints at N nodes, and its bounds there; armctl/cpp/path_timing.hpp explains them.")
        .def(
            "solve",
            [](const PathTiming& self, const Out& coefficients, bool from_near) {
                const Result c = coefficients.vector(self.coefficient_count(), "coefficients");
                const nb::gil_scoped_release release;
                return self.solve(c, from_near);
            },
            "coefficients"_a, "from_near"_a,
            "Fills the coefficients of the squared path speed; False if no speed is found that keeps the bounds.\n\n"
            "With from_near they hold the solution for bounds that are a little different.");
}

WaypointTiming make_waypoint_timing(const In& q, const In& v_max, const In& a_max, const In& j_max, const In& v_bound, const In& a_bound) {
    const size_t waypoints = q.length("q");
    const size_t joints = v_max.length("v_max");
    if (waypoints < 2) { throw InputError("q: need at least 2 waypoints"); }
    return WaypointTiming(q.matrix(waypoints, joints, "q"), v_max.vector(joints, "v_max"), a_max.vector(joints, "a_max"),
                          j_max.vector(joints, "j_max"), v_bound.matrix(waypoints, joints, "v_bound"),
                          a_bound.matrix(waypoints, joints, "a_bound"));
}

void bind_waypoint_timing(nb::module_& module) {
    nb::class_<Displacement>(module, "Displacement", "The greatest displacement of a joint, and its derivatives.")
        .def_ro("distance", &Displacement::distance)
        .def_ro("by_time", &Displacement::by_time)
        .def_prop_ro("by_start_velocity", [](const Displacement& self) { return self.by_start.v; })
        .def_prop_ro("by_start_acceleration", [](const Displacement& self) { return self.by_start.a; })
        .def_prop_ro("by_end_velocity", [](const Displacement& self) { return self.by_end.v; })
        .def_prop_ro("by_end_acceleration", [](const Displacement& self) { return self.by_end.a; });
    module.def(
        "farthest_displacement",
        [](double time, double v_start, double a_start, double v_end, double a_end, double v_max, double a_max, double j_max) {
            return farthest_displacement(time, {v_start, a_start}, {v_end, a_end}, {v_max, a_max, j_max});
        },
        "time"_a, "v_start"_a, "a_start"_a, "v_end"_a, "a_end"_a, "v_max"_a, "a_max"_a, "j_max"_a,
        "How far a joint can go between two states in a time; NaN if it cannot.");
    nb::class_<WaypointTiming>(module, "WaypointTiming", "Waypoints, and the fastest motion through them.")
        .def(nb::new_(&make_waypoint_timing), nb::kw_only(), "q"_a, "v_max"_a, "a_max"_a, "j_max"_a, "v_bound"_a, "a_bound"_a,
             "Waypoints (K, n), limits (n,), and the greatest velocity and acceleration at each waypoint (K, n), 0 to hold it.")
        .def(
            "solve",
            [](const WaypointTiming& self, const Out& durations, const Out& v, const Out& a) {
                const Result times = durations.vector(self.waypoint_count() - 1, "durations");
                const MatrixResult velocities = v.matrix(self.waypoint_count(), self.joint_count(), "v");
                const MatrixResult accelerations = a.matrix(self.waypoint_count(), self.joint_count(), "a");
                const nb::gil_scoped_release release;
                self.solve(times, velocities, accelerations);
            },
            "durations"_a, "v"_a, "a"_a,
            "Fills velocities and accelerations at the waypoints, and replaces durations that are long enough by the best.");
}

}  // namespace

void bind_motion(nb::module_& module) {
    bind_limit_excess(module);
    bind_path_timing(module);
    bind_waypoint_timing(module);
}

}  // namespace armctl
