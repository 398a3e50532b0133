// All configurations for one target, refined from seeds: those of a closed form, or solutions that a search has found.
#pragma once
#include "closed_form.hpp"
#include "ik_search.hpp"

namespace armctl {

constexpr Tolerances EXACT{1e-10, 1e-10};  // reaches and rad: of the solutions that are compared with each other
constexpr double SAME_SOLUTION = 1e-3;     // rad, or reaches: at a double root, EXACT leaves 1e-5
constexpr size_t NEIGHBOURS = 16;          // seeds of one sample of a sweep, of which two may lead to the same solution
constexpr double LIMIT_ROUNDING = 1e-6;    // rad, or reaches: a solution that much outside the limits is moved to the limit

// Whether two configurations are one, up to whole turns of the hinges.
inline bool is_same(const Chain& chain, Vector a, Vector b) {
    for (size_t i = 0; i < a.size(); ++i) {
        const double period = chain.unknowns()[i].period;
        double difference = std::abs(a[i] - b[i]);
        if (difference >= SAME_SOLUTION && period > 0) { difference = std::abs(difference - period * std::nearbyint(difference / period)); }
        if (difference >= SAME_SOLUTION) { return false; }
    }
    return true;
}

// A solution that `polish` keeps.
struct Kept {
    std::vector<double> q;
    PoseError error;
    int branch;
    double squared_distance;  // from q0
};

// Descends from q without bounds to a solution that can be compared with others, and counts the steps. Returns whether it is one.
inline bool descend_exactly(IkSolver& solver, const Target& target, Result q, std::int64_t& steps) {
    const Goal goal = solver.model().goal(target.pose, target.constraint);
    const Descent descent = solver.descend(&Unknown::free_bounds, goal, EXACT, q);
    steps += descent.steps;
    // Next to a singularity convergence is slow: an answer within the tolerances is a solution all the same.
    return descent.solved || solver.in_reaches(target.tolerances).contain(solver.model().linearize(goal, q));
}

// Where solutions are written: configurations (M, n), errors in m and rad, and branches (M,).
struct SolutionRows {
    MatrixResult q;
    Result position_errors;
    Result orientation_errors;
    std::span<std::int64_t> branches;
};

struct Solutions {
    size_t count = 0;
    std::int64_t steps = 0;
    std::int64_t lost = 0;     // seeds that led to no solution
    std::int64_t samples = 0;  // positions of the joint that is swept
    bool doubtful = false;     // whether the closed form may have missed some
};

// Refines the seeds (M, n) of a pose, and keeps those that are solutions inside the bounds, nearest to q0 first.
//
// The seeds are nearly exact, and equal ones are near each other.
inline Solutions polish(IkSolver& solver, const Target& target, Vector q0, Matrix seeds, const SolutionRows& rows) {
    const Chain& chain = solver.chain();
    const size_t n = chain.n();
    const Tolerances exact{EXACT.position * chain.reach(), EXACT.orientation};
    std::vector<Kept> kept;
    std::vector<double> trial(n);
    Solutions polished;
    for (size_t s = 0; s < seeds.rows; ++s) {
        std::ranges::copy(seeds.row(s), trial.begin());
        PoseError error = solver.tip_error(target, trial);
        bool moved = false;
        if (error.position > exact.position || error.orientation > exact.orientation) {
            descend_exactly(solver, target, trial, polished.steps);
            moved = true;
        }
        if (!chain.wind_inside(q0, LIMIT_ROUNDING, trial)) { continue; }
        chain.clamp(trial);
        moved = moved || !std::ranges::equal(trial, seeds.row(s));
        if (moved) { error = solver.tip_error(target, trial); }
        if (!target.tolerances.contain(error)) {
            ++polished.lost;
            continue;
        }
        bool is_known = false;
        for (size_t k = kept.size() - std::min(kept.size(), NEIGHBOURS); k < kept.size(); ++k) {
            is_known = is_known || is_same(chain, trial, kept[k].q);
        }
        if (is_known) { continue; }
        double squared_distance = 0.0;
        for (size_t i = 0; i < n; ++i) {
            const double away = trial[i] - q0[i];
            squared_distance += away * away;
        }
        kept.push_back({trial, error, solver.kinematics().branch(), squared_distance});
    }
    polished.count = kept.size();
    std::ranges::stable_sort(kept, {}, &Kept::squared_distance);
    for (size_t k = 0; k < kept.size(); ++k) {
        std::ranges::copy(kept[k].q, rows.q.row(k).begin());
        rows.position_errors[k] = kept[k].error.position;
        rows.orientation_errors[k] = kept[k].error.orientation;
        rows.branches[k] = kept[k].branch;
    }
    return polished;
}

}  // namespace armctl
