// Inverse kinematics: the chain of an arm, searches on it, and its closed form.
//
// Calls have their own scratch memory and run without the GIL.
#include <nanobind/nanobind.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>

#include <memory>

#include "arrays.hpp"
#include "chain.hpp"
#include "closed_form.hpp"
#include "ik_search.hpp"
#include "ik_solutions.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

// What a search for one target found, with the errors of its result in m and rad.
struct IkAnswer {
    bool solved;
    bool jumped;
    std::int64_t next_start;
    std::int64_t steps;
    double position_error;
    double orientation_error;
    int branch;
};

// From twelve numbers: the rotation row by row, and the position.
Pose pose_of(Vector numbers) { return {Rotation::from_rows(numbers.first(9)), vec3(numbers.subspan(9))}; }

std::shared_ptr<Chain> make_chain(const In& rotations, const In& translations, const IntegersIn& slides, const IntegersIn& unknowns,
                                  const In& ratios, const In& low, const In& high, const In& period, double reach) {
    const size_t k = slides.length("slides");
    const size_t n = low.length("low");
    return std::make_shared<Chain>(ChainArrays{
        .rotations = {rotations.shaped({k + 1, 3, 3}, "rotations").data(), k + 1, 9},
        .translations = translations.matrix(k + 1, 3, "translations"),
        .slides = slides.vector(k, "slides"),
        .unknowns = unknowns.vector(k, "unknowns"),
        .ratios = ratios.vector(k, "ratios"),
        .low = low.vector(n, "low"),
        .high = high.vector(n, "high"),
        .period = period.vector(n, "period"),
        .reach = reach,
    });
}

std::shared_ptr<Chain> with_special_axes(const Chain& chain, AxesRelation relation, size_t first, const IntegersIn& others,
                                         AxesRelation pair_relation, size_t pair_first, const In& distances_to_points) {
    const std::span<const std::int64_t> joints = others.vector(3, "others");
    const SpecialAxes axes{
        .relation = relation,
        .first = first,
        .others = {static_cast<size_t>(joints[0]), static_cast<size_t>(joints[1]), static_cast<size_t>(joints[2])},
        .pair_relation = pair_relation,
        .pair_first = pair_first,
    };
    return std::make_shared<Chain>(chain.with_special_axes(axes, distances_to_points.vector(chain.joints().size(), "distances_to_points")));
}

std::shared_ptr<Chain> with_held(const Chain& chain, const IntegersIn& held, const In& positions) {
    const size_t count = held.length("held");
    return std::make_shared<Chain>(chain.with_held(held.vector(count, "held"), positions.vector(count, "positions")));
}

IkAnswer search_one(const Chain& chain, const In& target, Constraint constraint, double position_tolerance, double orientation_tolerance,
                    const In& q0, std::int64_t last, std::uint64_t seed, const Out& q) {
    const Vector start = q0.vector(chain.n(), "q0");
    const Result result = q.vector(chain.n(), "q");
    const Target goal{pose_of(target.shaped({4, 3}, "target")), constraint, {position_tolerance, orientation_tolerance}};
    const nb::gil_scoped_release release;
    IkSolver solver(chain);
    const SearchOutcome outcome = solver.search(goal, start, {.first = 0, .last = last, .seed = seed}, result);
    if (!outcome.tip_is_known) { solver.kinematics().place(result); }
    const PoseError error = residual(constraint, goal.pose, solver.kinematics().metric_tip());
    return {
        .solved = outcome.solved,
        .jumped = outcome.jumped,
        .next_start = outcome.next_start,
        .steps = outcome.steps,
        .position_error = error.position,
        .orientation_error = error.orientation,
        .branch = solver.kinematics().branch(),
    };
}

