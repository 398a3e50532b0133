// Timing of motions.

#include "arguments.hpp"
#include "path_timing.hpp"
#include "topics.hpp"
#include "waypoint_timing.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

bool find_path_speed(const Out& coefficients, double interval_length, bool from_near, const nb::kwargs& arguments) {
    const Arguments given(arguments);
    const SpeedBounds bounds(given);
    const Result c = coefficients.vector(coefficients.length("coefficients"), "coefficients");
    const nb::gil_scoped_release release;
    return fastest_path_speed(interval_length, bounds, from_near, c);
}

void make_motion_fastest(const Out& motion, const nb::kwargs& arguments) {
    const Arguments given(arguments);
    const Waypoints waypoints(given);
    if (waypoints.K < 2) { throw InputError("q: need at least 2 waypoints"); }
    const Result unknowns = motion.vector(waypoints.K * (2 * waypoints.n + 1) - 1, "motion");
    const nb::gil_scoped_release release;
    make_fastest(waypoints, unknowns);
}

// The greatest displacement, and its derivatives by the arguments.
nb::tuple slopes_of_displacement(double time, EndState start, EndState end, const JointBounds& bounds) {
    const Displacement found = farthest_displacement(time, start, end, bounds);
    return nb::make_tuple(found.distance, found.by_time, found.by_start.v, found.by_start.a, found.by_end.v, found.by_end.a);
}

}  // namespace

void bind_motion(nb::module_& module) {
    module.def("fastest_path_speed", &find_path_speed, "coefficients"_a, "interval_length"_a, "from_near"_a, "arguments"_a,
               "Fills the coefficients of the squared path speed that takes the least time; False if none keeps the bounds.\n\n"
               "With from_near they hold the solution for bounds that are a little different. armctl/cpp/path_timing.hpp explains\n"
               "the bounds.");
    module.def("make_fastest", &make_motion_fastest, "motion"_a, "arguments"_a,
               "Replaces a motion through K waypoints by the fastest one; armctl/cpp/waypoint_timing.hpp explains the arguments.");
    module.def(
        "farthest_displacement",
        [](double time, double v_start, double a_start, double v_end, double a_end, double v_max, double a_max, double j_max) {
            return slopes_of_displacement(time, {v_start, a_start}, {v_end, a_end}, {v_max, a_max, j_max});
        },
        "time"_a, "v_start"_a, "a_start"_a, "v_end"_a, "a_end"_a, "v_max"_a, "a_max"_a, "j_max"_a,
        "How far a joint can go between two states in a time, NaN if it cannot, and the derivatives by the time and the states.");
}

}  // namespace armctl
