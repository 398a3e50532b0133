// Inverse kinematics into regions: from a start to the nearest member, then along the region to the nearest configuration.
#pragma once
#include "ik_search.hpp"

namespace armctl {

// Squared reaches per squared radian, in turn: a strong pull slides far along the region, a weak one leaves the tip nearly in it.
constexpr std::array<double, 2> SLIDE_PULLS{1e-2, 1e-4};
// Of a slide: it comes next to the nearest configuration, from where the last descent decides. More steps gain less than 1e-3 rad.
constexpr Refinement SLIDE{.max_steps = 20, .min_move = 1e-4};

// Descends from q into a region in reaches, and turns hinges by whole turns to where they are nearest to q0.
inline Descent descend_into(IkSolver& solver, const Region& region, const Tolerances& tolerances, Vector q0, Result q) {
    const Descent descent = solver.descend(&Unknown::bounds, region, tolerances, q);
    solver.chain().wind_inside(q0, 0.0, q);
    return descent;
}

// Slides q, whose tip is in a region in reaches, within it towards q0.
inline Descent slide_within(IkSolver& solver, const Region& region, const Tolerances& tolerances, Vector q0, Result q) {
    for (const double pull : SLIDE_PULLS) { solver.refine(region, ROTATION_WEIGHT, q0, pull, q, SLIDE); }
    return descend_into(solver, region, tolerances, q0, q);
}

// Regions that a tip passes in turn, in reaches, and the distances between them, which are positive.
struct RegionPath {
    std::vector<Region> regions;  // N
    Vector spacing;               // (N - 1,)
};

// Factor on the way of a configuration to the mean of its neighbours: successive over-relaxation (D. M. Young, "Iterative Solution of
// Large Linear Systems", 1971) needs fewer sweeps than Gauss and Seidel's method, which has a factor of 1.
constexpr double OVER_RELAXATION = 1.5;

// Shortens a path of configurations q (N, n), each of which stays in its region: one sweep over all of them, forwards or backwards.
//
// It decreases the sum of |q_k+1 - q_k|^2 / spacing_k: each configuration goes to the mean of its neighbours, and back into its region.
// Those that do not get there stay. Both ends are free unless the first one is held.
inline void relax_once(IkSolver& solver, const RegionPath& path, const Tolerances& tolerances, bool is_start_held, bool forwards,
                       MatrixResult q, Result trial) {
    const size_t count = path.regions.size();
    for (size_t step = 0; step < count; ++step) {
        const size_t k = forwards ? step : count - 1 - step;
        if (k == 0 && is_start_held) { continue; }
        const double before = k > 0 ? 1.0 / path.spacing[k - 1] : 0.0;
        const double after = k + 1 < count ? 1.0 / path.spacing[k] : 0.0;
        for (size_t i = 0; i < trial.size(); ++i) {
            double mean = 0.0;
            if (k > 0) { mean += before * q.row(k - 1)[i]; }
            if (k + 1 < count) { mean += after * q.row(k + 1)[i]; }
            mean /= before + after;
            trial[i] = solver.chain().unknowns()[i].bounds.clamp(q.row(k)[i] + OVER_RELAXATION * (mean - q.row(k)[i]));
        }
        if (solver.descend(&Unknown::bounds, path.regions[k], tolerances, trial).solved) { std::ranges::copy(trial, q.row(k).begin()); }
    }
}

}  // namespace armctl
