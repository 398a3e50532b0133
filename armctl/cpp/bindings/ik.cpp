// Inverse kinematics: the chain of an arm, searches on it, and its closed form.
//
// Calls have their own scratch memory and run without the GIL.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>

#include "arguments.hpp"
#include "ik_solutions.hpp"
#include "region_search.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

using Release = nb::call_guard<nb::gil_scoped_release>;

template <class Given>
AxesRelation relation_of(Given& given, const char* name) {
    return static_cast<AxesRelation>(checked_index(given.integer(name), 2, name));
}

// Of each of the k joints and the tip `rotations` (k + 1, 3, 3) and `translations` (k + 1, 3) in the frame before; of each joint
// `slides`, `unknowns` and `ratios`; of each of the n unknowns `low`, `high` and `period`. The rest is SpecialAxes.
template <class Given>
ChainDescription chain_description(Given& given) {
    const size_t k = given.length("slides");
    const size_t n = given.length("low");
    ChainDescription chain{.reach = given.number("reach"), .joints = {}, .unknowns = {}, .tip = {}};
    const Vector low = given.vector(n, "low");
    const Vector high = given.vector(n, "high");
    const Vector period = given.vector(n, "period");
    for (size_t i = 0; i < n; ++i) { chain.unknowns.push_back(make_unknown({low[i], high[i]}, period[i])); }
    const Integers slides = given.integers(k, "slides");
    const Integers unknowns = given.integers(k, "unknowns");
    const Vector ratios = given.vector(k, "ratios");
    const Matrix rotations{given.shaped({k + 1, 3, 3}, "rotations").data(), k + 1, 9};
    const Matrix translations = given.matrix(k + 1, 3, "translations");
    const auto placement = [&](size_t j) { return Pose{Rotation::from_rows(rotations.row(j)), vec3(translations.row(j))}; };
    for (size_t j = 0; j < k; ++j) { chain.joints.push_back({placement(j), slides[j] != 0, static_cast<size_t>(unknowns[j]), ratios[j]}); }
    chain.tip = placement(k);
    if (!given.has("relation", "first", "others", "pair_relation", "pair_first", "distances_to_points")) { return chain; }
    const Integers others = given.integers(3, "others");
    chain.special_axes = SpecialAxes{
        .relation = relation_of(given, "relation"),
        .first = given.count("first"),
        .others = {static_cast<size_t>(others[0]), static_cast<size_t>(others[1]), static_cast<size_t>(others[2])},
        .pair_relation = relation_of(given, "pair_relation"),
        .pair_first = given.count("pair_first"),
    };
    const Vector distances = given.vector(k, "distances_to_points");
    for (size_t j = 0; j < k; ++j) { chain.joints[j].distance_to_point = distances[j]; }
    return chain;
}

// What a search for one target found, with the errors of its result in m and rad.
struct IkAnswer : SearchOutcome {
    double position_error;
    double orientation_error;
    int branch;
};

Target target_of(const In& numbers, Constraint constraint, double position_tolerance, double orientation_tolerance) {
    return {pose_of(numbers.vector(12, "target")), constraint, {position_tolerance, orientation_tolerance}};
}

bool contains(const Chain& chain, const In& q) { return q.is_vector(chain.n()) && chain.contains(q.vector(chain.n(), "q")); }

IkAnswer search_one(const Chain& chain, const In& target, Constraint constraint, double position_tolerance, double orientation_tolerance,
                    const In& q0, std::int64_t last, std::uint64_t seed, const Out& q) {
    const Target goal{pose_of(target.shaped({4, 3}, "target")), constraint, {position_tolerance, orientation_tolerance}};
    const Result result = q.vector(chain.n(), "q");
    IkSolver solver(chain);
    const SearchOutcome outcome = solver.search(goal, q0.vector(chain.n(), "q0"), {.first = 0, .last = last, .seed = seed}, result);
    const PoseError error = solver.tip_error(goal, result);
    return {outcome, error.position, error.orientation, solver.kinematics().branch()};
}

