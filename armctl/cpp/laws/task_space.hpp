// What task-space laws share: the tip's pose error, its Jacobians and its inertia.
//
// Source: Khatib, "A unified approach for motion and force control of robot manipulators: the operational space formulation"
// (1987).
#pragma once
#include "../dynamics.hpp"
#include "../law.hpp"

namespace armctl {

using Vector6 = std::array<double, 6>;

// The rows of a twist that an arm can control: all 6 with at least six joints, else the 3 of the position.
inline size_t task_rows(size_t n) { return n >= 6 ? 6 : 3; }

// Relative to the trace of the tip's mobility. Directions of much smaller mobility count as singular.
constexpr double singularity_damping = 1e-3;

struct TaskSpace {
    // `rows` of the tip's mobility are inverted.
    TaskSpace(const Model& model, size_t rows) : dynamics(model), factors(rows, rows) {}

    // Measures the tip at q with respect to its pose at q_ref. Leaves the joints located at q.
    void measure(Vector q, Vector q_ref) {
        dynamics.locate(q_ref);
        const Pose reference = dynamics.tip();
        J_ref.set(dynamics.tip_jacobian());
        dynamics.locate(q);
        J.set(dynamics.tip_jacobian());
        error = numbers(difference(dynamics.tip(), reference));
        dynamics.mass_matrix(inertia);
        factorize(inertia);
        for (size_t k = 0; k < 6; ++k) {
            copy(J.row(k), column);
            solve(inertia, column);
            for (size_t i = 0; i < n; ++i) { responses(i, k) = column[i]; }
        }
        const double trace = find_mobility(factors);
        for (size_t i = 0; i < factors.rows(); ++i) { factors(i, i) += singularity_damping * singularity_damping * trace; }
        factorize(factors);
    }

    // The lower triangle of the tip's mobility J M^-1 J^T, of its first rows, as many as the result has; returns the trace.
    double find_mobility(MatrixResult mobility) const {
        double trace = 0.0;
        for (size_t i = 0; i < mobility.rows; ++i) {
            for (size_t k = 0; k <= i; ++k) { mobility(i, k) = dot(responses.column(k), J.row(i)); }
            trace += mobility(i, i);
        }
        return trace;
    }

    // How fast row k of the tip's error changes, at velocities (n,) of reference and joints.
    double error_rate(size_t k, Vector v_ref, Vector v, double rate = 0.0) const {
        for (size_t i = 0; i < n; ++i) { rate += J_ref(k, i) * v_ref[i] - J(k, i) * v[i]; }
        return rate;
    }

    // Adds the joint motion (n,) of a motion (rows,) of the tip, by the dynamically consistent inverse. `motion_of_tip` becomes
    // the solution with the factors.
    void add_joint_motion(Result motion_of_tip, Result motion) const {
        solve(factors, motion_of_tip);
        for (size_t i = 0; i < n; ++i) { motion[i] = dot(responses.row(i), motion_of_tip, motion[i]); }
    }

    // motion = J# motion_of_tip + (1 - J# J) motion, of joints (n,); `motion_of_tip` (rows,) is replaced.
    void add_task_motion(Result motion_of_tip, Result motion) const {
        for (size_t k = 0; k < motion_of_tip.size(); ++k) { motion_of_tip[k] -= dot(J.row(k), motion); }
        add_joint_motion(motion_of_tip, motion);
    }

    // tau = ID(q, v, a_ref + posture + J# (motion - J posture)) + damping (v_damped - v) + friction(v_friction, a_ref)
    //
    // `motion` (rows,) and `posture` (n,) are accelerations; both are replaced.
    void torque(const State& state, Vector a_ref, Result motion, Result posture, Vector v_damped, Vector v_friction, Result tau) {
        add_task_motion(motion, posture);
        for (size_t i = 0; i < n; ++i) {
            posture[i] += a_ref[i];
            column[i] = v_damped[i] - state.v[i];
        }
        dynamics.inverse_dynamics(state.q, state.v, posture, tau);
        dynamics.add_linear_damping(column, tau);
        dynamics.add_friction(v_friction, a_ref, tau);
    }

    Dynamics dynamics;
    size_t n = dynamics.model().n();
    Mat J{6, n};                  // at the measured configuration
    Mat J_ref{6, n};              // at the reference
    Mat inertia{n, n};            // the factors of the mass matrix
    Mat responses{n, 6};          // M^-1 J^T
    Mat factors;                  // (rows, rows) of the tip's mobility, damped near singular configurations
    Vector6 error{};              // m and rad, translation and rotation vector of the tip to its reference, world axes
    Numbers column = Numbers(n);  // scratch
};

}  // namespace armctl
