// A strictly convex quadratic program with equalities, by the null-space method: Nocedal and Wright, Numerical Optimization
// (2006), 16.2.
//
// The equalities E x = e are taken out of the program first. Householder reflections give an orthonormal basis whose first rows
// span the rows of E; coordinates along these are determined. What remains is a program of the coordinates along the other rows,
// and of the unknowns that E does not contain, without equalities.
#pragma once
#include <optional>
#include <vector>

#include "quadratic_program.hpp"

namespace armctl {

// The solver with its scratch memory: one object for each thread. It allocates memory only where the rank of the equalities changes.
class NullSpaceSolver {
public:
    // Programs of n unknowns and at most `rows` other constraints. The equalities contain some of the unknowns only.
    NullSpaceSolver(size_t n, std::vector<size_t> contained, size_t rows)
        : contained_(std::move(contained)), others_(others_of(n, contained_)), rows_(rows) {}

    // Solves a program whose first rows of M are equalities, where they have bounds: their lower ones count. Returns false if the
    // constraints contradict each other.
    [[nodiscard]] bool solve(const QuadraticProgram& program, size_t equalities, Result x) {
        if (!find_null_space(program, equalities)) { return false; }
        reduce_cost(program);
        if (!reduce_constraints(program, equalities)) { return false; }
        const auto first = [](const Numbers& all, size_t count) { return Vector(all).first(count); };
        const Matrix M{M_.numbers().data(), rows_ + contained_.size(), size()};
        const size_t bounds = size() + M.rows;
        const Matrix H{H_.numbers().data(), size(), size()};
        const Result y = Result(y_).first(size());
        if (!free_->solve({.H = H, .f = first(f_, size()), .M = M, .lower = first(lower_, bounds), .upper = first(upper_, bounds)}, y)) {
            return false;
        }
        for (size_t a = 0; a < others_.size(); ++a) { x[others_[a]] = y[a]; }
        for (size_t c = 0; c < contained_.size(); ++c) {
            double& number = x[contained_[c]];
            number = particular_[c];
            for (size_t k = rank_; k < contained_.size(); ++k) { number += basis_(k, c) * y[others_.size() + k - rank_]; }
        }
        return true;
    }

private:
    // Squared sine between a row and the span of those before, below which it depends on them, as in `ActiveSetSolver`.
    static constexpr double dependent = 1e-20;
    static constexpr double contradiction = 1e-9;  // units of the unknowns: a constraint without freedom that is missed by less holds

    static std::vector<size_t> others_of(size_t n, const std::vector<size_t>& contained) {
        std::vector<size_t> others;
        for (size_t i = 0; i < n; ++i) {
            if (std::ranges::find(contained, i) == contained.end()) { others.push_back(i); }
        }
        return others;
    }

    // Of the program that remains.
    size_t size() const { return others_.size() + contained_.size() - rank_; }

    static double element(Matrix symmetric, size_t i, size_t k) { return i < k ? symmetric(k, i) : symmetric(i, k); }
    static bool is_bounded(const QuadraticProgram& program, size_t row) {
        return program.lower[row] > -unbounded || program.upper[row] < unbounded;
    }

    // Finds the basis, and the shortest solution of the equalities; false if they contradict each other.
    bool find_null_space(const QuadraticProgram& program, size_t equalities) {
        const size_t n = program.H.rows;
        const size_t before = rank_;
        rank_ = 0;
        set_identity(basis_);
        std::ranges::fill(particular_, 0.0);
        for (size_t row = 0; row < equalities; ++row) {
            if (!is_bounded(program, n + row)) { continue; }
            gather(program.M.row(row), row_);
            double square = 0.0;
            double independent = 0.0;
            double rest = program.lower[n + row];
            for (size_t j = 0; j < contained_.size(); ++j) {
                coordinates_[j] = dot(basis_.row(j), row_);
                square += coordinates_[j] * coordinates_[j];
                if (j < rank_) { rest -= coordinates_[j] * determined_[j]; }
                if (j >= rank_) { independent += coordinates_[j] * coordinates_[j]; }
            }
            if (independent > dependent * square) {
                const double length = -std::copysign(std::sqrt(independent), coordinates_[rank_]);
                determined_[rank_] = rest / length;
                reflect(length);
                ++rank_;
            } else if (!(std::abs(rest) <= contradiction * (std::sqrt(square) + std::abs(program.lower[n + row])))) {
                return false;
            }
        }
        for (size_t j = 0; j < rank_; ++j) {
            for (size_t c = 0; c < contained_.size(); ++c) { particular_[c] += determined_[j] * basis_(j, c); }
        }
        if (!free_ || rank_ != before) { free_.emplace(size(), contained_.size() + rows_); }
        return true;
    }

    // Changes the basis from its row `rank_` on, by the reflection that leaves of the coordinates there the first one, which becomes
    // `length`.
    void reflect(double length) {
        const size_t count = contained_.size();
        coordinates_[rank_] -= length;
        const double scale = 1.0 / (length * coordinates_[rank_]);
        std::ranges::fill(row_, 0.0);
        for (size_t j = rank_; j < count; ++j) {
            for (size_t c = 0; c < count; ++c) { row_[c] += coordinates_[j] * basis_(j, c); }
        }
        for (size_t j = rank_; j < count; ++j) {
            const double factor = scale * coordinates_[j];
            for (size_t c = 0; c < count; ++c) { basis_(j, c) += factor * row_[c]; }
        }
    }