void search(const Chain& chain, const In& targets, Constraint constraint, double position_tolerance, double orientation_tolerance,
            const In& q0, std::int64_t first, std::int64_t last, std::uint64_t seed, const Out& q, const IntegersOut& outcomes) {
    const size_t count = targets.length("targets");
    const Matrix goals = targets.matrix(count, 12, "targets");
    const Matrix starts = q0.matrix(count, chain.n(), "q0");
    const MatrixResult results = q.matrix(count, chain.n(), "q");
    const std::span<std::int64_t> rows = outcomes.shaped({count, 4}, "outcomes");
    IkSolver solver(chain);
    for (size_t t = 0; t < count; ++t) {
        const Target target{pose_of(goals.row(t)), constraint, {position_tolerance, orientation_tolerance}};
        const SearchOutcome outcome = solver.search(target, starts.row(t), {first, last, seed}, results.row(t));
        const std::int64_t row[] = {outcome.solved, outcome.jumped, outcome.next_start, outcome.steps};
        std::ranges::copy(row, rows.subspan(4 * t).begin());
    }
}

void refine(const Chain& chain, const In& targets, Constraint constraint, double rotation_weight, const In& q0, double pull, const Out& q,
            const Out& squared_errors) {
    const size_t count = targets.length("targets");
    const Matrix goals = targets.matrix(count, 12, "targets");
    const Matrix starts = q0.matrix(count, chain.n(), "q0");
    const MatrixResult results = q.matrix(count, chain.n(), "q");
    const Result errors = squared_errors.vector(count, "squared_errors");
    IkSolver solver(chain);
    for (size_t t = 0; t < count; ++t) {
        errors[t] = solver.refine(pose_of(goals.row(t)), constraint, rotation_weight, starts.row(t), pull, results.row(t));
    }
}

// Applies a search to configurations q (K, n), each for the region of its number, and fills solved and steps (K,).
template <class Search>
void for_each_region(const Chain& chain, const In& regions, const IntegersIn& numbers, Tolerances tolerances, const Out& q,
                     const IntegersOut& solved, const IntegersOut& steps, Search search) {
    const Matrix sets = regions.matrix(regions.length("regions"), REGION_NUMBERS, "regions");
    const MatrixResult rows = q.matrix(q.length("q"), chain.n(), "q");
    const auto region = numbers.vector(rows.rows, "numbers");
    const auto all_solved = solved.vector(rows.rows, "solved");
    const auto all_steps = steps.vector(rows.rows, "steps");
    IkSolver solver(chain);
    const Tolerances in_reaches = solver.in_reaches(tolerances);
    for (size_t k = 0; k < rows.rows; ++k) {
        const size_t r = checked_index(region[k], sets.rows, "numbers");
        const Descent descent = search(solver, Region::from_numbers(sets.row(r)).scaled(1.0 / chain.reach()), in_reaches, rows.row(k));
        all_solved[k] = descent.solved ? 1 : 0;
        all_steps[k] = descent.steps;
    }
}

void search_regions(const Chain& chain, const In& regions, const IntegersIn& numbers, double position_tolerance,
                    double orientation_tolerance, const In& q0, const Out& q, const IntegersOut& solved, const IntegersOut& steps) {
    const Vector near = q0.vector(chain.n(), "q0");
    for_each_region(chain, regions, numbers, {position_tolerance, orientation_tolerance}, q, solved, steps,
                    [&](IkSolver& solver, const Region& region, const Tolerances& tolerances, Result row) {
                        return descend_into(solver, region, tolerances, near, row);
                    });
}

