// Newton's method on a cost with logarithmic barriers: Boyd and Vandenberghe, "Convex Optimization", 2004, chapter 11.
#pragma once
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "spans.hpp"

namespace armctl {

constexpr double INFINITE = std::numeric_limits<double>::infinity();
constexpr double NOT_A_NUMBER = std::numeric_limits<double>::quiet_NaN();

// A symmetric matrix whose elements are zero away from its diagonal.
class BandMatrix {
public:
    // `width` is the number of diagonals from the main one to the outermost one, both included.
    BandMatrix(size_t size, size_t width) : size_(size), width_(width), elements_(size * width) {}

    size_t size() const { return size_; }

    // Element (row, row + offset), with offset below the width.
    double& at(size_t row, size_t offset) { return elements_[row * width_ + offset]; }

    void set_zero() { std::fill(elements_.begin(), elements_.end(), 0.0); }

    // Solves A x = b for a positive definite A by an LDL^T factorization, which replaces A. `x` holds b before the call.
    void factorize_and_solve(Result x) {
        for (size_t row = 0; row < size_; ++row) {
            const size_t end = std::min(width_, size_ - row);
            for (size_t below = 1; below < end; ++below) {
                const double factor = at(row, below) / at(row, 0);
                if (factor == 0.0) { continue; }
                for (size_t offset = below; offset < end; ++offset) { at(row + below, offset - below) -= factor * at(row, offset); }
                x[row + below] -= factor * x[row];
            }
        }
        for (size_t row = size_; row-- > 0;) {
            double total = x[row];
            for (size_t offset = 1; offset < std::min(width_, size_ - row); ++offset) { total -= at(row, offset) * x[row + offset]; }
            x[row] = total / at(row, 0);
        }
    }

private:
    size_t size_;
    size_t width_;
    std::vector<double> elements_;
};

// The sum of the logarithms of slacks.
class LogarithmSum {
public:
    // Returns whether the slack is positive; else the sum is not valid.
    bool add(double slack) {
        product_ *= slack;
        if (!(product_ > 1e-150 && product_ < 1e150)) {  // before it under- or overflows
            sum_ += std::log(product_);
            product_ = 1.0;
        }
        return slack > 0.0;
    }

    double sum() const { return sum_ + std::log(product_); }

private:
    double sum_ = 0.0;
    double product_ = 1.0;
};

struct BarrierSchedule {
    double first;     // weight of the barrier at the start
    double last;      // a weight at or below it ends the search
    double factor;    // from one weight to the next
    double centered;  // share of the barrier: a Newton step that promises a smaller decrease ends the centering
};

// Minimizes from a feasible x, which is changed in place. A problem has the functions
//     double cost(x, barrier)                                      infinite outside the bounds
//     void add_derivatives(x, barrier, gradient, hessian)          to zeros; an infinite number on the diagonal holds an unknown
//     void move(x, step, share, moved)                             by a share of a step, on any curve that begins along it
template <class Problem>
void minimize_with_barriers(const Problem& problem, Result x, size_t band_width, const BarrierSchedule& schedule) {
    constexpr int max_newton_steps = 30;
    constexpr int max_halvings = 30;
    constexpr double sufficient_decrease = 1e-4;  // of the promised one: Armijo's rule

    const size_t count = x.size();
    std::vector<double> gradient(count);
    std::vector<double> step(count);
    std::vector<double> trial(count);
    BandMatrix hessian(count, band_width);
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
            double trial_cost = INFINITE;
            for (int halving = 0; halving < max_halvings; ++halving) {
                problem.move(x, step, share, trial);
                trial_cost = problem.cost(trial, barrier);
                if (trial_cost < cost - sufficient_decrease * share * promise) { break; }
                share *= 0.5;
            }
            if (!(trial_cost < cost)) { break; }
            std::copy(trial.begin(), trial.end(), x.begin());
            cost = trial_cost;
        }
        if (barrier <= schedule.last) { return; }
        barrier *= schedule.factor;
    }
}

}  // namespace armctl
