// What task-space laws share: the tip's pose error, its Jacobians and its inertia.
//
// Source: Khatib, "A unified approach for motion and force control of robot manipulators: the operational space formulation"
// (1987).
#pragma once
#include <array>
#include <vector>

#include "../dense_matrix.hpp"
#include "../dynamics.hpp"

namespace armctl {

// The rows of a twist that an arm can control: all 6 with at least six joints, else the 3 of the position.
size_t task_rows(size_t n);

class TaskSpace {
public:
    explicit TaskSpace(size_t n);

    // Finds the error of the tip at q with respect to its pose at q_ref, and both Jacobians. Leaves the joints located at q.
    void measure_tip(Dynamics& dynamics, Vector q, Vector q_ref);

    // Finds the mass matrix where the joints are placed, factorizes it, and finds M^-1 J^T.
    void find_responses(Dynamics& dynamics);

    // The lower triangle of the tip's mobility J M^-1 J^T, of its first rows, as many as the result has; returns the trace.
    double find_mobility(MatrixResult mobility) const;

    // The factors of the damped mobility of the tip's first rows, as many as the result has.
    void factorize_mobility(MatrixResult factors) const;

    // Adds the joint motion (n,) of a motion (rows,) of the tip, by the dynamically consistent inverse. `motion_of_tip` becomes
    // the solution with the factors.
    void add_joint_motion(Matrix factors, Result motion_of_tip, Result motion) const;

    Matrix J() const { return J_; }                  // (6, n) at the measured configuration
    Matrix J_ref() const { return J_ref_; }          // (6, n) at the reference
    Matrix responses() const { return responses_; }  // (n, 6) M^-1 J^T
    MatrixResult inertia() { return inertia_; }      // (n, n), the factors of the mass matrix
    // (6,) m and rad, translation and rotation vector of the tip to its reference, world axes.
    Vector error() const { return error_; }

private:
    size_t n_;
    DenseMatrix J_;
    DenseMatrix J_ref_;
    DenseMatrix responses_;
    DenseMatrix inertia_;
    std::array<double, 6> error_{};
    std::vector<double> column_;  // (n,) scratch memory
};

}  // namespace armctl
