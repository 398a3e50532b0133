// A strictly convex quadratic program by a dual active-set method, without allocation.
//
//     minimize x H x / 2 + f x    subject to    lower <= (x, M x) <= upper,
//
// with x (n,), H (n, n) positive definite, M (m, n) without zero rows, and bounds (n + m,).
//
// The method is that of Goldfarb and Idnani, "A numerically stable dual method for solving strictly convex quadratic programs",
// Mathematical Programming 27 (1983), on the least-distance form that daqp uses too (Arnström, Bemporad, Axehill, "A dual
// active-set solver for embedded quadratic programming using recursive LDL^T updates", IEEE Transactions on Automatic Control
// 67, 2022). With H = L L^T and y = L^T x, the solution is the point of a polyhedron that is nearest to y0 = -L^-1 f. The
// normals of the polyhedron are the rows of (1, M) L^-T, scaled to unit length. The method begins at y0, without active
// constraints. It adds the constraint that the point violates most, and drops those whose multipliers become zero on the way,
// so each point is the nearest one that its active constraints allow. The normals of the active constraints are kept as an
// orthogonal factorization, N^T = T P, with T lower triangular and P orthogonal, which remains accurate if normals are almost
// parallel.
#pragma once
#include <cmath>
#include <limits>
#include <optional>

#include "linear_algebra.hpp"

namespace armctl {

constexpr double unbounded = 1e30;        // of bounds that the solution does not reach
constexpr double limit_tolerance = 1e-9;  // relative, at which a limit counts as respected

struct QuadraticProgram {
    Matrix H;      // (n, n), of which the lower triangle counts
    Vector f;      // (n,), or empty for zeros
    Matrix M;      // (m, n)
    Vector lower;  // (n + m,) bounds of x and of M x; -`unbounded` where there is none
    Vector upper;  // (n + m,)
};

// The solver with its scratch memory: one object for each thread.
class ActiveSetSolver {
public:
    explicit ActiveSetSolver(size_t n) : ActiveSetSolver(n, n) {}
    ActiveSetSolver(size_t n, size_t m) : n_(n), rows_(n + m), active_(n) {}

    // Solves the program, and tells whether there is a solution. False if the constraints contradict each other, and after too
    // many changes of the active set, which no test found. If a number of the program is not finite, the result is arbitrary.
    [[nodiscard]] bool solve(const QuadraticProgram& program, Result x) {
        if (!set_up(program) || !find_nearest()) { return false; }
        copy(point_, x);
        backward_substitute(factor_, x);
        return true;
    }

    // The same, with costs in the place of the bounds that exclude zero, where a row of the constraints has a weight (n + m,).
    [[nodiscard]] bool solve_relaxed(const QuadraticProgram& program, Vector weights, Result x) {
        relaxed_H_.set(program.H);
        copy(program.lower, relaxed_lower_);
        copy(program.upper, relaxed_upper_);
        std::ranges::fill(relaxed_f_, 0.0);
        copy(program.f, relaxed_f_);
        for (size_t row = 0; row < rows_; ++row) {
            const double nearest = std::min(std::max(0.0, program.lower[row]), program.upper[row]);
            if (weights[row] == 0.0 || nearest == 0.0) { continue; }
            set_row(program, row, direction_);
            for (size_t i = 0; i < n_; ++i) {
                for (size_t j = 0; j < n_; ++j) { relaxed_H_(i, j) += weights[row] * direction_[i] * direction_[j]; }
                relaxed_f_[i] -= weights[row] * nearest * direction_[i];
            }
            relaxed_lower_[row] = -unbounded;
            relaxed_upper_[row] = unbounded;
        }
        return solve({.H = relaxed_H_, .f = relaxed_f_, .M = program.M, .lower = relaxed_lower_, .upper = relaxed_upper_}, x);
    }

private:
    static constexpr double infinity = std::numeric_limits<double>::infinity();
    static constexpr double rounding = 1e-12;  // violation of a bound, relative to point and bound, that does not count
    // As above, for a constraint that contradicts the active ones: the rounding of a point that almost parallel normals determine.
    static constexpr double contradiction = 1e-9;
    // Squared sine between a normal and the span of the active ones, below which it counts as dependent: rounding of the normals
    // leaves 1e-22 if H has a condition number of 1e10.
    static constexpr double dependent = 1e-20;
    static constexpr double negligible_rate = 1e-12;  // what rounding leaves of a rate that is zero; normals have unit length
    // Changes of the active set per constraint. In exact arithmetic, the method ends by itself; random programs needed at most 3.
    static constexpr size_t max_changes = 10;

