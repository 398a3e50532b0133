// An arm at many states of a motion, and along a path of its tip.
#include <nanobind/stl/shared_ptr.h>

#include "arrays.hpp"
#include "dynamics.hpp"
#include "tip_follower.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

using Model = std::shared_ptr<const ArmModel>;

// States of a motion: (T, n) each. A call has its own scratch memory and runs without the GIL.
using Release = nb::call_guard<nb::gil_scoped_release>;

void inverse_dynamics_along(const Model& model, const In& q, const In& v, const In& a, const Out& tau) {
    const size_t count = q.length("q");
    const Matrix positions = q.matrix(count, model->n(), "q");
    const Matrix velocities = v.matrix(count, model->n(), "v");
    const Matrix accelerations = a.matrix(count, model->n(), "a");
    const MatrixResult torques = tau.matrix(count, model->n(), "tau");
    Dynamics dynamics(model);
    for (size_t k = 0; k < count; ++k) {
        dynamics.inverse_dynamics(positions.row(k), velocities.row(k), accelerations.row(k), torques.row(k));
    }
}

void gravity_along(const Model& model, const In& q, const Out& tau) {
    const Matrix positions = q.matrix(q.length("q"), model->n(), "q");
    const MatrixResult torques = tau.matrix(positions.rows, model->n(), "tau");
    Dynamics dynamics(model);
    for (size_t k = 0; k < positions.rows; ++k) { dynamics.gravity(positions.row(k), torques.row(k)); }
}

void tip_twists_along(const Model& model, const In& q, const In& v, const Out& twists) {
    const Matrix positions = q.matrix(q.length("q"), model->n(), "q");
    Dynamics dynamics(model);
    tip_twists(dynamics, positions, v.matrix(positions.rows, model->n(), "v"), twists.matrix(positions.rows, 6, "twists"));
}

Pose pose_of(const In& position, const In& rotation) {
    return {Rotation::from_rows(rotation.shaped({3, 3}, "rotation")), vec3(position.vector(3, "position"))};
}

TipFollower make_follower(const Model& model, const In& q_min, const In& q_max, double centering, bool oriented) {
    return TipFollower(model, q_min.vector(model->n(), "q_min"), q_max.vector(model->n(), "q_max"), centering, oriented);
}

// Steps take microseconds: they keep the GIL, which also keeps two threads from one object's scratch memory.
void bind_tip_follower(nb::module_& module) {
    nb::class_<TipFollower>(module, "TipFollower", "Joints that keep the tip on a path, step by step.")
        .def(nb::new_(&make_follower), nb::kw_only(), "model"_a, "q_min"_a, "q_max"_a, "centering"_a, "oriented"_a,
             "Joints that a path leaves free go to the middle of their ranges at the rate `centering`.\n\n"
             "Twists are (6,) if the path is oriented, else (3,).")
        .def(
            "slope",
            [](TipFollower& self, const In& q, const In& twist, const Out& v) {
                self.slope(q.vector(self.n(), "q"), twist.vector(self.rows(), "twist"), v.vector(self.n(), "v"));
            },
            "q"_a, "twist"_a, "v"_a, "The joint velocities (n,) that make a twist of the tip.")
        .def(
            "step",
            [](TipFollower& self, const In& q, const In& slope, double length, const In& halfway, const In& end, const In& position,
               const In& rotation, const Out& moved) {
                const PathPoint goal = {pose_of(position, rotation), end.vector(self.rows(), "end")};
                return self.step(q.vector(self.n(), "q"), slope.vector(self.n(), "slope"), length, halfway.vector(self.rows(), "halfway"),
                                 goal, moved.vector(self.n(), "moved"));
            },
            "q"_a, "slope"_a, "length"_a, "halfway"_a, "end"_a, "position"_a, "rotation"_a, "moved"_a,
            "Moves the joints a step along the path, with the twists half a step and a step further, to a pose there.\n\n"
            "Returns whether the tip arrives.")
        .def(
            "distance",
            [](TipFollower& self, const In& q, const In& position, const In& rotation) {
                return self.distance(q.vector(self.n(), "q"), pose_of(position, rotation));
            },
            "q"_a, "position"_a, "rotation"_a, "How far the tip is from a pose, m and rad; the point alone if not oriented.");
}

}  // namespace

void bind_arm_motion(nb::module_& module) {
    module.def("inverse_dynamics_along", &inverse_dynamics_along, "model"_a, "q"_a, "v"_a, "a"_a, "tau"_a, Release(),
               "Inverse dynamics without dry friction at many states: (T, n) N m.");
    module.def("gravity_along", &gravity_along, "model"_a, "q"_a, "tau"_a, Release(),
               "The torques that hold the arm still at many positions: (T, n) N m.");
    module.def("tip_twists_along", &tip_twists_along, "model"_a, "q"_a, "v"_a, "twists"_a, Release(),
               "The twists (T, 6) of the tip, linear first, world axes, at many states.");
    bind_tip_follower(module);
}

}  // namespace armctl