void search(const Chain& chain, const In& targets, Constraint constraint, double position_tolerance, double orientation_tolerance,
            const In& q0, std::int64_t first, std::int64_t last, std::uint64_t seed, const Out& q, const IntegersOut& solved,
            const IntegersOut& next_start, const IntegersOut& steps, const IntegersOut& jumped) {
    const size_t count = targets.length("targets");
    const Matrix goals = targets.matrix(count, 12, "targets");
    const Matrix starts = q0.matrix(count, chain.n(), "q0");
    const MatrixResult results = q.matrix(count, chain.n(), "q");
    const std::span<std::int64_t> all_solved = solved.vector(count, "solved");
    const std::span<std::int64_t> all_next_start = next_start.vector(count, "next_start");
    const std::span<std::int64_t> all_steps = steps.vector(count, "steps");
    const std::span<std::int64_t> all_jumped = jumped.vector(count, "jumped");
    const nb::gil_scoped_release release;
    IkSolver solver(chain);
    for (size_t t = 0; t < count; ++t) {
        const Target target{pose_of(goals.row(t)), constraint, {position_tolerance, orientation_tolerance}};
        const SearchOutcome outcome = solver.search(target, starts.row(t), {.first = first, .last = last, .seed = seed}, results.row(t));
        all_solved[t] = outcome.solved ? 1 : 0;
        all_next_start[t] = outcome.next_start;
        all_steps[t] = outcome.steps;
        all_jumped[t] = outcome.jumped ? 1 : 0;
    }
}

void refine(const Chain& chain, const In& targets, Constraint constraint, double rotation_weight, const In& q0, double pull, const Out& q,
            const Out& squared_errors) {
    const size_t count = targets.length("targets");
    const Matrix goals = targets.matrix(count, 12, "targets");
    const Matrix starts = q0.matrix(count, chain.n(), "q0");
    const MatrixResult results = q.matrix(count, chain.n(), "q");
    const Result errors = squared_errors.vector(count, "squared_errors");
    const nb::gil_scoped_release release;
    IkSolver solver(chain);
    for (size_t t = 0; t < count; ++t) {
        errors[t] = solver.refine(pose_of(goals.row(t)), constraint, rotation_weight, starts.row(t), pull, results.row(t));
    }
}

FoundSolutions find_many(const Chain& chain, const In& target, Constraint constraint, double position_tolerance,
                         double orientation_tolerance, const In& q0, const In& begin, std::int64_t patience, bool quarters,
                         std::uint64_t seed, const Out& known) {
    const Vector start = q0.vector(chain.n(), "q0");
    const Matrix first = begin.matrix(begin.length("begin"), chain.n(), "begin");
    const size_t bound = known.length("known");
    const MatrixResult solutions = known.matrix(bound, chain.n(), "known");
    const Target goal{pose_of(target.vector(12, "target")), constraint, {position_tolerance, orientation_tolerance}};
    const nb::gil_scoped_release release;
    IkSolver solver(chain);
    return find_all(solver, goal, start, first, {.starts = patience, .quarters = quarters, .seed = seed}, solutions);
}

SolutionRows solution_rows(size_t count, size_t n, const Out& q, const Out& position_errors, const Out& orientation_errors,
                           const IntegersOut& branches) {
    return {
        .q = q.matrix(count, n, "q"),
        .position_errors = position_errors.vector(count, "position_errors"),
        .orientation_errors = orientation_errors.vector(count, "orientation_errors"),
        .branches = branches.vector(count, "branches"),
    };
}

Polished polish_seeds(const Chain& chain, const In& target, double position_tolerance, double orientation_tolerance, const In& q0,
                      const In& seeds, const Out& q, const Out& position_errors, const Out& orientation_errors,
                      const IntegersOut& branches) {
    const Vector start = q0.vector(chain.n(), "q0");
    const size_t count = seeds.length("seeds");
    const Matrix begin = seeds.matrix(count, chain.n(), "seeds");
    const SolutionRows rows = solution_rows(count, chain.n(), q, position_errors, orientation_errors, branches);
    const Target goal{pose_of(target.vector(12, "target")), Constraint::pose, {position_tolerance, orientation_tolerance}};
    const nb::gil_scoped_release release;
    IkSolver solver(chain);
    return polish(solver, goal, start, begin, rows);
}

void branches_of(const Chain& chain, const In& q, const IntegersOut& branches) {
    const size_t count = q.length("q");
    const Matrix configurations = q.matrix(count, chain.n(), "q");
    const std::span<std::int64_t> numbers = branches.vector(count, "branches");
    const nb::gil_scoped_release release;
    ChainKinematics kinematics(chain);
    for (size_t t = 0; t < count; ++t) {
        kinematics.place(configurations.row(t));
        numbers[t] = kinematics.branch();
    }
}