void slide_in_regions(const Chain& chain, const In& regions, const IntegersIn& numbers, double position_tolerance,
                      double orientation_tolerance, const In& q0, const Out& q, const IntegersOut& solved, const IntegersOut& steps) {
    const Vector near = q0.vector(chain.n(), "q0");
    for_each_region(chain, regions, numbers, {position_tolerance, orientation_tolerance}, q, solved, steps,
                    [&](IkSolver& solver, const Region& region, const Tolerances& tolerances, Result row) {
                        return slide_within(solver, region, tolerances, near, row);
                    });
}

void relax_in_regions(const Chain& chain, const In& regions, const In& spacing, double position_tolerance, double orientation_tolerance,
                      bool is_start_held, std::int64_t sweeps, const Out& q) {
    const Matrix sets = regions.matrix(regions.length("regions"), REGION_NUMBERS, "regions");
    RegionPath path{.regions = {}, .spacing = spacing.vector(std::max<size_t>(sets.rows, 1) - 1, "spacing")};
    for (size_t k = 0; k < sets.rows; ++k) { path.regions.push_back(Region::from_numbers(sets.row(k)).scaled(1.0 / chain.reach())); }
    const MatrixResult rows = q.matrix(sets.rows, chain.n(), "q");
    IkSolver solver(chain);
    const Tolerances tolerances = solver.in_reaches({position_tolerance, orientation_tolerance});
    std::vector<double> trial(chain.n());
    for (std::int64_t sweep = 0; sweep < sweeps && sets.rows > 1; ++sweep) {
        relax_once(solver, path, tolerances, is_start_held, sweep % 2 == 0, rows, trial);
    }
}

void nearest_members(const In& region, const In& tips, const Out& members) {
    const Region given = Region::from_numbers(region.vector(REGION_NUMBERS, "region"));
    const Matrix poses = tips.matrix(tips.length("tips"), 12, "tips");
    const MatrixResult nearest = members.matrix(poses.rows, 12, "members");
    for (size_t k = 0; k < poses.rows; ++k) {
        const Pose member = nearest_member(given, pose_of(poses.row(k)));
        member.rotation.to_rows(nearest.row(k));
        member.translation.store(nearest.row(k).subspan(9));
    }
}

void region_coordinates(const In& region, const In& tips, const Out& coordinates) {
    const Region given = Region::from_numbers(region.vector(REGION_NUMBERS, "region"));
    const Matrix poses = tips.matrix(tips.length("tips"), 12, "tips");
    const MatrixResult rows = coordinates.matrix(poses.rows, 6, "coordinates");
    for (size_t k = 0; k < poses.rows; ++k) { std::ranges::copy(coordinates_in(given, pose_of(poses.row(k))), rows.row(k).begin()); }
}

void random_starts(const Chain& chain, const In& q0, std::int64_t first, std::uint64_t seed, const Out& q) {
    const Vector middle = q0.vector(chain.n(), "q0");
    const MatrixResult rows = q.matrix(q.length("q"), chain.n(), "q");
    const IkSolver solver(chain);
    for (size_t k = 0; k < rows.rows; ++k) {
        const std::int64_t number = first + static_cast<std::int64_t>(k);
        solver.random_start(number % 2 == 1 ? &Unknown::bounds : &Unknown::one_turn, middle, 2 * number, seed, rows.row(k));
    }
}

void descend(const Chain& chain, const In& target, Constraint constraint, double position_tolerance, double orientation_tolerance,
             const Out& q, const IntegersOut& solved, const IntegersOut& steps) {
    const MatrixResult rows = q.matrix(q.length("q"), chain.n(), "q");
    const auto all_solved = solved.vector(rows.rows, "solved");
    const auto all_steps = steps.vector(rows.rows, "steps");
    const Target goal = target_of(target, constraint, position_tolerance, orientation_tolerance);
    IkSolver solver(chain);
    for (size_t k = 0; k < rows.rows; ++k) {
        all_steps[k] = 0;
        all_solved[k] = descend_exactly(solver, goal, rows.row(k), all_steps[k]) ? 1 : 0;
    }
}

