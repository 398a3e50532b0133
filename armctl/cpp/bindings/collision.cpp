// What an arm could touch, distances where it is, and proofs for whole motions.
#include <nanobind/nanobind.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/vector.h>

#include <algorithm>

#include "arrays.hpp"
#include "clearance_proof.hpp"
#include "collision_scene.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

std::shared_ptr<CollisionModel> make_collision_model(const In& axes, const In& anchors, const IntegersIn& slides, const In& references,
                                                     const IntegersIn& parents, const IntegersIn& joints, const In& ratio,
                                                     const In& joint_offset, const IntegersIn& kinds, const IntegersIn& frames,
                                                     const In& inflations, const In& positions, const In& rotations, const In& sizes,
                                                     const In& centers, const In& bounds, const IntegersIn& first_vertex,
                                                     const In& vertices, const IntegersIn& first_neighbor, const IntegersIn& neighbors,
                                                     const In& directions, const IntegersIn& pairs) {
    const size_t m = references.length("references");
    const size_t n = ratio.columns(m, "ratio");
    const size_t G = kinds.length("kinds");
    const size_t P = vertices.length("vertices");
    return std::make_shared<CollisionModel>(CollisionArrays{
        .axes = axes.matrix(m, 3, "axes"),
        .anchors = anchors.matrix(m, 3, "anchors"),
        .slides = slides.vector(m, "slides"),
        .references = references.vector(m, "references"),
        .parents = parents.vector(m, "parents"),
        .joints = joints.vector(m, "joints"),
        .ratio = ratio.matrix(m, n, "ratio"),
        .joint_offset = joint_offset.vector(m, "joint_offset"),
        .kinds = kinds.vector(G, "kinds"),
        .frames = frames.vector(G, "frames"),
        .inflations = inflations.vector(G, "inflations"),
        .positions = positions.matrix(G, 3, "positions"),
        .rotations = {rotations.shaped({G, 3, 3}, "rotations").data(), G, 9},
        .sizes = sizes.matrix(G, 3, "sizes"),
        .centers = centers.matrix(G, 3, "centers"),
        .bounds = bounds.vector(G, "bounds"),
        .first_vertex = first_vertex.vector(G + 1, "first_vertex"),
        .vertices = vertices.matrix(P, 3, "vertices"),
        .first_neighbor = first_neighbor.vector(P + 1, "first_neighbor"),
        .neighbors = neighbors.vector(neighbors.length("neighbors"), "neighbors"),
        .directions = directions.matrix(directions.length("directions"), 3, "directions"),
        .pairs = pairs.matrix(pairs.length("pairs"), 2, "pairs"),
    });
}

size_t checked_pair(const CollisionModel& model, size_t pair) {
    if (pair >= model.pairs.size()) { throw InputError("pair: there is no such pair"); }
    return pair;
}

// The positions of all joints at q (n,); the memory is the thread's.
Vector all_positions(const CollisionModel& model, const In& q) {
    thread_local std::vector<double> positions;
    positions.resize(model.joints());
    model.positions(q.vector(model.n(), "q"), positions);
    return positions;
}

void bind_shapes(nb::module_& module) {
    nb::enum_<ShapeKind>(module, "ShapeKind", nb::is_arithmetic(), "The shape of a geom.")
        .value("HULL", ShapeKind::hull)
        .value("BOX", ShapeKind::box)
        .value("CYLINDER", ShapeKind::cylinder)
        .value("ELLIPSOID", ShapeKind::ellipsoid)
        .value("PLANE", ShapeKind::plane);
    module.def(
        "bounding_sphere",
        [](const In& points, const Out& center) {
            const Matrix rows = points.matrix(points.length("points"), 3, "points");
            if (rows.rows == 0) { throw InputError("points: need at least one"); }
            std::vector<BoundingSphere> spheres(rows.rows);
            for (size_t i = 0; i < rows.rows; ++i) { spheres[i].center = vec3(rows.row(i)); }
            const BoundingSphere around = bounding_sphere(spheres);
            const Result numbers = center.vector(3, "center");
            numbers[0] = around.center.x;
            numbers[1] = around.center.y;
            numbers[2] = around.center.z;
            return around.radius;
        },
        "points"_a, "center"_a, "A small sphere around points (P, 3): writes its center (3,), returns its radius, m.");
}