    // A constraint that is active or enters: the normal of a row, or its opposite.
    struct Constraint {
        size_t row;
        double side;   // of the normal: 1 for the lower bound, -1 for the upper one
        double bound;  // of the signed normal
        double multiplier = 0.0;
    };

    // The coefficients of a constraint, (n,).
    void set_row(const QuadraticProgram& program, size_t row, Result coefficients) const {
        if (row >= n_) {
            copy(program.M.row(row - n_), coefficients);
            return;
        }
        std::ranges::fill(coefficients, 0.0);
        coefficients[row] = 1.0;
    }

    // The least-distance form of the program; false if a lower bound is above its upper bound.
    bool set_up(const QuadraticProgram& program) {
        factor_.set(program.H);
        factorize(factor_);
        take_roots(factor_);
        for (size_t i = 0; i < n_; ++i) { start_[i] = program.f.empty() ? 0.0 : -program.f[i]; }
        forward_substitute(factor_, start_);
        for (size_t row = 0; row < rows_; ++row) {
            const double lower = program.lower[row];
            const double upper = program.upper[row];
            tolerances_[row] = infinity;
            if (lower <= -unbounded && upper >= unbounded) { continue; }
            tolerances_[row] = rounding;
            set_row(program, row, normals_.row(row));
            if (row < n_) {
                forward_substitute(factor_, normals_.row(row), row);
            } else {
                forward_substitute(factor_, normals_.row(row));
            }
            const double scale = 1.0 / std::sqrt(dot(normals_.row(row), normals_.row(row)));
            for (double& number : normals_.row(row)) { number *= scale; }
            low_[row] = scale * lower;
            high_[row] = scale * upper;
            if (lower - upper > contradiction * (std::abs(lower) + std::abs(upper))) { return false; }
        }
        return true;
    }

    // Moves the point to that of the polyhedron which is nearest to the start; false if there is none.
    bool find_nearest() {
        count_ = 0;
        copy(start_, point_);
        set_identity(basis_);
        std::optional<Constraint> entering;
        bool is_exact = true;
        for (size_t change = 0; change < max_changes * rows_; ++change) {
            if (!entering) { entering = most_violated(); }
            if (!entering) {
                if (is_exact) { return true; }
                set_point();
                is_exact = true;
                continue;
            }
            const size_t row = entering->row;
            const double bound = entering->bound;
            const double violation = bound - entering->side * dot(normals_.row(row), point_);
            const double independent = project(*entering);
            const std::optional<size_t> dropped = first_zero_multiplier();
            if (!dropped && independent == 0.0) {
                if (!(violation < contradiction * (std::sqrt(dot(point_, point_)) + std::abs(bound)))) { return false; }
                tolerances_[row] = contradiction;
                entering.reset();
                continue;
            }
            const double full = independent > 0.0 ? violation / independent : infinity;
            const double step = dropped ? std::min(full, active_[*dropped].multiplier / rates_[*dropped]) : full;
            entering->multiplier += step;
            move(step);
            is_exact = false;
            if (step < full) {
                tolerances_[active_[*dropped].row] = rounding;
                drop(*dropped);
            } else {
                tolerances_[row] = infinity;
                add(*entering);
                entering.reset();
            }
        }
        return false;
    }

    // The constraint that the point violates most, if there is one.
    std::optional<Constraint> most_violated() const {
        const double distance = std::sqrt(dot(point_, point_));
        double largest = 0.0;
        std::optional<Constraint> found;
        for (size_t row = 0; row < rows_; ++row) {
            if (tolerances_[row] == infinity) { continue; }
            const double position = dot(normals_.row(row), point_);
            for (const double side : {1.0, -1.0}) {
                const double bound = side > 0.0 ? low_[row] : -high_[row];
                const double violation = bound - side * position;
                if (violation > std::max(largest, tolerances_[row] * (distance + std::abs(bound)))) {
                    largest = violation;
                    found = {.row = row, .side = side, .bound = bound};
                }
            }
        }
        return found;
    }

    // Finds coordinates of a signed normal and rates of the multipliers. Returns the squared length of the part of the normal that
    // the active ones do not span.
    double project(const Constraint& entering) {
        const Vector normal = normals_.row(entering.row);
        double independent = 0.0;
        for (size_t j = 0; j < n_; ++j) {
            coordinates_[j] = entering.side * dot(basis_.row(j), normal);
            if (j >= count_) { independent += coordinates_[j] * coordinates_[j]; }
        }
        if (!(independent > dependent)) {
            independent = 0.0;
            std::fill(coordinates_.begin() + static_cast<std::ptrdiff_t>(count_), coordinates_.end(), 0.0);
        }
        copy(coordinates_, rates_);
        backward_substitute(triangle_, Result(rates_).first(count_));
        return independent;
    }