void manipulabilities(const Chain& chain, bool oriented, const In& q, const Out& values) {
    const size_t count = q.length("q");
    const Matrix configurations = q.matrix(count, chain.n(), "q");
    const Result results = values.vector(count, "values");
    const nb::gil_scoped_release release;
    ChainKinematics kinematics(chain);
    for (size_t t = 0; t < count; ++t) {
        kinematics.place(configurations.row(t));
        results[t] = kinematics.manipulability(oriented);
    }
}

void store(Vec3 a, Result numbers) {
    numbers[0] = a.x;
    numbers[1] = a.y;
    numbers[2] = a.z;
}

void joint_lines(const Chain& chain, const In& q, const Out& origins, const Out& axes) {
    const size_t k = chain.joints().size();
    const MatrixResult points = origins.matrix(k, 3, "origins");
    const MatrixResult directions = axes.matrix(k, 3, "axes");
    ChainKinematics kinematics(chain);
    kinematics.place(q.vector(chain.n(), "q"));
    for (size_t j = 0; j < k; ++j) {
        store(kinematics.joints()[j].origin, points.row(j));
        store(kinematics.joints()[j].axis, directions.row(j));
    }
}

// J (6, n) as `linearize` leaves it.
void store_jacobian(const ErrorModel& model, MatrixResult J) {
    const std::vector<Twist>& twists = model.kinematics().jacobian();
    for (size_t i = 0; i < twists.size(); ++i) {
        J(0, i) = twists[i].linear.x;
        J(1, i) = twists[i].linear.y;
        J(2, i) = twists[i].linear.z;
        J(3, i) = twists[i].angular.x;
        J(4, i) = twists[i].angular.y;
        J(5, i) = twists[i].angular.z;
    }
}

void error_jacobian(const Chain& chain, Constraint constraint, const In& q, const Out& J) {
    const Vector configuration = q.vector(chain.n(), "q");
    const MatrixResult result = J.matrix(6, chain.n(), "J");
    ErrorModel model(chain);
    model.kinematics().place(configuration);
    model.linearize({model.kinematics().tip(), constraint}, configuration);
    store_jacobian(model, result);
}