void bind_collision_model(nb::module_& module) {
    nb::class_<CollisionModel>(module, "CollisionModel",
                               "What an arm could touch: shapes, the joints that move them, and pairs. Immutable.")
        .def(nb::new_(&make_collision_model), nb::kw_only(), "axes"_a, "anchors"_a, "slides"_a, "references"_a, "parents"_a, "joints"_a,
             "ratio"_a, "joint_offset"_a, "kinds"_a, "frames"_a, "inflations"_a, "positions"_a, "rotations"_a, "sizes"_a, "centers"_a,
             "bounds"_a, "first_vertex"_a, "vertices"_a, "first_neighbor"_a, "neighbors"_a, "directions"_a, "pairs"_a,
             "A model from arrays for each joint, geom, vertex and pair; armctl/cpp/collision_model.hpp explains them.")
        .def(
            "with_pairs",
            [](const CollisionModel& self, const IntegersIn& keep) {
                return std::const_pointer_cast<CollisionModel>(self.with_pairs(keep.vector(self.pairs.size(), "keep")));
            },
            "keep"_a, "The same model with fewer pairs, (K,) whether each stays.")
        .def_prop_ro(
            "pair_count", [](const CollisionModel& self) { return self.pairs.size(); }, "The number of pairs.")
        .def(
            "pairs",
            [](const CollisionModel& self, const IntegersOut& pairs) {
                const MatrixSpan<std::int64_t> rows = pairs.matrix(self.pairs.size(), 2, "pairs");
                for (size_t p = 0; p < self.pairs.size(); ++p) {
                    rows(p, 0) = static_cast<std::int64_t>(self.pairs[p].a);
                    rows(p, 1) = static_cast<std::int64_t>(self.pairs[p].b);
                }
            },
            "pairs"_a, "Writes the rows of the geoms of each pair, (K, 2).")
        .def(
            "joints_between", [](const CollisionModel& self, size_t pair) { return self.joints_between(checked_pair(self, pair)); },
            "pair"_a, "The joints that move one geom of a pair relative to the other: rows of the ratio.");
}

