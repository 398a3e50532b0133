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
    const Result c = coefficients.vector(coefficients.length("coefficients"), "coefficients");
    const PathTiming timing(given, interval_length, c.size());
    const nb::gil_scoped_release release;
    return timing.solve(from_near, c);
}

void make_motion_fastest(const Out& motion, bool from_near, const nb::kwargs& arguments) {
    const Arguments given(arguments);
    const WaypointTiming timing(given, from_near);
    const Result unknowns = motion.vector(timing.unknowns(), "motion");
    const nb::gil_scoped_release release;
    timing.solve(unknowns);
}

}  // namespace

void bind_motion(nb::module_& module) {
    module.def("fastest_path_speed", &find_path_speed, "coefficients"_a, "interval_length"_a, "from_near"_a, "arguments"_a,
               "Fills the coefficients of the squared path speed that takes the least time; False if none keeps the bounds.\n\n"
               "With from_near they hold the solution for bounds that are a little different. armctl/cpp/path_timing.hpp explains\n"
               "the bounds.");
    module.def("make_fastest", &make_motion_fastest, "motion"_a, "from_near"_a, "arguments"_a,
               "Replaces a motion through K waypoints by the fastest one.\n\n"
               "With from_near it is nearly that already. armctl/cpp/waypoint_timing.hpp explains the arguments.");
}

}  // namespace armctl
