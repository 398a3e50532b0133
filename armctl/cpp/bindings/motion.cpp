// Timing of motions.

#include "arguments.hpp"
#include "path_timing.hpp"
#include "topics.hpp"
#include "waypoint_timing.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

template <class Given>
PathBounds path_bounds(Given& given) {
    const size_t points = given.length("interval");
    const size_t forces = given.length("damping");
    const size_t jerks = given.length("j_max");
    return {
        .interval = given.integers(points, "interval"),
        .weights = given.matrix(points, 3, "weights"),
        .b_max = given.vector(points, "b_max"),
        .force_end = given.integers(points, "force_end"),
        .force_weights = given.matrix(forces, 3, "force_weights"),
        .damping = given.vector(forces, "damping"),
        .low = given.vector(forces, "low"),
        .high = given.vector(forces, "high"),
        .jerk_end = given.integers(points, "jerk_end"),
        .jerk_weights = given.matrix(jerks, 3, "jerk_weights"),
        .j_max = given.vector(jerks, "j_max"),
    };
}

template <class Given>
WaypointBounds waypoint_bounds(Given& given) {
    const size_t waypoints = given.length("q");
    const size_t n = given.length("v_max");
    return {
        .q = given.matrix(waypoints, n, "q"),
        .v_max = given.vector(n, "v_max"),
        .a_max = given.vector(n, "a_max"),
        .j_max = given.vector(n, "j_max"),
        .v_bound = given.matrix(waypoints, n, "v_bound"),
        .a_bound = given.matrix(waypoints, n, "a_bound"),
    };
}

bool find_path_speed(const Out& coefficients, double interval_length, bool from_near, const nb::kwargs& bounds) {
    const Arguments given(bounds);
    const Result c = coefficients.vector(coefficients.length("coefficients"), "coefficients");
    const PathTiming timing(path_bounds(given), interval_length, c.size());
    const nb::gil_scoped_release release;
    return timing.solve(from_near, c);
}

void make_motion_fastest(const Out& motion, bool from_near, const nb::kwargs& bounds) {
    const Arguments given(bounds);
    const WaypointTiming timing(waypoint_bounds(given), from_near);
    const Result unknowns = motion.vector(timing.unknowns(), "motion");
    const nb::gil_scoped_release release;
    timing.solve(unknowns);
}

}  // namespace

void bind_motion(nb::module_& module) {
    const std::string path_speed = signature(
        "fastest_path_speed(coefficients: numpy.ndarray, interval_length: float, from_near: bool",
        [](auto& given) { return path_bounds(given); }, "bool");
    const std::string make_fastest =
        signature("make_fastest(motion: numpy.ndarray, from_near: bool", [](auto& given) { return waypoint_bounds(given); });
    module.def("fastest_path_speed", &find_path_speed, "coefficients"_a, "interval_length"_a, "from_near"_a, "bounds"_a,
               nb::sig(path_speed.c_str()),
               "Fills the coefficients of the squared path speed that takes the least time; False if none keeps the bounds.\n\n"
               "With from_near they hold the solution for bounds that are a little different. armctl/cpp/path_timing.hpp explains\n"
               "the bounds.");
    module.def("make_fastest", &make_motion_fastest, "motion"_a, "from_near"_a, "bounds"_a, nb::sig(make_fastest.c_str()),
               "Replaces a motion through K waypoints by the fastest one.\n\n"
               "With from_near it is nearly that already. armctl/cpp/waypoint_timing.hpp explains the arguments.");
}

}  // namespace armctl