void bind_scene(nb::module_& module) {
    nb::class_<PairDistance>(module, "PairDistance", "A pair and its distance.")
        .def_ro("pair", &PairDistance::pair, "Its row, or the number of pairs where there is none.")
        .def_ro("distance", &PairDistance::distance, "m");
    nb::class_<KeptAxis>(module, "KeptAxis", "An axis that keeps its direction.");
    nb::class_<CollisionScene>(module, "CollisionScene",
                               "Distances where an arm is, with scratch memory: use an object in one thread at a time.\n\n"
                               "What a query finds starts the next ones, which can change the last bits of distances.")
        .def(nb::init<std::shared_ptr<const CollisionModel>>(), "model"_a)
        .def("forget", &CollisionScene::forget, "Forgets what earlier queries found.")
        .def(
            "first_hit",
            [](CollisionScene& self, const In& q, double clearance) {
                const Vector positions = all_positions(self.model(), q);
                nb::gil_scoped_release release;
                return self.first_hit(positions, clearance);
            },
            "q"_a, "clearance"_a,
            "A pair that is not farther apart than the clearance, m, at q (n,), or the number of pairs where there is none.")
        .def(
            "all_hits",
            [](CollisionScene& self, const In& q, double clearance, const IntegersOut& hits) {
                const Vector positions = all_positions(self.model(), q);
                const std::span<std::int64_t> marks = hits.vector(self.model().pairs.size(), "hits");
                nb::gil_scoped_release release;
                self.all_hits(positions, clearance, marks);
            },
            "q"_a, "clearance"_a, "hits"_a, "Marks every pair that is not farther apart than the clearance, (K,).")
        .def(
            "nearest_pair",
            [](CollisionScene& self, const In& q) {
                const Vector positions = all_positions(self.model(), q);
                nb::gil_scoped_release release;
                return self.nearest_pair(positions);
            },
            "q"_a, "The pair that is nearest to touching at q (n,); a distance at or below zero says that it overlaps.")
        .def(
            "overlap_depth",
            [](CollisionScene& self, const In& q, size_t pair) {
                const Vector positions = all_positions(self.model(), q);
                checked_pair(self.model(), pair);
                nb::gil_scoped_release release;
                return self.overlap_depth(positions, pair);
            },
            "q"_a, "pair"_a, "How far the geoms of a pair must move to part, m: the least over the model's directions.")
        .def(
            "find_near_pairs",
            [](CollisionScene& self, const In& q, const In& moves, double share, const In& clearances) {
                thread_local std::vector<double> delta;
                delta.resize(self.model().joints());
                self.model().bound_moves(moves.vector(self.model().n(), "moves"), delta);
                const Vector positions = all_positions(self.model(), q);
                const Vector required = clearances.vector(self.model().pairs.size(), "clearances");
                nb::gil_scoped_release release;
                self.find_near_pairs(positions, delta, share, required);
                return self.near_pairs().size();
            },
            "q"_a, "moves"_a, "share"_a, "clearances"_a,
            "Finds the pairs that moves (n,) from q (n,) can bring nearer by more than a share of what is free, which is\n"
            "their distance less their clearance (K,). Returns how many there are.")
        .def(
            "near_pairs",
            [](const CollisionScene& self, const IntegersOut& pairs, const Out& distances, const Out& gradients) {
                const size_t count = self.near_pairs().size();
                const std::span<std::int64_t> rows = pairs.vector(count, "pairs");
                const Result numbers = distances.vector(count, "distances");
                const MatrixResult derivatives = gradients.matrix(count, self.model().n(), "gradients");
                for (size_t i = 0; i < count; ++i) {
                    rows[i] = static_cast<std::int64_t>(self.near_pairs()[i].pair);
                    numbers[i] = self.near_pairs()[i].distance;
                    self.model().reduce_gradient(self.near_gradient(i), derivatives.row(i));
                }
            },
            "pairs"_a, "distances"_a, "gradients"_a,
            "Writes what `find_near_pairs` found: rows (k,), distances (k,), and their derivatives (k, n).")
        .def(
            "kept_axis",
            [](CollisionScene& self, const In& q, size_t joint, const In& direction, double within) {
                self.place_frames(all_positions(self.model(), q));
                return self.kept_axis(self.model().frame_of(joint), vec3(direction.vector(3, "direction")), within);
            },
            "q"_a, "joint"_a, "direction"_a, "within"_a,
            "The axis that a joint, a row of the ratio, moves and that has a direction of the world (3,) at q (n,). It may\n"
            "tilt by an angle, rad.");
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
        .def(
            "keep_axis",
            [](ClearanceProof& self, const KeptAxis* keep) {
                if (keep != nullptr && keep->frame >= self.scene().model().frames.size()) {
                    throw InputError("keep: the axis belongs to another model");
                }
                self.set_kept_axis(keep == nullptr ? std::nullopt : std::optional(*keep));
            },
            "keep"_a.none(), "Sets the axis that must keep its direction in the next proofs, or none.")
        .def(
            "set_motion",
            [](ClearanceProof& self, const In& knots, const In& coefficients) {
                const size_t pieces = std::max<size_t>(knots.length("knots"), 1) - 1;
                const size_t powers = coefficients.columns(pieces, "coefficients");
                const size_t n = self.scene().model().n();
                self.motion().set(self.scene().model(), knots.vector(pieces + 1, "knots"),
                                  coefficients.shaped({pieces, powers, n}, "coefficients"));
            },
            "knots"_a, "coefficients"_a,
            "Sets the motion of the next proofs: knots (K + 1,) s, and coefficients (K, degree + 1, n) by powers of the time\n"
            "since the knot, of degree 1 to 5.")
        .def(
            "hit",
            [](ClearanceProof& self, double clearance) {
                nb::gil_scoped_release release;
                return self.hit(clearance);
            },
            "clearance"_a, "Proves that the motion keeps more than a clearance, m: None, or where it is not known to be free.")
        .def(
            "closest_approach",
            [](ClearanceProof& self, double clearance) {
                nb::gil_scoped_release release;
                return self.closest_approach(clearance);
            },
            "clearance"_a, "Proves it, and how near the motion comes.")
        .def(
            "joint_range_is_free",
            [](ClearanceProof& self, size_t pair, const In& low, const In& high) {
                const CollisionModel& model = self.scene().model();
                self.motion().set_line(low.vector(model.joints(), "low"), high.vector(model.joints(), "high"));
                return !self.hit(0.0, checked_pair(model, pair));
            },
            "pair"_a, "low"_a, "high"_a,
            "Proves that a pair never touches on the straight line between two positions of all joints that move, (m,) each.");
}

}  // namespace

void bind_collision(nb::module_& module) {
    bind_shapes(module);
    bind_collision_model(module);
    bind_scene(module);
    bind_proof(module);
}

}  // namespace armctl
