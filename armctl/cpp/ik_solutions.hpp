// All configurations for one target: found by descents from many starts, or refined from those of a closed form.
#pragma once
#include <cstdint>

#include "closed_form.hpp"
#include "ik_search.hpp"
#include "spans.hpp"

namespace armctl {

// How long to look for further solutions.
struct Patience {
    std::int64_t starts;  // random starts in a row that find nothing new
    bool quarters;        // also descend from every solution with one joint turned by quarters
    std::uint64_t seed;
};

struct FoundSolutions {
    size_t count = 0;
    std::int64_t starts = 0;
    std::int64_t steps = 0;
};

// Fills `known` (M, n) with distinct solutions, without regard to the bounds of hinges; their whole turns are arbitrary.
//
// Descends from each row of `begin` (B, n); then from random configurations, in turns inside the bounds and within one turn;
// and with `quarters` from every solution with one joint turned by quarters. It ends when `known` is full.
FoundSolutions find_all(IkSolver& solver, const Target& target, Vector q0, Matrix begin, const Patience& patience, MatrixResult known);

// Where `polish` writes the solutions: configurations (M, n), errors in m and rad, and branches (M,).
struct SolutionRows {
    MatrixResult q;
    Result position_errors;
    Result orientation_errors;
    std::span<std::int64_t> branches;
};

struct Polished {
    size_t count = 0;
    std::int64_t steps = 0;
    std::int64_t lost = 0;  // seeds that led to no solution
};

// Refines the seeds (M, n) of a pose, and keeps those that are solutions inside the bounds, nearest to q0 first.
//
// The seeds are nearly exact, and equal ones are near each other.
Polished polish(IkSolver& solver, const Target& target, Vector q0, Matrix seeds, const SolutionRows& rows);

// What a closed form may miss by rounding, or because it is not exact.
struct Inaccuracy {
    double slack;   // in cosines
    double margin;  // rad: seeds so far outside the bounds are refined, too
};

struct AllSolutions {
    size_t count = 0;
    std::int64_t steps = 0;
    std::int64_t samples = 0;
    bool complete = false;  // whether no solution can be missing
};

// The solutions of a closed form, refined, the nearest to q0 first.
AllSolutions solve_all(const ClosedForm& closed_form, IkSolver& solver, const Target& target, Vector q0, const Inaccuracy& inaccuracy,
                       const Samples& samples, const SolutionRows& rows);

}  // namespace armctl