    // The numbers of a row (n,) that belong to contained unknowns.
    void gather(Vector row, Result gathered) const {
        for (size_t c = 0; c < contained_.size(); ++c) { gathered[c] = row[contained_[c]]; }
    }

    // Hessian and gradient for the remaining coordinates, at the shortest solution of the equalities.
    void reduce_cost(const QuadraticProgram& program) {
        const size_t others = others_.size();
        const size_t count = contained_.size();
        const MatrixResult H{H_.numbers().data(), size(), size()};
        for (size_t a = 0; a < others; ++a) {
            const size_t i = others_[a];
            for (size_t b = 0; b <= a; ++b) { H(a, b) = element(program.H, i, others_[b]); }
            for (size_t c = 0; c < count; ++c) { row_[c] = element(program.H, i, contained_[c]); }
            for (size_t k = rank_; k < count; ++k) { H(others + k - rank_, a) = dot(basis_.row(k), row_); }
            f_[a] = program.f[i] + dot(row_, particular_);
        }
        for (size_t c = 0; c < count; ++c) {
            for (size_t d = 0; d < count; ++d) { row_[d] = element(program.H, contained_[c], contained_[d]); }
            for (size_t k = rank_; k < count; ++k) { product_(k, c) = dot(basis_.row(k), row_); }
            coordinates_[c] = program.f[contained_[c]] + dot(row_, particular_);
        }
        for (size_t k = rank_; k < count; ++k) {
            const size_t row = others + k - rank_;
            for (size_t l = rank_; l <= k; ++l) { H(row, others + l - rank_) = dot(basis_.row(k), product_.row(l)); }
            f_[row] = dot(basis_.row(k), coordinates_);
        }
    }

    // Bounds and rows for the remaining coordinates. False if one without freedom does not hold.
    bool reduce_constraints(const QuadraticProgram& program, size_t equalities) {
        const size_t others = others_.size();
        const size_t count = contained_.size();
        const size_t n = others + count;
        std::ranges::fill(lower_, -unbounded);
        std::ranges::fill(upper_, unbounded);
        for (size_t a = 0; a < others; ++a) {
            lower_[a] = program.lower[others_[a]];
            upper_[a] = program.upper[others_[a]];
        }
        const MatrixResult M{M_.numbers().data(), count + rows_, size()};
        for (size_t c = 0; c < count; ++c) {
            std::ranges::fill(M.row(c), 0.0);
            for (size_t k = rank_; k < count; ++k) { M(c, others + k - rank_) = basis_(k, c); }
            if (!bound(program, contained_[c], particular_[c], c)) { return false; }
        }
        for (size_t row = equalities; row < program.M.rows; ++row) {
            if (!is_bounded(program, n + row)) { continue; }
            const size_t reduced = count + row - equalities;
            gather(program.M.row(row), row_);
            for (size_t a = 0; a < others; ++a) { M(reduced, a) = program.M(row, others_[a]); }
            for (size_t k = rank_; k < count; ++k) { M(reduced, others + k - rank_) = dot(basis_.row(k), row_); }
            if (!bound(program, n + row, dot(row_, particular_), reduced)) { return false; }
        }
        return true;
    }

    // Sets the bounds of a reduced row from those of a constraint that has a value at the shortest solution. False if the row has no
    // freedom and they do not hold.
    bool bound(const QuadraticProgram& program, size_t constraint, double value, size_t reduced) {
        const double lower = program.lower[constraint];
        const double upper = program.upper[constraint];
        const Vector row{M_.numbers().data() + reduced * size(), size()};
        if (!(dot(row, row) > dependent)) { return value >= lower - contradiction && value <= upper + contradiction; }
        if (lower > -unbounded) { lower_[size() + reduced] = lower - value; }
        if (upper < unbounded) { upper_[size() + reduced] = upper - value; }
        return true;
    }

    std::vector<size_t> contained_;        // the unknowns of the equalities
    std::vector<size_t> others_;           // the unknowns that they do not contain
    size_t rows_;                          // of the other constraints
    size_t rank_ = 0;                      // of the equalities
    std::optional<ActiveSetSolver> free_;  // of the program that remains
    Mat basis_{contained_.size(), contained_.size()};
    Numbers determined_ = Numbers(contained_.size());  // coordinates along the first rows of the basis
    Numbers particular_ = determined_;                 // the shortest solution of the equalities
    // The program that remains: of the other unknowns, and of the coordinates along the last rows of the basis.
    size_t most_ = others_.size() + contained_.size();
    Mat H_{most_, most_};
    Mat M_{contained_.size() + rows_, most_};
    Numbers f_ = Numbers(most_), y_ = f_;
    Numbers lower_ = Numbers(most_ + contained_.size() + rows_), upper_ = lower_;
    // Scratch memory.
    Mat product_{contained_.size(), contained_.size()};
    Numbers row_ = determined_, coordinates_ = determined_;
};

}  // namespace armctl