void branches_of(const Chain& chain, const In& q, const IntegersOut& branches) {
    const Matrix configurations = q.matrix(q.length("q"), chain.n(), "q");
    const auto numbers = branches.vector(configurations.rows, "branches");
    ChainKinematics kinematics(chain);
    for (size_t t = 0; t < numbers.size(); ++t) {
        kinematics.place(configurations.row(t));
        numbers[t] = kinematics.branch();
    }
}

void bind_chain(nb::module_& module) {
    nb::enum_<AxesRelation>(module, "AxesRelation", nb::is_arithmetic(), "How the axes of some joints are related.")
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
    nb::class_<Solutions>(module, "Solutions", "How many seeds became solutions, and the effort.")
        .def_ro("count", &Solutions::count)
        .def_ro("steps", &Solutions::steps)
        .def_ro("lost", &Solutions::lost, "Seeds that led to no solution.")
        .def_ro("samples", &Solutions::samples, "Positions of the joint that is swept; 1 for six joints.")
        .def_ro("doubtful", &Solutions::doubtful, "Whether the closed form may have missed some.");
    module.attr("LIMIT_ROUNDING") = LIMIT_ROUNDING;
    module.attr("NO_BRANCH") = NO_BRANCH;
    module.attr("ROTATION_WEIGHT") = ROTATION_WEIGHT;
    module.attr("SAME_SOLUTION") = SAME_SOLUTION;
    nb::class_<Chain> chain(module, "Chain",
                            "The chain of an arm from its base to the tip, with k joints and n unknowns. Immutable.\n\n"
                            "Lengths are in reaches; targets and tolerances of positions are in m. Results are written into the last "
                            "arguments.");
    const auto make = [](Chain* self, ChainDescription description) { new (self) Chain(std::move(description)); };
    bind_constructor<>(
        chain, "__init__(self", [](auto& given) { return chain_description(given); }, make,
        "A chain from arrays for each of the k joints, and for each of the n unknowns; armctl/cpp/chain.hpp explains them.");
    chain.def("contains", &contains, "q"_a, "Whether q is a contiguous array of n float64 inside the bounds.")
        .def("search_one", &search_one, "target"_a, "constraint"_a, "position_tolerance"_a, "orientation_tolerance"_a, "q0"_a, "last"_a,
             "seed"_a, "q"_a, Release(),
             "Searches from q, then from random starts, for a target (4, 3). Fills q (n,) with the best configuration met.")
        .def("search", &search, "targets"_a, "constraint"_a, "position_tolerance"_a, "orientation_tolerance"_a, "q0"_a, "first"_a, "last"_a,
             "seed"_a, "q"_a, "outcomes"_a, Release(),
             "Searches for each of the targets (N, 12). Fills q (N, n) and outcomes (N, 4): the first four fields of IkAnswer.")
        .def("refine", &refine, "targets"_a, "constraint"_a, "rotation_weight"_a, "q0"_a, "pull"_a, "q"_a, "squared_errors"_a, Release(),
             "Moves each q (N, n) to a minimum of the squared error plus `pull` times its squared distance from q0.")
        .def(
            "search_regions", &search_regions, "regions"_a, "numbers"_a, "position_tolerance"_a, "orientation_tolerance"_a, "q0"_a, "q"_a,
            "solved"_a, "steps"_a, Release(),
            "Descends from each q (K, n) into the region (R, 38) of its number (K,), and winds it to q0 (n,). Fills solved and steps (K,).")
        .def("slide_in_regions", &slide_in_regions, "regions"_a, "numbers"_a, "position_tolerance"_a, "orientation_tolerance"_a, "q0"_a,
             "q"_a, "solved"_a, "steps"_a, Release(), "As search_regions, but slides each q towards q0 within its region first.")
        .def("relax_in_regions", &relax_in_regions, "regions"_a, "spacing"_a, "position_tolerance"_a, "orientation_tolerance"_a,
             "is_start_held"_a, "sweeps"_a, "q"_a, Release(),
             "Shortens the path q (N, n), each row of which stays in its region (N, 38); spacing (N - 1,) is between them.")
        .def("random_starts", &random_starts, "q0"_a, "first"_a, "seed"_a, "q"_a, Release(),
             "Fills q (B, n) with random configurations of numbers from `first` on: odd ones inside the bounds, others in one turn.")
        .def("descend", &descend, "target"_a, "constraint"_a, "position_tolerance"_a, "orientation_tolerance"_a, "q"_a, "solved"_a,
             "steps"_a, Release(), "Descends from each q (B, n) to a solution for a target (12,), without regard to the bounds of hinges.")
        .def("branches", &branches_of, "q"_a, "branches"_a, Release(), "Fills branches (N,) with the numbers of those of q (N, n).");
}

