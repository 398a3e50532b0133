// A strictly convex quadratic program by a dual active-set method, without allocation.
//
//     minimize x H x / 2 + f x    subject to    lower <= (x, M x) <= upper,
//
// with x (n,), H (n, n) positive definite, M (n, n) without zero rows, and bounds (2n,).
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
#include <optional>

#include "linear_algebra.hpp"

namespace armctl {

constexpr double unbounded = 1e30;  // of bounds that the solution does not reach

struct QuadraticProgram {
    Matrix H;      // (n, n), of which the lower triangle counts
    Vector f;      // (n,)
    Matrix M;      // (n, n)
    Vector lower;  // (2n,) bounds of x and of M x; -`unbounded` where there is none
    Vector upper;  // (2n,)
};

// The solver with its scratch memory: one object for each thread.
class ActiveSetSolver {
public:
    explicit ActiveSetSolver(size_t n);

    // Solves the program, and tells whether there is a solution. False if the constraints contradict each other, and after too
    // many changes of the active set, which no test found. If a number of the program is not finite, the result is arbitrary.
    bool solve(const QuadraticProgram& program, Result x);

private:
    struct ActiveConstraint {
        double multiplier;
        double bound;
        size_t row;  // which constraint it is
    };

    // A constraint that enters: the normal of a row, or its opposite.
    struct Entering {
        size_t row;
        double side;   // of the normal: 1 for the lower bound, -1 for the upper one
        double bound;  // of the signed normal
    };

    bool set_up(const QuadraticProgram& program);
    void forward(size_t first, Result x) const;
    bool find_nearest();
    void begin_without_constraints();
    std::optional<Entering> most_violated() const;
    double project(const Entering& entering);
    std::optional<size_t> first_zero_multiplier() const;
    void decrease_multipliers(double step);
    void move(double step);
    void set_point();
    void add(const ActiveConstraint& constraint);
    void drop(size_t dropped);

    size_t n_;
    DenseMatrix factor_;                    // (n, n) L
    DenseMatrix normals_;                   // (2n, n)
    DenseMatrix basis_;                     // (n, n) P: its first rows span the normals of the active constraints
    DenseMatrix triangle_;                  // (n, n) T: its row j gives the normal of active constraint j in the basis
    std::vector<double> low_;               // (2n,) bounds, scaled with the normals
    std::vector<double> high_;              // (2n,)
    std::vector<double> tolerances_;        // (2n,) relative violation, from which a constraint enters; infinite while it is active
    std::vector<double> start_;             // (n,) y0
    std::vector<double> point_;             // (n,) y
    std::vector<double> coordinates_;       // (n,) in the basis
    std::vector<double> rates_;             // (n,) at which the multipliers decrease, per increase of that of the entering constraint
    std::vector<ActiveConstraint> active_;  // (n,), of which the first `count_` count
    size_t count_ = 0;
};

}  // namespace armctl
