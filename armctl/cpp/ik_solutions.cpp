#include "ik_solutions.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace armctl {

namespace {

constexpr Tolerances EXACT{1e-10, 1e-10};  // reaches and rad: of the solutions that are compared with each other
constexpr double SAME_SOLUTION = 1e-3;     // rad, or reaches: at a double root, EXACT leaves 1e-5
constexpr size_t NEIGHBOURS = 16;          // seeds of one sample of a sweep, of which two may lead to the same solution
constexpr double LIMIT_ROUNDING = 1e-6;    // rad, or reaches: a solution that much outside the limits is moved to the limit

// Whether two configurations are one, up to whole turns of the hinges.
bool is_same(const Chain& chain, Vector a, Vector b) {
    for (size_t i = 0; i < a.size(); ++i) {
        const double period = chain.unknowns()[i].period;
        double difference = std::abs(a[i] - b[i]);
        if (difference >= SAME_SOLUTION && period > 0) { difference = std::abs(difference - period * std::nearbyint(difference / period)); }
        if (difference >= SAME_SOLUTION) { return false; }
    }
    return true;
}

// Turns the hinges by whole turns to the positions nearest to q0 inside the bounds; returns whether q is inside then.
//
// What is outside by rounding is moved to the bounds.
bool wind_inside(const Chain& chain, Vector q0, Result q) {
    for (size_t i = 0; i < q.size(); ++i) {
        const Unknown& unknown = chain.unknowns()[i];
        const double low = unknown.bounds.low - LIMIT_ROUNDING;
        const double high = unknown.bounds.high + LIMIT_ROUNDING;
        const double period = unknown.period;
        if (period > 0) {
            if (std::abs(q0[i] - q[i]) > 0.5 * period) { q[i] += period * std::nearbyint((q0[i] - q[i]) / period); }
            if (q[i] > high) { q[i] -= period * std::ceil((q[i] - high) / period); }
            if (q[i] < low) { q[i] += period * std::ceil((low - q[i]) / period); }
        }
        if (!(low <= q[i] && q[i] <= high)) { return false; }
        q[i] = std::min(std::max(q[i], unknown.bounds.low), unknown.bounds.high);
    }
    return true;
}

// The solutions that are known, and the descents that find new ones.
class SolutionSet {
public:
    SolutionSet(IkSolver& solver, const Target& target, MatrixResult known)
        : solver_(solver), goal_(solver.model().goal(target.pose, target.constraint)),
          tolerances_{target.tolerances.position / solver.chain().reach(), target.tolerances.orientation}, known_(known) {}

    const FoundSolutions& found() const { return found_; }

    // Descends from q without bounds and adds the solution if it is new; returns whether it is.
    bool add_from(Result q) {
        ++found_.starts;
        const Descent descent = solver_.descend(&Unknown::free_bounds, goal_, EXACT, q);
        found_.steps += descent.steps;
        // Next to a singularity convergence is slow: an answer within the tolerances is a solution all the same.
        const bool solved = descent.solved || tolerances_.contain(solver_.model().linearize(goal_, q));
        if (!solved || found_.count == known_.rows || is_known(q)) { return false; }
        std::ranges::copy(q, known_.row(found_.count).begin());
        ++found_.count;
        return true;
    }

private:
    bool is_known(Vector q) const {
        for (size_t k = 0; k < found_.count; ++k) {
            if (is_same(solver_.chain(), q, known_.row(k))) { return true; }
        }
        return false;
    }

    IkSolver& solver_;
    Goal goal_;
    Tolerances tolerances_;
    MatrixResult known_;
    FoundSolutions found_;
};

// A solution that `polish` keeps; its configuration is in a row of its own.
struct Kept {
    PoseError error;
    int branch;
    double squared_distance;  // from q0
};

}  // namespace

