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

}  // namespace armctl
