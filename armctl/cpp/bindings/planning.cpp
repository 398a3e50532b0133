// Collision-free paths in joint space.
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/vector.h>

#include "arrays.hpp"
#include "rrt_connect.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

RrtConnect make_rrt_connect(std::shared_ptr<ClearanceProof> proof, double clearance, const In& start, const In& goals, const In& low,
                            const In& high, size_t capacity) {
    const size_t n = proof->scene().model().n();
    return RrtConnect(std::move(proof), clearance, start.vector(n, "start"), goals.matrix(goals.length("goals"), n, "goals"),
                      low.vector(n, "low"), high.vector(n, "high"), capacity);
}

}  // namespace

void bind_planning(nb::module_& module) {
    nb::class_<RrtConnect>(module, "RrtConnect",
                           "Trees of proved lines from a start and from goals. Uses the proof's memory: one thread at a time.")
        .def(nb::new_(&make_rrt_connect), "proof"_a, "clearance"_a, "start"_a, "goals"_a, "low"_a, "high"_a, "capacity"_a,
             "Trees from a start (n,) and goals (g, n) that are free, between bounds (n,), with at most `capacity` nodes each.\n"
             "All lines keep more than the clearance, m, and the tip in the proof's region.")
        .def(
            "grow",
            [](RrtConnect& self, const In& samples) {
                const Matrix rows = samples.matrix(samples.length("samples"), self.n(), "samples");
                nb::gil_scoped_release release;
                return self.grow(rows);
            },
            "samples"_a, "Grows the trees towards samples (k, n) until they meet. Returns how many samples it took.")
        .def(
            "way",
            [](RrtConnect& self, const In& start, const In& goal) {
                return self.way(start.vector(self.n(), "start"), goal.vector(self.n(), "goal"));
            },
            "start"_a, "goal"_a, nb::call_guard<nb::gil_scoped_release>(),
            "The points of the way from a configuration (n,) to another in steps, as a tree grows; empty if something is in the way.")
        .def(
            "project", [](RrtConnect& self, const Out& q) { return self.project(q.matrix(q.length("q"), self.n(), "q")); }, "q"_a,
            nb::call_guard<nb::gil_scoped_release>(),
            "Moves configurations (k, n) by the least motion of the joints until the tip is well inside its region; False if it fails.")
        .def_prop_ro("step", &RrtConnect::step, "The longest line of a tree, rad (m).")
        .def("path", &RrtConnect::path, "The points from the start to a goal; empty as long as the trees have not met.");
}

}  // namespace armctl