void bind_chain(nb::module_& module) {
    nb::enum_<AxesRelation>(module, "AxesRelation", "How the axes of some joints are related.")
        .value("NEITHER", AxesRelation::neither)
        .value("MEET", AxesRelation::meet)
        .value("PARALLEL", AxesRelation::parallel);
    nb::enum_<Constraint>(module, "Constraint", "Which parts of the tip's pose are constrained; FREE_X leaves the turn about x free.")
        .value("POSE", Constraint::pose)
        .value("POSITION", Constraint::position)
        .value("FREE_X", Constraint::free_x)
        .value("FREE_Y", Constraint::free_y)
        .value("FREE_Z", Constraint::free_z);
    nb::class_<IkAnswer>(module, "IkAnswer", "What a search for one target found.")
        .def_ro("solved", &IkAnswer::solved, "Whether q is a solution.")
        .def_ro("jumped", &IkAnswer::jumped, "Whether q is far from q0 although the tip began near the target.")
        .def_ro("next_start", &IkAnswer::next_start, "The start after the last one used.")
        .def_ro("steps", &IkAnswer::steps, "Steps over all starts.")
        .def_ro("position_error", &IkAnswer::position_error, "m, measured at q.")
        .def_ro("orientation_error", &IkAnswer::orientation_error, "rad, measured at q.")
        .def_ro("branch", &IkAnswer::branch, "The number of the branch of q.");
    nb::class_<FoundSolutions>(module, "FoundSolutions", "How many solutions were found, and the effort.")
        .def_ro("count", &FoundSolutions::count)
        .def_ro("starts", &FoundSolutions::starts)
        .def_ro("steps", &FoundSolutions::steps);
    nb::class_<Polished>(module, "Polished", "How many seeds became solutions, and the effort.")
        .def_ro("count", &Polished::count)
        .def_ro("steps", &Polished::steps)
        .def_ro("lost", &Polished::lost, "Seeds that led to no solution.");
    module.attr("NO_BRANCH") = NO_BRANCH;
    nb::class_<Chain>(module, "Chain",
                      "The chain of an arm from its base to the tip, with k joints and n unknowns. Immutable.\n\n"
                      "Lengths are in reaches; targets and tolerances of positions are in m. Results are written into the last "
                      "arguments.")
        .def(nb::new_(&make_chain), nb::kw_only(), "rotations"_a, "translations"_a, "slides"_a, "unknowns"_a, "ratios"_a, "low"_a, "high"_a,
             "period"_a, "reach"_a,
             "A chain from arrays for each of the k joints, and for each of the n unknowns; armctl/cpp/chain.hpp explains them.")
        .def_prop_ro(
            "joint_count", [](const Chain& self) { return self.joints().size(); }, "k.")
        .def("with_special_axes", &with_special_axes, nb::kw_only(), "relation"_a, "first"_a, "others"_a, "pair_relation"_a, "pair_first"_a,
             "distances_to_points"_a, "The chain with the structure of its closed form.")
        .def("with_held", &with_held, "held"_a, "positions"_a, "The chain with some unknowns held at positions.")
        .def(
            "contains", [](const Chain& self, const In& q) { return q.is_vector(self.n()) && self.contains(q.vector(self.n(), "q")); },
            "q"_a, "Whether q is a contiguous array of n float64 inside the bounds.")
        .def("search_one", &search_one, "target"_a, "constraint"_a, "position_tolerance"_a, "orientation_tolerance"_a, "q0"_a, "last"_a,
             "seed"_a, "q"_a,
             "Searches from q, then from random starts, for a target (4, 3). Fills q (n,) with the best "
             "configuration met.")
        .def("search", &search, "targets"_a, "constraint"_a, "position_tolerance"_a, "orientation_tolerance"_a, "q0"_a, "first"_a, "last"_a,
             "seed"_a, "q"_a, "solved"_a, "next_start"_a, "steps"_a, "jumped"_a,
             "Searches for each of the targets (N, 12). Fills q (N, n) and, (N,) each, what IkAnswer has.")
        .def("refine", &refine, "targets"_a, "constraint"_a, "rotation_weight"_a, "q0"_a, "pull"_a, "q"_a, "squared_errors"_a,
             "Moves each q (N, n) to a minimum of the squared error plus `pull` times its squared distance from q0.")
        .def("find_all", &find_many, "target"_a, "constraint"_a, "position_tolerance"_a, "orientation_tolerance"_a, "q0"_a, "begin"_a,
             "patience"_a, "quarters"_a, "seed"_a, "known"_a,
             "Fills `known` (M, n) with distinct solutions for a target (12,), without regard to the bounds of hinges.")
        .def("polish", &polish_seeds, "target"_a, "position_tolerance"_a, "orientation_tolerance"_a, "q0"_a, "seeds"_a, "q"_a,
             "position_errors"_a, "orientation_errors"_a, "branches"_a,
             "Refines the seeds (M, n) of a pose (12,) and keeps those that are solutions inside the bounds, nearest first.")
        .def("branches", &branches_of, "q"_a, "branches"_a, "Fills branches (N,) with the numbers of those of q (N, n).")
        .def("manipulabilities", &manipulabilities, "oriented"_a, "q"_a, "values"_a,
             "Fills values (N,) with the manipulability at each q (N, n), lengths in m.")
        .def("joint_lines", &joint_lines, "q"_a, "origins"_a, "axes"_a, "Fills origins and axes (k, 3) of the joints at q (n,).")
        .def("error_jacobian", &error_jacobian, "constraint"_a, "q"_a, "J"_a,
             "Fills J (6, n), the Jacobian of the weighted error at q (n,): a third of a reach counts like a rad.");
}

