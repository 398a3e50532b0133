// All configurations for one target, refined from seeds: those of a closed form, or solutions that a search has found.
#pragma once

#include "closed_form.hpp"
#include "ik_search.hpp"

namespace armctl {

// Descends from q without bounds to a solution that can be compared with others, and counts the steps. Returns whether it is one.
bool descend_exactly(IkSolver& solver, const Target& target, Result q, std::int64_t& steps);

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
Solutions polish(IkSolver& solver, const Target& target, Vector q0, Matrix seeds, const SolutionRows& rows);

// What a closed form may miss by rounding, or because it is not exact.
struct Inaccuracy {
    double slack;   // in cosines
    double margin;  // rad: seeds so far outside the bounds are refined, too
};

// The solutions of a closed form, refined, the nearest to q0 first.
Solutions solve_all(const ClosedForm& closed_form, IkSolver& solver, const Target& target, Vector q0, const Inaccuracy& inaccuracy,
                    const Sweep& sweep, const SolutionRows& rows);

}  // namespace armctl
