// Newton's method on a cost with logarithmic barriers: Boyd and Vandenberghe, "Convex Optimization", 2004, chapter 11.
#pragma once

#include <algorithm>
#include <cstddef>
#include <limits>
#include <span>
#include <vector>

#include "band_matrix.hpp"

namespace armctl {

struct BarrierSchedule {
    double first;     // weight of the barrier at the start
    double factor;    // from one weight to the next
    double centered;  // share of the barrier: a Newton step that promises a smaller decrease ends the centering
};

// Minimizes from a feasible x, which is changed in place. A problem has the functions
//     double cost(x, barrier)                                      infinite outside the bounds
//     void add_derivatives(x, barrier, gradient, hessian)          to zeros
//     bool is_last(x, barrier)                                     whether a smaller barrier is not worth its time
//     size_t band_width()                                     of the Hessian
template <class Problem>
void minimize_with_barriers(const Problem& problem, Result x, const BarrierSchedule& schedule) {
    constexpr int max_newton_steps = 30;
    constexpr int max_halvings = 30;
    constexpr double sufficient_decrease = 1e-4;  // of the promised one: Armijo's rule

    const size_t count = x.size();
    std::vector<double> gradient(count);
    std::vector<double> step(count);
    std::vector<double> trial(count);
    BandMatrix hessian(count, problem.band_width());
    double barrier = schedule.first;
    while (true) {
        double cost = problem.cost(x, barrier);
        for (int newton_step = 0; newton_step < max_newton_steps; ++newton_step) {
            std::fill(gradient.begin(), gradient.end(), 0.0);
            hessian.set_zero();
            problem.add_derivatives(x, barrier, gradient, hessian);
            for (size_t k = 0; k < count; ++k) { step[k] = -gradient[k]; }
            hessian.factorize_and_solve(step);
            double promise = 0.0;
            for (size_t k = 0; k < count; ++k) { promise -= gradient[k] * step[k]; }
            if (!(promise > schedule.centered * barrier)) { break; }
            double share = 1.0;
            double trial_cost = std::numeric_limits<double>::infinity();
            for (int halving = 0; halving < max_halvings; ++halving) {
                for (size_t k = 0; k < count; ++k) { trial[k] = x[k] + share * step[k]; }
                trial_cost = problem.cost(trial, barrier);
                if (trial_cost < cost - sufficient_decrease * share * promise) { break; }
                share *= 0.5;
            }
            if (!(trial_cost < cost)) { break; }
            std::copy(trial.begin(), trial.end(), x.begin());
            cost = trial_cost;
        }
        if (problem.is_last(x, barrier)) { return; }
        barrier *= schedule.factor;
    }
}

}  // namespace armctl
