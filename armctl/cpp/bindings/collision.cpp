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

std::vector<size_t> indices(Integers numbers) { return {numbers.begin(), numbers.end()}; }

// Of each of the m joints that move: `axes` and `anchors` (m, 3), `slides`, `references`, `parents`, and `joints`, its row of `ratio`.
template <class Given>
std::vector<MovingFrame> moving_frames(Given& given, size_t m) {
    const Matrix axes = given.matrix(m, 3, "axes");
    const Matrix anchors = given.matrix(m, 3, "anchors");
    const Integers slides = given.integers(m, "slides");
    const Vector references = given.vector(m, "references");
    const Integers parents = given.integers(m, "parents");
    const Integers joints = given.integers(m, "joints");
    std::vector<MovingFrame> frames;
    frames.reserve(m);
    for (size_t i = 0; i < m; ++i) {
        frames.push_back({
            .axis = vec3(axes.row(i)),
            .anchor = vec3(anchors.row(i)),
            .slides = slides[i] != 0,
            .reference = references[i],
            .parent = static_cast<size_t>(parents[i]),
            .joint = static_cast<size_t>(joints[i]),
        });
    }
    return frames;
}

// The vertices of geom g are those from `first_vertex` (G + 1,) on to that of the next one.
template <class Given>
std::vector<Geom> geoms_of(Given& given) {
    const Integers kinds = given.integers("kinds");
    const size_t G = kinds.size();
    const Integers frames = given.integers(G, "frames");
    const Vector inflations = given.vector(G, "inflations");
    const Matrix positions = given.matrix(G, 3, "positions");
    const Vector rotations = given.shaped({G, 3, 3}, "rotations");
    const Matrix sizes = given.matrix(G, 3, "sizes");
    const Matrix centers = given.matrix(G, 3, "centers");
    const Vector radii = given.vector(G, "radii");
    const Integers starts = given.integers(G + 1, "first_vertex");
    std::vector<Geom> geoms;
    geoms.reserve(G);
    for (size_t g = 0; g < G; ++g) {
        geoms.push_back({
            .kind = static_cast<ShapeKind>(checked_index(kinds[g], 5, "kinds")),
            .frame = static_cast<size_t>(frames[g]),
            .inflation = inflations[g],
            .position = vec3(positions.row(g)),
            .axes = Rotation::from_rows(rotations.subspan(9 * g, 9)),
            .size = vec3(sizes.row(g)),
            .center = vec3(centers.row(g)),
            .radius = radii[g],
            .first_vertex = static_cast<size_t>(starts[g]),
            .last_vertex = static_cast<size_t>(starts[g + 1]),
        });
    }
    return geoms;
}

// A point of each row (k, 3).
template <class Given>
std::vector<Vec3> points(Given& given, const char* name) {
    const Matrix rows = given.matrix(given.length(name), 3, name);
    std::vector<Vec3> points;
    points.reserve(rows.rows);
    for (size_t i = 0; i < rows.rows; ++i) { points.push_back(vec3(rows.row(i))); }
    return points;
}

template <class Given>
std::vector<CollisionPair> pairs_of(Given& given) {
    const Integers first_geoms = given.integers("first_geoms");
    const Integers second_geoms = given.integers(first_geoms.size(), "second_geoms");
    const Vector margins = given.vector(first_geoms.size(), "margins");
    std::vector<CollisionPair> pairs;
    pairs.reserve(margins.size());
    for (size_t p = 0; p < margins.size(); ++p) {
        pairs.push_back({.a = static_cast<size_t>(first_geoms[p]), .b = static_cast<size_t>(second_geoms[p]), .margin = margins[p]});
    }
    return pairs;
}

// Besides: `vertices` (P, 3), and of large hulls the `neighbors` that share an edge with each, from `first_neighbor` (P + 1,) on.
template <class Given>
CollisionDescription collision_description(Given& given) {
    const size_t m = given.length("references");
    const size_t n = given.count("n");
    CollisionDescription model{
        .ratio = {m, n},
        .joint_offset = given.numbers("joint_offset"),
        .joints = moving_frames(given, m),
        .vertices = {points(given, "vertices"), indices(given.integers("first_neighbor")), indices(given.integers("neighbors"))},
        .geoms = geoms_of(given),
        .pairs = pairs_of(given),
        .directions = points(given, "directions"),
    };
    model.ratio.set(given.matrix(m, n, "ratio"));
    return model;
}

