#include "quadratic_program.hpp"

#include <cmath>
#include <limits>

namespace armctl {

namespace {

constexpr double infinity = std::numeric_limits<double>::infinity();
constexpr double rounding = 1e-12;  // violation of a bound, relative to point and bound, that does not count
// As above, for a constraint that contradicts the active ones: the rounding of a point that almost parallel normals determine.
constexpr double contradiction = 1e-9;
// Squared sine between a normal and the span of the active ones, below which it counts as dependent: rounding of the normals
// leaves 1e-22 if H has a condition number of 1e10.
constexpr double dependent = 1e-20;
constexpr double negligible_rate = 1e-12;  // what rounding leaves of a rate that is zero; normals have unit length
// Changes of the active set per constraint. In exact arithmetic, the method ends by itself; random programs needed at most 3.
constexpr size_t max_changes = 10;

}  // namespace

ActiveSetSolver::ActiveSetSolver(size_t n)
    : n_(n), factor_(n, n), normals_(2 * n, n), basis_(n, n), triangle_(n, n), low_(2 * n), high_(2 * n), tolerances_(2 * n), start_(n),
      point_(n), coordinates_(n), rates_(n), active_(n) {}

bool ActiveSetSolver::solve(const QuadraticProgram& program, Result x) {
    if (!set_up(program) || !find_nearest()) { return false; }
    for (size_t i = n_; i-- > 0;) {  // x = L^-T y
        double rest = point_[i];
        for (size_t k = i + 1; k < n_; ++k) { rest -= factor_(k, i) * x[k]; }
        x[i] = rest / factor_(i, i);
    }
    return true;
}

// The least-distance form of the program; false if a lower bound is above its upper bound.
bool ActiveSetSolver::set_up(const QuadraticProgram& program) {
    for (size_t i = 0; i < n_; ++i) {
        for (size_t k = 0; k < n_; ++k) { factor_(i, k) = program.H(i, k); }
    }
    factorize(factor_);
    take_roots(factor_);
    for (size_t i = 0; i < n_; ++i) {
        start_[i] = -program.f[i];
        for (size_t k = 0; k < n_; ++k) {
            normals_(i, k) = i == k ? 1.0 : 0.0;
            normals_(n_ + i, k) = program.M(i, k);
        }
        forward(i, normals_.row(i));
        forward(0, normals_.row(n_ + i));
    }
    forward(0, start_);
    for (size_t row = 0; row < 2 * n_; ++row) {
        const double scale = 1.0 / std::sqrt(dot(normals_.row(row), normals_.row(row)));
        for (double& number : normals_.row(row)) { number *= scale; }
        const double lower = program.lower[row];
        const double upper = program.upper[row];
        low_[row] = scale * lower;
        high_[row] = scale * upper;
        if (lower - upper > contradiction * (std::abs(lower) + std::abs(upper))) { return false; }
    }
    return true;
}

// Replaces x, whose numbers before `first` are zero, by L^-1 x.
void ActiveSetSolver::forward(size_t first, Result x) const {
    for (size_t i = first; i < x.size(); ++i) {
        double rest = x[i];
        for (size_t k = first; k < i; ++k) { rest -= factor_(i, k) * x[k]; }
        x[i] = rest / factor_(i, i);
    }
}

// Moves the point to that of the polyhedron which is nearest to the start; false if there is none.
bool ActiveSetSolver::find_nearest() {
    begin_without_constraints();
    std::optional<Entering> entering;
    double multiplier = 0.0;  // of the entering constraint
    bool is_exact = true;
    for (size_t change = 0; change < max_changes * 2 * n_; ++change) {
        if (!entering) {
            entering = most_violated();
            multiplier = 0.0;
        }
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
        multiplier += step;
        decrease_multipliers(step);
        move(step);
        is_exact = false;
        if (step < full) {
            tolerances_[active_[*dropped].row] = rounding;
            drop(*dropped);
        } else {
            tolerances_[row] = infinity;
            add({.multiplier = multiplier, .bound = bound, .row = row});
            entering.reset();
        }
    }
    return false;
}

void ActiveSetSolver::begin_without_constraints() {
    count_ = 0;
    std::ranges::copy(start_, point_.begin());
    std::ranges::fill(tolerances_, rounding);
    for (size_t i = 0; i < n_; ++i) {
        for (size_t k = 0; k < n_; ++k) { basis_(i, k) = i == k ? 1.0 : 0.0; }
    }
}

// The active constraint whose multiplier becomes zero first; none if no multiplier decreases.
std::optional<size_t> ActiveSetSolver::first_zero_multiplier() const {
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

void ActiveSetSolver::decrease_multipliers(double step) {
    for (size_t j = 0; j < count_; ++j) { active_[j].multiplier = std::max(active_[j].multiplier - step * rates_[j], 0.0); }
}

// The constraint that the point violates most, if there is one.
std::optional<ActiveSetSolver::Entering> ActiveSetSolver::most_violated() const {
    const double distance = std::sqrt(dot(point_, point_));
    double largest = 0.0;
    std::optional<Entering> found;
    for (size_t row = 0; row < 2 * n_; ++row) {
        if (tolerances_[row] == infinity) { continue; }
        const double position = dot(normals_.row(row), point_);
        const double below = low_[row] - position;
        const double above = position - high_[row];
        if (below > std::max(largest, tolerances_[row] * (distance + std::abs(low_[row])))) {
            largest = below;
            found = {.row = row, .side = 1.0, .bound = low_[row]};
        }
        if (above > std::max(largest, tolerances_[row] * (distance + std::abs(high_[row])))) {
            largest = above;
            found = {.row = row, .side = -1.0, .bound = -high_[row]};
        }
    }
    return found;
}

// Finds coordinates of a signed normal and rates of the multipliers. Returns the squared length of the part of the normal that
// the active ones do not span.
double ActiveSetSolver::project(const Entering& entering) {
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
    for (size_t j = count_; j-- > 0;) {
        double rest = coordinates_[j];
        for (size_t k = j + 1; k < count_; ++k) { rest -= triangle_(k, j) * rates_[k]; }
        rates_[j] = rest / triangle_(j, j);
    }
    return independent;
}

// Moves the point along the part of the entering normal that the active ones do not span.
void ActiveSetSolver::move(double step) {
    for (size_t j = count_; j < n_; ++j) {
        for (size_t k = 0; k < n_; ++k) { point_[k] += step * coordinates_[j] * basis_(j, k); }
    }
}

// The point nearest to the start on all active bounds, computed anew: the rounding of the steps does not remain.
void ActiveSetSolver::set_point() {
    std::ranges::fill(point_, 0.0);
    for (size_t j = 0; j < n_; ++j) {
        if (j < count_) {
            double rest = active_[j].bound;
            for (size_t k = 0; k < j; ++k) { rest -= triangle_(j, k) * coordinates_[k]; }
            coordinates_[j] = rest / triangle_(j, j);
        } else {
            coordinates_[j] = dot(basis_.row(j), start_);
        }
        for (size_t k = 0; k < n_; ++k) { point_[k] += coordinates_[j] * basis_(j, k); }
    }
}

// Adds a constraint with known coordinates to the active ones, by a Householder reflection of the other basis vectors.
void ActiveSetSolver::add(const ActiveConstraint& constraint) {
    double square = 0.0;
    for (size_t j = count_; j < n_; ++j) { square += coordinates_[j] * coordinates_[j]; }
    const double length = -std::copysign(std::sqrt(square), coordinates_[count_]);
    for (size_t j = 0; j < count_; ++j) { triangle_(count_, j) = coordinates_[j]; }
    triangle_(count_, count_) = length;
    coordinates_[count_] -= length;
    const double scale = 1.0 / (length * coordinates_[count_]);
    std::vector<double>& product = rates_;  // which are computed again before they are read
    std::ranges::fill(product, 0.0);
    for (size_t j = count_; j < n_; ++j) {
        for (size_t k = 0; k < n_; ++k) { product[k] += coordinates_[j] * basis_(j, k); }
    }
    for (size_t j = count_; j < n_; ++j) {
        for (size_t k = 0; k < n_; ++k) { basis_(j, k) += scale * coordinates_[j] * product[k]; }
    }
    active_[count_] = constraint;
    ++count_;
}

// Removes one of the active constraints, and makes the triangle one again by plane rotations.
void ActiveSetSolver::drop(size_t dropped) {
    --count_;
    for (size_t j = dropped; j < count_; ++j) {
        active_[j] = active_[j + 1];
        for (size_t k = 0; k < j + 2; ++k) { triangle_(j, k) = triangle_(j + 1, k); }
    }
    for (size_t j = dropped; j < count_; ++j) {
        const double length = std::sqrt(triangle_(j, j) * triangle_(j, j) + triangle_(j, j + 1) * triangle_(j, j + 1));
        const double cos = triangle_(j, j) / length;
        const double sin = triangle_(j, j + 1) / length;
        for (size_t k = 0; k < n_; ++k) {
            const double turned = cos * basis_(j, k) + sin * basis_(j + 1, k);
            basis_(j + 1, k) = cos * basis_(j + 1, k) - sin * basis_(j, k);
            basis_(j, k) = turned;
        }
        for (size_t k = j; k < count_; ++k) {
            const double turned = cos * triangle_(k, j) + sin * triangle_(k, j + 1);
            triangle_(k, j + 1) = cos * triangle_(k, j + 1) - sin * triangle_(k, j);
            triangle_(k, j) = turned;
        }
    }
}

}  // namespace armctl