double linearize(ErrorModel& model, const In& target, Constraint constraint, double position_priority, const In& q, const Out& hessian,
                 const Out& gradient, const Out& J) {
    const size_t n = model.chain().n();
    const MatrixResult H = hessian.matrix(n, n, "hessian");
    const Result descent = gradient.vector(n, "gradient");
    const MatrixResult jacobian = J.matrix(6, n, "J");
    model.linearize(model.goal(pose_of(target.vector(12, "target")), constraint), q.vector(n, "q"), ROTATION_WEIGHT, position_priority);
    model.add_curvature(constraint);
    for (size_t i = 0; i < n; ++i) {
        descent[i] = model.gradient(i);
        for (size_t k = 0; k < n; ++k) { H(i, k) = model.hessian(i, k); }
        const std::array<double, 6> column = numbers(model.kinematics().jacobian()[i]);
        for (size_t row = 0; row < 6; ++row) { jacobian(row, i) = column[row]; }
    }
    return model.size();
}

Solutions solve_with_closed_form(const ClosedForm& closed_form, const In& target, const In& q0, double position_tolerance,
                                 double orientation_tolerance, double slack, double margin, const In& positions, std::int64_t least,
                                 std::int64_t wanted, const Out& q, const Out& position_errors, const Out& orientation_errors,
                                 const IntegersOut& branches) {
    const size_t n = closed_form.chain().n();
    const size_t room = q.length("q");
    const SolutionRows rows{
        .q = q.matrix(room, n, "q"),
        .position_errors = position_errors.vector(room, "position_errors"),
        .orientation_errors = orientation_errors.vector(room, "orientation_errors"),
        .branches = branches.vector(room, "branches"),
    };
    const Target goal{pose_of(target.shaped({4, 3}, "target")), Constraint::pose, {position_tolerance, orientation_tolerance}};
    const Sweep sweep{positions.vector(positions.length("positions"), "positions"), least, wanted};
    Mat seeds(room, n);
    const Vector start = q0.vector(n, "q0");
    const Seeds found = closed_form.find(goal.pose, start, slack, margin, sweep, seeds);
    IkSolver solver(closed_form.chain());
    Solutions solutions = polish(solver, goal, start, {seeds.numbers().data(), static_cast<size_t>(found.count), n}, rows);
    solutions.samples = found.samples;
    solutions.doubtful = found.doubtful;
    return solutions;
}

void find_first(const ClosedForm& closed_form, const In& targets, const In& q0, double slack, double margin, const In& positions,
                const Out& q, const IntegersOut& found) {
    const size_t n = closed_form.chain().n();
    const size_t count = targets.length("targets");
    const Matrix goals = targets.matrix(count, 12, "targets");
    const MatrixResult results = q.matrix(count, n, "q");
    const auto are_found = found.vector(count, "found");
    const Sweep sweep{.positions = positions.vector(positions.length("positions"), "positions"), .least = 1, .wanted = 1};
    Mat seeds(MAX_CONFIGURATIONS, n);
    for (size_t t = 0; t < count; ++t) {
        const Seeds solved = closed_form.find(pose_of(goals.row(t)), q0.vector(n, "q0"), slack, margin, sweep, seeds);
        are_found[t] = solved.count > 0 ? 1 : 0;
        if (solved.count > 0) { std::ranges::copy(seeds.row(0), results.row(t).begin()); }
    }
}