// Geoms with their vertices, and pairs, as of a model; `kept_pairs` (K,) of the pairs of the model.
template <class Given>
CollisionAdditions collision_additions(Given& given) {
    CollisionAdditions added{
        .vertices = {points(given, "vertices"), indices(given.integers("first_neighbor")), indices(given.integers("neighbors"))},
        .geoms = geoms_of(given),
        .pairs = pairs_of(given),
    };
    for (const std::int64_t is_kept : given.integers("kept_pairs")) { added.kept_pairs.push_back(is_kept != 0); }
    return added;
}

CollisionModel with_additions(const CollisionModel& model, CollisionAdditions added,
                              const std::vector<std::shared_ptr<const PointCloud>>& clouds, const In& cloud_poses) {
    const Matrix poses = cloud_poses.matrix(clouds.size(), 12, "cloud_poses");
    for (size_t c = 0; c < clouds.size(); ++c) {
        const Pose pose = pose_of(poses.row(c));
        const AlignedBox& bounds = clouds[c]->tree().bounds();
        added.geoms.push_back({
            .kind = ShapeKind::points,
            .position = pose.translation,
            .axes = pose.rotation,
            .center = pose * bounds.center(),
            .radius = bounds.radius() + clouds[c]->radius(),
            .cloud = clouds[c],
        });
    }
    return model.with(added);
}

std::shared_ptr<const PointCloud> make_cloud(const In& points, double radius) {
    const Matrix rows = points.matrix(points.length("points"), 3, "points");
    nb::gil_scoped_release release;
    return std::make_shared<const PointCloud>(rows, radius);
}

// The positions of all joints at q (n,); the memory is the thread's.
Vector all_positions(CollisionScene& scene, const In& q) {
    thread_local std::vector<double> positions;
    positions.resize(scene.model().joints());
    scene.find_positions(q.vector(scene.model().n(), "q"), positions);
    return positions;
}

void find_all_hits(CollisionScene& scene, const In& q, double clearance, const IntegersOut& hits) {
    scene.all_hits(all_positions(scene, q), clearance, hits.vector(scene.model().pairs.size(), "hits"));
}

void mark_points(CollisionScene& scene, const In& q, const IntegersIn& geoms, const In& points, double margin, const IntegersOut& marks) {
    const Matrix rows = points.matrix(points.length("points"), 3, "points");
    std::vector<size_t> numbers;
    for (const std::int64_t geom : geoms.vector(geoms.length("geoms"), "geoms")) {
        numbers.push_back(checked_index(geom, scene.model().geoms.size(), "geoms"));
    }
    scene.mark_points(all_positions(scene, q), numbers, rows, margin, marks.vector(rows.rows, "marks"));
}

std::vector<NearPair> find_near_pairs(CollisionScene& scene, const In& q, const In& moves, double share, const In& clearances) {
    if (scene.loops()) {
        Numbers delta(scene.model().joints());
        scene.loops()->bound(q.vector(scene.model().n(), "q"), moves.vector(scene.model().n(), "moves"), delta);
        return scene.near_pairs(all_positions(scene, q), delta, share, clearances.vector(scene.model().pairs.size(), "clearances"));
    }
    const Vector delta = moves.vector(scene.model().joints(), "moves");
    return scene.near_pairs(all_positions(scene, q), delta, share, clearances.vector(scene.model().pairs.size(), "clearances"));
}

