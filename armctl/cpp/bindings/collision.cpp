// What an arm could touch, distances where it is, and proofs for whole motions.
//
// Queries run without the GIL.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/vector.h>

#include "arguments.hpp"
#include "clearance_proof.hpp"
#include "collision_scene.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

using Release = nb::call_guard<nb::gil_scoped_release>;

// The positions of all joints at q (n,); the memory is the thread's.
Vector all_positions(const CollisionScene& scene, const In& q) {
    thread_local std::vector<double> positions;
    positions.resize(scene.model().joints());
    scene.model().positions(q.vector(scene.model().n(), "q"), positions);
    return positions;
}

void find_all_hits(CollisionScene& scene, const In& q, double clearance, const IntegersOut& hits) {
    scene.all_hits(all_positions(scene, q), clearance, hits.vector(scene.model().pairs.size(), "hits"));
}

std::vector<NearPair> find_near_pairs(CollisionScene& scene, const In& q, const In& moves, double share, const In& clearances) {
    const Vector delta = moves.vector(scene.model().joints(), "moves");
    return scene.near_pairs(all_positions(scene, q), delta, share, clearances.vector(scene.model().pairs.size(), "clearances"));
}

void bind_scene(nb::module_& module) {
    nb::enum_<ShapeKind>(module, "ShapeKind", nb::is_arithmetic(), "The shape of a geom.")
        .value("HULL", ShapeKind::hull)
        .value("BOX", ShapeKind::box)
        .value("CYLINDER", ShapeKind::cylinder)
        .value("ELLIPSOID", ShapeKind::ellipsoid)
        .value("PLANE", ShapeKind::plane);
    nb::class_<CollisionModel>(module, "CollisionModel",
                               "What an arm could touch: shapes, the joints that move them, and pairs. Immutable.")
        .def(nb::new_([](const nb::kwargs& arguments) { return std::make_shared<CollisionModel>(Arguments(arguments)); }), "arguments"_a,
             "A model from arrays for each joint, geom, vertex and pair; armctl/cpp/collision_model.hpp explains them.");
    nb::class_<PairDistance>(module, "PairDistance", "A pair and its distance.")
        .def_ro("pair", &PairDistance::pair, "Its row, or the number of pairs where there is none.")
        .def_ro("distance", &PairDistance::distance, "m");
    nb::class_<NearPair>(module, "NearPair", "A pair, and how its distance changes.")
        .def_ro("pair", &NearPair::pair, "Its row.")
        .def_ro("distance", &NearPair::distance, "m; negative if it overlaps.")
        .def_ro("gradient", &NearPair::gradient, "The derivatives (n,) of the distance by the positions of the joints.");
    nb::class_<CollisionScene>(module, "CollisionScene",
                               "Distances where an arm is, with scratch memory: use an object in one thread at a time.")
        .def(nb::init<std::shared_ptr<const CollisionModel>>(), "model"_a)
        .def(
            "first_hit",
            [](CollisionScene& self, const In& q, double clearance) { return self.first_hit(all_positions(self, q), clearance); }, "q"_a,
            "clearance"_a, Release(),
            "A pair that is not farther apart than the clearance, m, at q (n,), or the number of pairs where there is none.")
        .def("all_hits", &find_all_hits, "q"_a, "clearance"_a, "hits"_a, Release(),
             "Marks every pair that is not farther apart than the clearance, (K,).")
        .def(
            "nearest_pair", [](CollisionScene& self, const In& q) { return self.nearest_pair(all_positions(self, q)); }, "q"_a, Release(),
            "The pair that is nearest to touching at q (n,); a distance at or below zero says that it overlaps.")
        .def("near_pairs", &find_near_pairs, "q"_a, "moves"_a, "share"_a, "clearances"_a, Release(),
             "The pairs that moves (m,) of all joints from q (n,) can bring nearer by more than a share of what is free, which is\n"
             "their distance less their clearance (K,).");
}

void keep_axis(ClearanceProof& proof, const In& q, size_t frame, const In& direction, double within) {
    proof.keep_axis(all_positions(proof.scene(), q), frame, vec3(direction.vector(3, "direction")), within);
}

void set_motion(ClearanceProof& proof, const In& knots, const In& coefficients) {
    const size_t pieces = std::max<size_t>(knots.length("knots"), 1) - 1;
    const size_t powers = coefficients.length("coefficients", 1);
    const size_t joints = proof.scene().model().joints();
    proof.motion().set(knots.vector(pieces + 1, "knots"), coefficients.shaped({pieces, powers, joints}, "coefficients"), joints);
}

std::optional<Hit> find_hit(ClearanceProof& proof, double clearance, std::optional<size_t> pair) {
    if (pair) { checked_index(static_cast<std::int64_t>(*pair), proof.scene().no_pair(), "pair"); }
    return proof.hit(clearance, pair);
}

void bind_proof(nb::module_& module) {
    nb::class_<Hit>(module, "Hit", "A pair that is not known to be free.")
        .def_ro("pair", &Hit::pair, "Its row; the number of pairs says that the kept axis tilts.")
        .def_ro("time", &Hit::time, "s");
    nb::class_<Approach>(module, "Approach", "How near a motion comes.")
        .def_ro("bound", &Approach::bound, "m, proved; negative if the clearance could not be proved.")
        .def_ro("distance", &Approach::distance, "m, that occurs: at most 0.2 mm above the bound, or where the proof failed.")
        .def_ro("nearest", &Approach::nearest, "Its pair and time.");
    nb::class_<ClearanceProof>(module, "ClearanceProof",
                               "Proofs for whole motions with scratch memory: use an object in one thread at a time.")
        .def(nb::init<std::shared_ptr<CollisionScene>>(), "scene"_a)
        .def("keep_axis", &keep_axis, "q"_a, "frame"_a, "direction"_a, "within"_a,
             "In the next proofs, the axis that moves with a frame and has a direction of the world (3,) at q (n,) may tilt by rad.")
        .def("release_axis", &ClearanceProof::release_axis, "Lets all axes tilt.")
        .def("set_motion", &set_motion, "knots"_a, "coefficients"_a,
             "Sets the motion of the next proofs: knots (K + 1,) s, and coefficients (K, degree + 1, m) of all joints by powers of the\n"
             "time since the knot, of degree 1 to 5.")
        .def("hit", &find_hit, "clearance"_a, "pair"_a = nb::none(), Release(),
             "Proves that the motion keeps all pairs, or one, farther apart than a clearance, m: None, or\n"
             "where it is not known to be free.")
        .def("closest_approach", &ClearanceProof::closest_approach, "clearance"_a, Release(), "Proves it, and how near the motion comes.");
}

}  // namespace

void bind_collision(nb::module_& module) {
    bind_scene(module);
    bind_proof(module);
}

}  // namespace armctl