    // The active constraint whose multiplier becomes zero first; none if no multiplier decreases.
    std::optional<size_t> first_zero_multiplier() const {
        std::optional<size_t> first;
        double shortest = infinity;
        for (size_t j = 0; j < count_; ++j) {
            if (rates_[j] > negligible_rate && active_[j].multiplier < shortest * rates_[j]) {
                shortest = active_[j].multiplier / rates_[j];
                first = j;
            }
        }
        return first;
    }

    // Moves the point along the part of the entering normal that the active ones do not span; their multipliers decrease.
    void move(double step) {
        for (size_t j = 0; j < count_; ++j) { active_[j].multiplier = std::max(active_[j].multiplier - step * rates_[j], 0.0); }
        std::ranges::fill(direction_, 0.0);
        for (size_t j = count_; j < n_; ++j) {
            for (size_t k = 0; k < n_; ++k) { direction_[k] += coordinates_[j] * basis_(j, k); }
        }
        for (size_t k = 0; k < n_; ++k) { point_[k] += step * direction_[k]; }
    }

    // The point nearest to the start on all active bounds, computed anew: the rounding of the steps does not remain.
    void set_point() {
        for (size_t j = 0; j < n_; ++j) { coordinates_[j] = j < count_ ? active_[j].bound : dot(basis_.row(j), start_); }
        forward_substitute(triangle_, Result(coordinates_).first(count_));
        for (size_t k = 0; k < n_; ++k) { point_[k] = dot(basis_.column(k), coordinates_); }
    }

    // Adds a constraint with known coordinates to the active ones, by a Householder reflection of the other basis vectors.
    void add(const Constraint& constraint) {
        double square = 0.0;
        for (size_t j = count_; j < n_; ++j) { square += coordinates_[j] * coordinates_[j]; }
        const double length = -std::copysign(std::sqrt(square), coordinates_[count_]);
        for (size_t j = 0; j < count_; ++j) { triangle_(count_, j) = coordinates_[j]; }
        triangle_(count_, count_) = length;
        coordinates_[count_] -= length;
        const double scale = 1.0 / (length * coordinates_[count_]);
        for (size_t k = 0; k < n_; ++k) { direction_[k] -= length * basis_(count_, k); }
        for (size_t j = count_; j < n_; ++j) {
            const double factor = scale * coordinates_[j];
            for (size_t k = 0; k < n_; ++k) { basis_(j, k) += factor * direction_[k]; }
        }
        active_[count_] = constraint;
        ++count_;
    }

    // Removes one of the active constraints, and makes the triangle one again by plane rotations.
    void drop(size_t dropped) {
        --count_;
        for (size_t j = dropped; j < count_; ++j) {
            active_[j] = active_[j + 1];
            for (size_t k = 0; k < j + 2; ++k) { triangle_(j, k) = triangle_(j + 1, k); }
        }
        for (size_t j = dropped; j < count_; ++j) {
            const double length = std::sqrt(triangle_(j, j) * triangle_(j, j) + triangle_(j, j + 1) * triangle_(j, j + 1));
            const double cos = triangle_(j, j) / length;
            const double sin = triangle_(j, j + 1) / length;
            turn_rows(basis_, j, j + 1, cos, -sin);
            for (size_t k = j; k < count_; ++k) { turn(triangle_(k, j), triangle_(k, j + 1), cos, -sin); }
        }
    }

    size_t n_;
    size_t rows_;         // of the constraints
    Mat factor_{n_, n_};  // L
    Mat normals_{rows_, n_};
    Mat basis_{n_, n_};                           // P: its first rows span the normals of the active constraints
    Mat triangle_{n_, n_};                        // T: its row j gives the normal of active constraint j in the basis
    Numbers low_ = Numbers(rows_), high_ = low_;  // bounds, scaled with the normals
    // Relative violation, from which a constraint enters; infinite while it is active, and without bounds.
    Numbers tolerances_ = low_;
    Numbers start_ = Numbers(n_);        // y0
    Numbers point_ = Numbers(n_);        // y
    Numbers coordinates_ = Numbers(n_);  // in the basis
    Numbers direction_ = Numbers(n_);    // of the last move
    Numbers rates_ = Numbers(n_);        // at which the multipliers decrease, per increase of that of the entering constraint
    std::vector<Constraint> active_;     // (n,), of which the first `count_` count
    size_t count_ = 0;
    // The program with costs in the place of bounds.
    Mat relaxed_H_{n_, n_};
    Numbers relaxed_f_ = Numbers(n_), relaxed_lower_ = Numbers(rows_), relaxed_upper_ = relaxed_lower_;
};

}  // namespace armctl