void bind_scene(nb::module_& module) {
    nb::enum_<ShapeKind>(module, "ShapeKind", nb::is_arithmetic(), "The shape of a geom.")
        .value("HULL", ShapeKind::hull)
        .value("BOX", ShapeKind::box)
        .value("CYLINDER", ShapeKind::cylinder)
        .value("ELLIPSOID", ShapeKind::ellipsoid)
        .value("PLANE", ShapeKind::plane)
        .value("POINTS", ShapeKind::points);
    nb::class_<PointCloud>(module, "PointCloud", "Points that stand, as balls, and a tree over them. Immutable.")
        .def(nb::new_(&make_cloud), "points"_a, "radius"_a, "From points (N, 3) m in the frame of the cloud, and the radius of each, m.")
        .def_prop_ro(
            "size", [](const PointCloud& self) { return self.points().size(); }, "How many points.")
        .def(
            "distance", [](const PointCloud& self, const In& place) { return self.distance(vec3(place.vector(3, "place"))); }, "place"_a,
            "m, of a place (3,) in the frame of the cloud from the nearest point.");
    nb::class_<CollisionModel> bound(module, "CollisionModel",
                                     "What an arm could touch: shapes, the joints that move them, and pairs. Immutable.");
    const auto make = [](CollisionModel* self, CollisionDescription description) { new (self) CollisionModel(std::move(description)); };
    bind_constructor<>(
        bound, "__init__(self", [](auto& given) { return collision_description(given); }, make,
        "A model from arrays for each joint, geom, vertex and pair; armctl/cpp/collision_model.hpp explains them.");
    bound.def("with_additions", &with_additions, "added"_a, "clouds"_a, "cloud_poses"_a,
              "The same with further geoms, behind these its clouds at poses (C, 12): the rotation row by row, and the position.");
    bound.def(
        "with_margins",
        [](const CollisionModel& self, const In& margins) { return self.with_margins(margins.vector(self.pairs.size(), "margins")); },
        "margins"_a, "The same with other margins of the pairs, (K,) m.");
    nb::class_<CollisionAdditions> additions(module, "CollisionAdditions", "Geoms and pairs that are added to a model.");
    bind_constructor<>(
        additions, "__init__(self", [](auto& given) { return collision_additions(given); },
        [](CollisionAdditions* self, CollisionAdditions added) { new (self) CollisionAdditions(std::move(added)); },
        "Arrays as of a model, and `kept_pairs` (K,) that says which of its pairs stay; armctl/cpp/collision_model.hpp explains them.");
    bound.def("with_loops", &CollisionModel::with_loops, "loops"_a, "The same of an arm with closed loops.");
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
        .def("mark_points", &mark_points, "q"_a, "geoms"_a, "points"_a, "margin"_a, "marks"_a, Release(),
             "Marks the points (N, 3) m of the world that are not farther than a margin, m, from some geoms (G,) at q (n,).")
        .def("near_pairs", &find_near_pairs, "q"_a, "moves"_a, "share"_a, "clearances"_a, Release(),
             "The pairs that moves (m,) of all joints, or with closed loops (n,), from q (n,) can bring nearer by more than a share of "
             "what is free, which is\n"
             "their distance less their clearance (K,).");
}

void keep_region(ClearanceProof& proof, const In& q, size_t frame, const In& tip, const In& region) {
    const Region kept = Region::from_numbers(region.vector(REGION_NUMBERS, "region"));
    proof.keep(all_positions(proof.scene(), q), frame, pose_of(tip.vector(12, "tip")), kept);
}

void set_motion(ClearanceProof& proof, const In& knots, const In& coefficients) {
    const size_t pieces = std::max<size_t>(knots.length("knots"), 1) - 1;
    const size_t powers = coefficients.length("coefficients", 1);
    const size_t joints = proof.moving();
    proof.motion().set(knots.vector(pieces + 1, "knots"), coefficients.shaped({pieces, powers, joints}, "coefficients"), joints);
}

std::optional<Hit> find_hit(ClearanceProof& proof, double clearance, std::optional<size_t> pair) {
    if (pair) { checked_index(static_cast<std::int64_t>(*pair), proof.scene().no_pair(), "pair"); }
    return proof.hit(clearance, pair);
}

void bind_proof(nb::module_& module) {
    module.attr("MAX_DEGREE") = PolynomialMotion::MAX_DEGREE;
    nb::class_<Hit>(module, "Hit", "A pair that is not known to be free.")
        .def_ro("pair", &Hit::pair, "Its row; the number of pairs says that the tip leaves its region, the next that loops do not close.")
        .def_ro("time", &Hit::time, "s");
    nb::class_<Approach>(module, "Approach", "How near a motion comes.")
        .def_ro("bound", &Approach::bound, "m, proved; negative if the clearance could not be proved.")
        .def_ro("distance", &Approach::distance, "m, that occurs: at most 0.2 mm above the bound, or where the proof failed.")
        .def_ro("nearest", &Approach::nearest, "Its pair and time.");
    nb::class_<ClearanceProof>(module, "ClearanceProof",
                               "Proofs for whole motions with scratch memory: use an object in one thread at a time.")
        .def(nb::init<std::shared_ptr<CollisionScene>>(), "scene"_a)
        .def("keep_region", &keep_region, "q"_a, "frame"_a, "tip"_a, "region"_a,
             "In the next proofs, the tip, which moves with a frame and has a pose (12,) at q (n,), stays in a region (38,).")
        .def("release_region", &ClearanceProof::release, "Lets the tip go anywhere.")
        .def("set_motion", &set_motion, "knots"_a, "coefficients"_a,
             "Sets the motion of the next proofs: knots (K + 1,) s, and coefficients (K, degree + 1, m) of all joints, or with closed\n"
             "loops of the n driven ones, by powers of the time since the knot, of degree 1 to 5.")
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
