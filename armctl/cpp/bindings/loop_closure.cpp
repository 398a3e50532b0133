// Closed loops: positions, speeds and accelerations of joints that no motor drives.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>

#include "../loop_motion.hpp"
#include "arguments.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

int index_of(std::int64_t joint, size_t m) {
    return static_cast<int>(std::clamp<std::int64_t>(joint, -2, static_cast<std::int64_t>(m)));  // one that fits into an int
}

// Of each of the m joints: `rotations` (m, 3, 3) and `translations` (m, 3) in the parent's frame at position zero, `slides`,
// `parents` (-1 for the base), `offsets`, `reference`; `ratio` (m, n) and `reference_q` (n,); the numbers of `passive` joints, and their
// limits `low` and `high`. Of each loop: `first_joints` and `second_joints` (-1 for the base), `first_placements` and `second_placements`
// (L, 12), and `holds_axes`. Of each pair of tied joints: `followers`, `leaders` and `terms` (T, 5). `length`, m, is that of a typical
// link.
template <class Given>
ClosureDescription closure_description(Given& given) {
    const size_t m = given.length("reference");
    const size_t n = given.length("reference_q");
    const Vector rotations = given.shaped({m, 3, 3}, "rotations");
    const Matrix translations = given.matrix(m, 3, "translations");
    const Integers slides = given.integers(m, "slides");
    const Integers parents = given.integers(m, "parents");
    ClosureDescription closure{
        .ratio = {m, n},
        .offsets = given.numbers("offsets"),
        .low = given.numbers("low"),
        .high = given.numbers("high"),
        .reference_q = given.numbers("reference_q"),
        .reference = given.numbers("reference"),
        .length = given.number("length"),
    };
    closure.ratio.set(given.matrix(m, n, "ratio"));
    for (size_t j = 0; j < m; ++j) {
        const Pose placement{Rotation::from_rows(rotations.subspan(9 * j, 9)), vec3(translations.row(j))};
        closure.joints.push_back({.placement = placement, .slides = slides[j] != 0, .parent = index_of(parents[j], m)});
    }
    for (const std::int64_t joint : given.integers("passive")) { closure.passive.push_back(static_cast<size_t>(joint)); }
    const Integers first_joints = given.integers("first_joints");
    const size_t loops = first_joints.size();
    const Integers second_joints = given.integers(loops, "second_joints");
    const Matrix first_placements = given.matrix(loops, 12, "first_placements");
    const Matrix second_placements = given.matrix(loops, 12, "second_placements");
    const Integers holds_axes = given.integers(loops, "holds_axes");
    for (size_t k = 0; k < loops; ++k) {
        closure.loops.push_back({
            .first = {.joint = index_of(first_joints[k], m), .placement = pose_of(first_placements.row(k))},
            .second = {.joint = index_of(second_joints[k], m), .placement = pose_of(second_placements.row(k))},
            .holds_axes = holds_axes[k] != 0,
        });
    }
    const Integers followers = given.integers("followers");
    const Integers leaders = given.integers(followers.size(), "leaders");
    const Matrix terms = given.matrix(followers.size(), 5, "terms");
    for (size_t k = 0; k < followers.size(); ++k) {
        TiedJoints tie{.follower = static_cast<size_t>(followers[k]), .leader = static_cast<size_t>(leaders[k])};
        copy(terms.row(k), tie.terms);
        closure.ties.push_back(tie);
    }
    return closure;
}

// Fills rows for T configurations; returns how many of them, from the first on, have closed loops.
size_t close_all(const Closure& closure, const In& q, const Out& positions, const Out& ratios) {
    const size_t count = q.length("q");
    const Matrix all_q = q.matrix(count, closure->n(), "q");
    const MatrixResult all_positions = positions.matrix(count, closure->m(), "positions");
    const MatrixResult all_ratios = ratios.matrix(count, closure->m() * closure->n(), "ratios");
    const nb::gil_scoped_release release;
    ClosedLoops loops(closure);
    for (size_t k = 0; k < count; ++k) {
        if (!loops.close(all_q.row(k))) { return k; }
        copy(loops.positions(), all_positions.row(k));
        copy(loops.ratio().numbers(), all_ratios.row(k));
    }
    return count;
}

void accelerate_all(const Closure& closure, const In& q, const In& v, const Out& accelerations) {
    const size_t count = q.length("q");
    const Matrix all_q = q.matrix(count, closure->n(), "q");
    const Matrix all_v = v.matrix(count, closure->n(), "v");
    const MatrixResult all = accelerations.matrix(count, closure->m(), "accelerations");
    const nb::gil_scoped_release release;
    ClosedLoops loops(closure);
    for (size_t k = 0; k < count; ++k) {
        loops.close(all_q.row(k));
        copy(loops.acceleration(all_v.row(k)), all.row(k));
    }
}

}  // namespace

void bind_loop_closure(nb::module_& module) {
    module.attr("PASSIVE_LIMIT_TOLERANCE") = PASSIVE_LIMIT_TOLERANCE;
    nb::class_<LoopClosure> bound(module, "LoopClosure", "Closed loops of an arm: where its passive joints are. Immutable.");
    const auto make = [](LoopClosure* self, ClosureDescription description) { new (self) LoopClosure(std::move(description)); };
    bind_constructor<>(
        bound, "__init__(self", [](auto& given) { return closure_description(given); }, make,
        "Loops from arrays for each joint, loop and pair of tied joints; armctl/cpp/loop_closure.hpp explains them.");
    module.def(
        "first_break",
        [](const Closure& closure, const In& knots, const In& coefficients) {
            const size_t pieces = std::max<size_t>(knots.length("knots"), 1) - 1;
            const size_t powers = coefficients.length("coefficients", 1);
            const size_t n = closure->n();
            PolynomialMotion motion;
            motion.set(knots.vector(pieces + 1, "knots"), coefficients.shaped({pieces, powers, n}, "coefficients"), n);
            const nb::gil_scoped_release release;
            return first_break(closure, motion);
        },
        "closure"_a, "knots"_a, "coefficients"_a,
        "The first time, s, at which loops are not proved to stay closed with passive joints inside their limits, in a motion of the n\n"
        "driven joints with coefficients (K, degree + 1, n) by powers of the time since the knots (K + 1,) s; None if they are.");
    module.def("close_loops", close_all, "closure"_a, "q"_a, "positions"_a, "ratios"_a,
               "Fills the positions (T, m) of all joints, and their speeds per speed of the driven ones (T, m n), at q (T, n). Returns at "
               "which row the loops do not close; T if they do everywhere.");
    module.def("loop_accelerations", accelerate_all, "closure"_a, "q"_a, "v"_a, "accelerations"_a,
               "Fills the accelerations (T, m) of all joints at speeds v (T, n) of the driven ones whose own accelerations are zero.");
}

}  // namespace armctl