void find_residuals(Constraint constraint, const In& targets, const In& positions, const In& rotations, const Out& position_errors,
                    const Out& orientation_errors) {
    const size_t count = targets.length("targets");
    const Matrix goals = targets.matrix(count, 12, "targets");
    const Matrix points = positions.matrix(count, 3, "positions");
    const Matrix frames{rotations.shaped({count, 3, 3}, "rotations").data(), count, 9};
    const Result lengths = position_errors.vector(count, "position_errors");
    const Result angles = orientation_errors.vector(count, "orientation_errors");
    for (size_t t = 0; t < count; ++t) {
        const PoseError error = residual(constraint, pose_of(goals.row(t)), {Rotation::from_rows(frames.row(t)), vec3(points.row(t))});
        lengths[t] = error.position;
        angles[t] = error.orientation;
    }
}

}  // namespace

void bind_ik(nb::module_& module) {
    bind_chain(module);
    nb::class_<ErrorModel>(module, "IkErrorModel",
                           "Half the squared error around a configuration, with scratch memory: use an object in one thread at a time.")
        .def(nb::init<const Chain&>(), "chain"_a, nb::keep_alive<1, 2>())
        .def("linearize", &linearize, "target"_a, "constraint"_a, "position_priority"_a, "q"_a, "hessian"_a, "gradient"_a, "J"_a,
             "Fills the Hessian (n, n) with the curvature of the chain, J^T e (n,) and J (6, n), where a third of a reach\n"
             "counts like a rad. Returns the norm of the error.");
    nb::class_<ClosedForm>(module, "ClosedForm", "The closed form of six hinges; armctl/cpp/closed_form.hpp explains it. Immutable.")
        .def(nb::init<std::shared_ptr<const Chain>, std::optional<size_t>>(), "chain"_a, "held"_a.none(),
             "Of a chain with special axes; of seven hinges, one is held.")
        .def("solve_all", &solve_with_closed_form, "target"_a, "q0"_a, "position_tolerance"_a, "orientation_tolerance"_a, "slack"_a,
             "margin"_a, "positions"_a, "least"_a, "wanted"_a, "q"_a, "position_errors"_a, "orientation_errors"_a, "branches"_a, Release(),
             "Fills q (M, n), errors and branches (M,) with the solutions for a target (4, 3), refined, the nearest to q0 first.")
        .def("find_first", &find_first, "targets"_a, "q0"_a, "slack"_a, "margin"_a, "positions"_a, "q"_a, "found"_a, Release(),
             "Fills q (N, n) with a configuration for each of the targets (N, 12) that has any.");
    module.attr("REGION_NUMBERS") = REGION_NUMBERS;
    module.def(
        "region_coordinates", &region_coordinates, "region"_a, "tips"_a, "coordinates"_a, Release(),
        "Fills coordinates (K, 6) with x, y, z, roll, pitch and yaw of tips (K, 12) in a region (38,), or with x, y, z and the tilt.");
    module.def("nearest_members", &nearest_members, "region"_a, "tips"_a, "members"_a, Release(),
               "Fills members (K, 12) with the poses of a region (38,) that are nearest to the tips (K, 12).");
    module.def("residuals", &find_residuals, "constraint"_a, "targets"_a, "positions"_a, "rotations"_a, "position_errors"_a,
               "orientation_errors"_a, Release(), "The errors of tips (N, 3) and (N, 3, 3) for targets (N, 12), (N,) each.");
}

}  // namespace armctl