void bind_error_model(nb::module_& module) {
    nb::class_<ErrorModel>(module, "IkErrorModel",
                           "Half the squared error around a configuration, with scratch memory: use an object in one thread at "
                           "a time.")
        .def(nb::init<const Chain&>(), "chain"_a, nb::keep_alive<1, 2>())
        .def(
            "linearize",
            [](ErrorModel& self, const In& target, Constraint constraint, double position_priority, const In& q, const Out& hessian,
               const Out& gradient, const Out& J) {
                const size_t n = self.chain().n();
                const MatrixResult H = hessian.matrix(n, n, "hessian");
                const Result descent = gradient.vector(n, "gradient");
                const MatrixResult jacobian = J.matrix(6, n, "J");
                const Goal goal = self.goal(pose_of(target.vector(12, "target")), constraint);
                self.linearize(goal, q.vector(n, "q"), ROTATION_WEIGHT, position_priority);
                self.add_curvature(constraint);
                for (size_t i = 0; i < n; ++i) {
                    descent[i] = self.gradient(i);
                    for (size_t k = 0; k < n; ++k) { H(i, k) = self.hessian(i, k); }
                }
                store_jacobian(self, jacobian);
                return self.size();
            },
            "target"_a, "constraint"_a, "position_priority"_a, "q"_a, "hessian"_a, "gradient"_a, "J"_a,
            "Fills the Hessian (n, n) with the curvature of the chain, J^T e (n,) and J (6, n). Returns the norm of the error.")
        .def(
            "null_step",
            [](ErrorModel& self, Constraint constraint, const In& desired, const In& low, const In& high, const Out& step) {
                const size_t n = self.chain().n();
                self.null_step(constraint, desired.vector(n, "desired"), low.vector(n, "low"), high.vector(n, "high"),
                               step.vector(n, "step"));
            },
            "constraint"_a, "desired"_a, "low"_a, "high"_a, "step"_a,
            "The part of a desired step (n,) in the null space of the J of `linearize`, shortened to its bounds.");
}

std::shared_ptr<ClosedForm> make_closed_form(const In& axes, const In& points, const In& low, const In& high, const In& tip_rotation,
                                             const In& tip_translation, double reach, AxesRelation relation, size_t first,
                                             AxesRelation pair_relation, size_t pair_first, std::optional<size_t> held) {
    const size_t n = low.length("low");
    const Matrix directions = axes.matrix(n, 3, "axes");
    const Matrix feet = points.matrix(n, 3, "points");
    const Vector lowest = low.vector(n, "low");
    const Vector highest = high.vector(n, "high");
    HingeChain chain{
        .hinges = {},
        .tip = {Rotation::from_rows(tip_rotation.shaped({3, 3}, "tip_rotation")), vec3(tip_translation.vector(3, "tip_translation"))},
        .reach = reach,
        .structure = {.relation = relation, .first = first, .pair_relation = pair_relation, .pair_first = pair_first},
        .held = held,
    };
    for (size_t k = 0; k < n; ++k) {
        const Line line{vec3(directions.row(k)), vec3(feet.row(k))};
        chain.hinges.push_back({.line = line, .bounds = {lowest[k], highest[k]}});
    }
    return std::make_shared<ClosedForm>(std::move(chain));
}

AllSolutions solve_with_closed_form(const ClosedForm& closed_form, const Chain& chain, const In& target, const In& q0,
                                    double position_tolerance, double orientation_tolerance, double slack, double margin,
                                    std::int64_t least_samples, std::int64_t most_samples, std::int64_t wanted, const Out& q,
                                    const Out& position_errors, const Out& orientation_errors, const IntegersOut& branches) {
    const size_t n = closed_form.n();
    if (chain.n() != n || chain.has_followers()) { throw InputError("chain: expected the chain of the closed form"); }
    const Vector start = q0.vector(n, "q0");
    const SolutionRows rows = solution_rows(q.length("q"), n, q, position_errors, orientation_errors, branches);
    const Target goal{pose_of(target.shaped({4, 3}, "target")), Constraint::pose, {position_tolerance, orientation_tolerance}};
    const Samples samples{.least = least_samples, .most = most_samples, .wanted = wanted};
    const nb::gil_scoped_release release;
    IkSolver solver(chain);
    return solve_all(closed_form, solver, goal, start, {.slack = slack, .margin = margin}, samples, rows);
}

void find_first(const ClosedForm& closed_form, const In& targets, double slack, double margin, std::int64_t most_samples, const Out& q,
                const IntegersOut& found) {
    const size_t n = closed_form.n();
    const size_t count = targets.length("targets");
    const Matrix goals = targets.matrix(count, 12, "targets");
    const MatrixResult results = q.matrix(count, n, "q");
    const std::span<std::int64_t> are_found = found.vector(count, "found");
    const nb::gil_scoped_release release;
    std::vector<double> memory(MAX_CONFIGURATIONS * n);
    const MatrixResult seeds{memory.data(), MAX_CONFIGURATIONS, n};
    const Samples samples{.least = 1, .most = most_samples, .wanted = 1};
    for (size_t t = 0; t < count; ++t) {
        const Seeds solved = closed_form.find(pose_of(goals.row(t)), results.row(t), slack, margin, samples, seeds);
        are_found[t] = solved.count > 0 ? 1 : 0;
        if (solved.count > 0) { std::ranges::copy(seeds.row(0), results.row(t).begin()); }
    }
}

