// Inverse kinematics of a tree with several tips.
#include "tree_ik.hpp"

#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/vector.h>

#include "arguments.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

struct TreeDescription {
    double reach;
    Numbers unit;
    FixedMass fixed;
    JointLimits limits;
    std::vector<TreeTask> tasks;
    std::vector<HalfPlane> polygon;
};

// Of each of the n unknowns `unit`, `q_min`, `q_max`, `v_max` and `a_max`; of each task the joints that carry its frame and the one
// in which its target is given (-1 for the world), their placements (T, 12), `constraints`, `points` and `exact`; of each half plane
// of the `polygon` (P, 3) its normal and bound; `fixed` (4,) is the mass that no joint moves, and its center.
template <class Given>
TreeDescription tree_description(Given& given) {
    const size_t count = given.length("joints");
    const size_t n = given.length("unit");
    const Integers joints = given.integers(count, "joints");
    const Integers references = given.integers(count, "reference_joints");
    const Integers constraints = given.integers(count, "constraints");
    const Integers points = given.integers(count, "points");
    const Integers exact = given.integers(count, "exact");
    const Matrix placements = given.matrix(count, 12, "placements");
    const Matrix reference_placements = given.matrix(count, 12, "reference_placements");
    const Vector fixed = given.vector(4, "fixed");
    const Vector unit = given.vector(n, "unit");
    const auto limit = [&](const char* name) {
        const Vector all = given.vector(n, name);
        return Numbers(all.begin(), all.end());
    };
    TreeDescription tree{
        .reach = given.number("reach"),
        .unit = {unit.begin(), unit.end()},
        .fixed = {.mass = fixed[0], .center = vec3(fixed.subspan(1))},
        .limits = {.q_min = limit("q_min"), .q_max = limit("q_max"), .v_max = limit("v_max"), .a_max = limit("a_max")},
        .tasks = {},
        .polygon = {},
    };
    for (size_t t = 0; t < count; ++t) {
        tree.tasks.push_back({
            .frame = {.joint = static_cast<int>(joints[t]), .placement = pose_of(placements.row(t))},
            .reference = {.joint = static_cast<int>(references[t]), .placement = pose_of(reference_placements.row(t))},
            .constraint = static_cast<Constraint>(checked_index(constraints[t], 5, "constraints")),
            .points = points[t] != 0,
            .exact = exact[t] != 0,
        });
    }
    const size_t edges = given.length("polygon");
    const Matrix polygon = given.matrix(edges, 3, "polygon");
    for (size_t k = 0; k < edges; ++k) { tree.polygon.push_back({.x = polygon(k, 0), .y = polygon(k, 1), .bound = polygon(k, 2)}); }
    return tree;
}

// The joints of a description belong to a model.
void require_joints(const ArmModel& model, const TreeDescription& tree) {
    if (tree.unit.size() != model.n()) { throw InputError("unit: need a number for each of the model's n"); }
    for (const TreeTask& task : tree.tasks) {
        checked_index(task.frame.joint + 1, model.joints.size() + 1, "joints");
        checked_index(task.reference.joint + 1, model.joints.size() + 1, "reference_joints");
    }
}

void set_targets(TreeIk& tree, const In& targets) {
    const Matrix rows = targets.matrix(tree.tasks().size(), 12, "targets");
    for (size_t t = 0; t < rows.rows; ++t) { tree.set_target(t, pose_of(rows.row(t))); }
}

StepEnd step(TreeIk& tree, const In& targets, const In& q, const In& v_before, double dt, const In& posture, double posture_gain,
             double posture_weight, const Out& v) {
    set_targets(tree, targets);
    const size_t n = tree.n();
    const Posture rest{.q = posture.vector(n, "posture"), .gain = posture_gain, .weight = posture_weight};
    return tree.step(q.vector(n, "q"), v_before.vector(n, "v_before"), dt, rest, v.vector(n, "v"));
}

TreeSearch search(TreeIk& tree, const In& targets, double position_tolerance, double orientation_tolerance, std::int64_t first,
                  std::int64_t last, std::uint64_t seed, const Out& q) {
    set_targets(tree, targets);
    return tree.search({position_tolerance, orientation_tolerance}, {.first = first, .last = last, .seed = seed}, q.vector(tree.n(), "q"));
}

double errors(TreeIk& tree, const In& targets, const In& q, const Out& errors) {
    set_targets(tree, targets);
    const MatrixResult rows = errors.matrix(tree.tasks().size(), 2, "errors");
    tree.locate(q.vector(tree.n(), "q"));
    for (size_t t = 0; t < rows.rows; ++t) {
        const PoseError error = tree.error(t);
        rows(t, 0) = error.position;
        rows(t, 1) = error.orientation;
    }
    return tree.outside_polygon();
}

void frames(TreeIk& tree, const In& q, const Out& frames) {
    const MatrixResult rows = frames.matrix(tree.tasks().size(), 12, "frames");
    tree.locate(q.vector(tree.n(), "q"));
    for (size_t t = 0; t < rows.rows; ++t) {
        const Pose pose = tree.frame(t);
        pose.rotation.to_rows(rows.row(t));
        pose.translation.store(rows.row(t).subspan(9));
    }
}

}  // namespace

// Steps take microseconds: all calls keep the GIL, which also keeps two threads from one object's scratch memory.
void bind_tree_ik(nb::module_& module) {
    nb::enum_<StepEnd>(module, "StepEnd", nb::is_arithmetic(), "How a step ended.")
        .value("SOLVED", StepEnd::solved)
        .value("HELD_BACK", StepEnd::held_back);
    nb::class_<TreeSearch>(module, "TreeSearch", "What a search found.")
        .def_ro("solved", &TreeSearch::solved, "Whether q is a solution.")
        .def_ro("starts", &TreeSearch::starts, "How many starts were used.")
        .def_ro("steps", &TreeSearch::steps, "Steps over all starts.");
    nb::class_<TreeIk> bound(module, "TreeIk",
                             "Inverse kinematics of a tree with T tasks, with scratch memory: use an object in one thread at a time.\n\n"
                             "Targets (T, 12) are rotations row by row and positions, m. Results are written into the last arguments.");
    const auto make = [](TreeIk* self, const Model& model, TreeDescription tree) {
        require_joints(*model, tree);
        new (self) TreeIk(model, tree.reach, tree.unit, tree.fixed, std::move(tree.limits), std::move(tree.tasks), std::move(tree.polygon));
    };
    bind_constructor<Model>(
        bound, "__init__(self, model: ArmModel", [](auto& given) { return tree_description(given); }, make, "model"_a, "given"_a,
        "A tree from arrays for its n unknowns, its tasks and a polygon; armctl/cpp/bindings/tree_ik.cpp explains them.");
    bound
        .def("step", &step, "targets"_a, "q"_a, "v_before"_a, "dt"_a, "posture"_a, "posture_gain"_a, "posture_weight"_a, "v"_a,
             "Fills v (n,) with the speeds that bring the frames nearer to the targets in dt, after v_before (n,).")
        .def("search", &search, "targets"_a, "position_tolerance"_a, "orientation_tolerance"_a, "first"_a, "last"_a, "seed"_a, "q"_a,
             "Searches from q (n,), then from random starts, and fills q with a solution, or with the best approximation.")
        .def("errors", &errors, "targets"_a, "q"_a, "errors"_a,
             "Fills errors (T, 2), m and rad, at q (n,). Returns by how much the center of mass is outside the polygon, m.")
        .def("frames", &frames, "q"_a, "frames"_a, "Fills frames (T, 12) with the poses of the tasks' frames at q (n,).");
}

}  // namespace armctl