FoundSolutions find_all(IkSolver& solver, const Target& target, Vector q0, Matrix begin, const Patience& patience, MatrixResult known) {
    const std::vector<Unknown>& unknowns = solver.chain().unknowns();
    SolutionSet solutions(solver, target, known);
    std::vector<double> trial(q0.size());
    size_t begun = 0;
    size_t turned = 0;  // solutions whose joints have been turned
    std::int64_t fruitless = 0;
    std::int64_t drawn = 0;
    while (solutions.found().count < known.rows &&
           (fruitless < patience.starts || (patience.quarters && turned < solutions.found().count))) {
        if (begun < begin.rows) {
            std::ranges::copy(begin.row(begun), trial.begin());
            ++begun;
            solutions.add_from(trial);
        } else if (fruitless < patience.starts) {
            ++drawn;
            const BoundsOf bounds_of = drawn % 2 == 1 ? &Unknown::bounds : &Unknown::one_turn;
            solver.random_start(bounds_of, q0, 2 * drawn, patience.seed, trial);
            fruitless = solutions.add_from(trial) ? 0 : fruitless + 1;
        } else {
            bool any_new = false;
            for (size_t i = 0; i < unknowns.size(); ++i) {
                for (int quarter = 1; unknowns[i].period > 0 && quarter < 4; ++quarter) {
                    std::ranges::copy(known.row(turned), trial.begin());
                    trial[i] += 0.25 * quarter * unknowns[i].period;
                    const bool is_new = solutions.add_from(trial);
                    any_new = any_new || is_new;
                }
            }
            ++turned;
            fruitless = any_new ? 0 : fruitless;
        }
    }
    return solutions.found();
}

Polished polish(IkSolver& solver, const Target& target, Vector q0, Matrix seeds, const SolutionRows& rows) {
    const Chain& chain = solver.chain();
    const size_t n = chain.n();
    const Tolerances exact{EXACT.position * chain.reach(), EXACT.orientation};
    std::vector<double> configurations(seeds.rows * n);
    const MatrixResult kept_q{configurations.data(), seeds.rows, n};
    std::vector<Kept> kept;
    std::vector<double> trial(n);
    Polished polished;
    for (size_t s = 0; s < seeds.rows; ++s) {
        std::ranges::copy(seeds.row(s), trial.begin());
        PoseError error = solver.tip_error(target, trial);
        bool moved = false;
        if (error.position > exact.position || error.orientation > exact.orientation) {
            const Goal goal = solver.model().goal(target.pose, target.constraint);
            polished.steps += solver.descend(&Unknown::free_bounds, goal, EXACT, trial).steps;
            moved = true;
        }
        if (!wind_inside(chain, q0, trial)) { continue; }
        moved = moved || !std::ranges::equal(trial, seeds.row(s));
        if (moved) { error = solver.tip_error(target, trial); }
        if (!target.tolerances.contain(error)) {
            ++polished.lost;
            continue;
        }
        bool is_known = false;
        for (size_t k = kept.size() - std::min(kept.size(), NEIGHBOURS); k < kept.size(); ++k) {
            is_known = is_known || is_same(chain, trial, kept_q.row(k));
        }
        if (is_known) { continue; }
        double squared_distance = 0.0;
        for (size_t i = 0; i < n; ++i) {
            const double away = trial[i] - q0[i];
            squared_distance += away * away;
        }
        std::ranges::copy(trial, kept_q.row(kept.size()).begin());
        kept.push_back({error, solver.kinematics().branch(), squared_distance});
    }
    polished.count = kept.size();
    std::vector<size_t> order(kept.size());
    for (size_t k = 0; k < order.size(); ++k) { order[k] = k; }
    std::ranges::stable_sort(order, {}, [&](size_t k) { return kept[k].squared_distance; });
    for (size_t k = 0; k < order.size(); ++k) {
        const Kept& solution = kept[order[k]];
        std::ranges::copy(kept_q.row(order[k]), rows.q.row(k).begin());
        rows.position_errors[k] = solution.error.position;
        rows.orientation_errors[k] = solution.error.orientation;
        rows.branches[k] = solution.branch;
    }
    return polished;
}

AllSolutions solve_all(const ClosedForm& closed_form, IkSolver& solver, const Target& target, Vector q0, const Inaccuracy& inaccuracy,
                       const Samples& samples, const SolutionRows& rows) {
    std::vector<double> memory(rows.q.rows * rows.q.columns);
    const MatrixResult seeds{memory.data(), rows.q.rows, rows.q.columns};
    const Seeds found = closed_form.find(target.pose, q0, inaccuracy.slack, inaccuracy.margin, samples, seeds);
    const Matrix filled{seeds.data, static_cast<size_t>(found.count), seeds.columns};
    const Polished polished = polish(solver, target, q0, filled, rows);
    return {
        .count = polished.count,
        .steps = polished.steps,
        .samples = found.samples,
        .complete = polished.lost == 0 && !found.doubtful,
    };
}

}  // namespace armctl