void bind_closed_form(nb::module_& module) {
    nb::class_<AllSolutions>(module, "AllSolutions", "How many solutions a closed form has, and the effort.")
        .def_ro("count", &AllSolutions::count)
        .def_ro("steps", &AllSolutions::steps)
        .def_ro("samples", &AllSolutions::samples, "Positions of the joint that is swept; 1 for six joints.")
        .def_ro("complete", &AllSolutions::complete, "Whether no solution can be missing.");
    nb::class_<ClosedForm>(module, "ClosedForm",
                           "The closed form of six hinges of which three in a row meet in a point or are parallel. Immutable.")
        .def(nb::new_(&make_closed_form), nb::kw_only(), "axes"_a, "points"_a, "low"_a, "high"_a, "tip_rotation"_a, "tip_translation"_a,
             "reach"_a, "relation"_a, "first"_a, "pair_relation"_a, "pair_first"_a, "held"_a = nb::none(),
             "From the hinges in the zero configuration, lengths in reaches; armctl/cpp/closed_form.hpp explains the arguments.")
        .def("solve_all", &solve_with_closed_form, "chain"_a, "target"_a, "q0"_a, "position_tolerance"_a, "orientation_tolerance"_a,
             "slack"_a, "margin"_a, "least_samples"_a, "most_samples"_a, "wanted"_a, "q"_a, "position_errors"_a, "orientation_errors"_a,
             "branches"_a,
             "Fills q (M, n), errors and branches (M,) with the solutions for a target (4, 3), refined, the nearest to q0 "
             "first.")
        .def("find_first", &find_first, "targets"_a, "slack"_a, "margin"_a, "most_samples"_a, "q"_a, "found"_a,
             "Fills q (N, n), which holds where to begin, with a configuration for each of the targets (N, 12) that has any.");
}

void bind_residuals(nb::module_& module) {
    nb::class_<PoseError>(module, "PoseError", "The errors of a tip.")
        .def_ro("position", &PoseError::position, "m.")
        .def_ro("orientation", &PoseError::orientation, "rad.");
    module.def(
        "residual",
        [](Constraint constraint, const In& target, const In& position, const In& rotation) {
            const Pose tip{Rotation::from_rows(rotation.shaped({3, 3}, "rotation")), vec3(position.vector(3, "position"))};
            return residual(constraint, pose_of(target.vector(12, "target")), tip);
        },
        "constraint"_a, "target"_a, "position"_a, "rotation"_a, "The errors of a tip for a target (12,).");
    module.def(
        "residuals",
        [](Constraint constraint, const In& targets, const In& positions, const In& rotations, const Out& position_errors,
           const Out& orientation_errors) {
            const size_t count = targets.length("targets");
            const Matrix goals = targets.matrix(count, 12, "targets");
            const Matrix points = positions.matrix(count, 3, "positions");
            const Matrix frames{rotations.shaped({count, 3, 3}, "rotations").data(), count, 9};
            const Result lengths = position_errors.vector(count, "position_errors");
            const Result angles = orientation_errors.vector(count, "orientation_errors");
            const nb::gil_scoped_release release;
            for (size_t t = 0; t < count; ++t) {
                const Pose tip{Rotation::from_rows(frames.row(t)), vec3(points.row(t))};
                const PoseError error = residual(constraint, pose_of(goals.row(t)), tip);
                lengths[t] = error.position;
                angles[t] = error.orientation;
            }
        },
        "constraint"_a, "targets"_a, "positions"_a, "rotations"_a, "position_errors"_a, "orientation_errors"_a,
        "The errors of tips (N, 3) and (N, 3, 3) for targets (N, 12), (N,) each.");
}

}  // namespace

void bind_ik(nb::module_& module) {
    bind_chain(module);
    bind_error_model(module);
    bind_closed_form(module);
    bind_residuals(module);
}

}  // namespace armctl
