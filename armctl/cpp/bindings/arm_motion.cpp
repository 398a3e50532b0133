// An arm along a path of its tip.
#include <nanobind/stl/shared_ptr.h>

#include "arrays.hpp"
#include "tip_follower.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

TipFollower make_follower(const Model& model, const In& q_min, const In& q_max, double centering, bool oriented) {
    return TipFollower(model, q_min.vector(model->n(), "q_min"), q_max.vector(model->n(), "q_max"), centering, oriented);
}

}  // namespace

// Steps take microseconds: they keep the GIL, which also keeps two threads from one object's scratch memory.
void bind_arm_motion(nb::module_& module) {
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
            [](TipFollower& self, const In& q, const In& slope, double length, const In& halfway, const In& position, const In& rotation,
               const Out& moved) {
                const Pose end = {Rotation::from_rows(rotation.shaped({3, 3}, "rotation")), vec3(position.vector(3, "position"))};
                return self.step(q.vector(self.n(), "q"), slope.vector(self.n(), "slope"), length, halfway.vector(self.rows(), "halfway"),
                                 end, moved.vector(self.n(), "moved"));
            },
            "q"_a, "slope"_a, "length"_a, "halfway"_a, "position"_a, "rotation"_a, "moved"_a,
            "Moves the joints a step along the path, with the twist half a step further, to a pose there.\n\n"
            "Returns whether the tip arrives.");
}

}  // namespace armctl
