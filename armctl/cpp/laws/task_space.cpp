#include "task_space.hpp"

#include <cmath>

#include "../factorization.hpp"

namespace armctl {

namespace {

// Relative to the trace of the tip's mobility, J M^-1 J^T. Directions of much smaller mobility count as singular.
constexpr double singularity_damping = 1e-3;

// The rotation vector, rad, of reference x measured^T, with an angle of at most pi.
Vec3 rotation_vector(const Rotation& reference, const Rotation& measured) {
    const Rotation between{reference * measured.row_x(), reference * measured.row_y(), reference * measured.row_z()};
    const Quaternion quat = quaternion(between);
    const double sine = std::sqrt(quat.x * quat.x + quat.y * quat.y + quat.z * quat.z);
    const double scale = sine > 0.0 ? 2.0 * std::atan2(sine, quat.w) / sine : 2.0;
    return {scale * quat.x, scale * quat.y, scale * quat.z};
}

}  // namespace

size_t task_rows(size_t n) { return n >= 6 ? 6 : 3; }

TaskSpace::TaskSpace(size_t n) : n_(n), J_(6, n), J_ref_(6, n), responses_(n, 6), inertia_(n, n), column_(n) {}

void TaskSpace::measure_tip(Dynamics& dynamics, Vector q, Vector q_ref) {
    dynamics.place(q_ref);
    dynamics.locate();
    const Pose reference = dynamics.tip();
    dynamics.tip_jacobian(J_ref_);
    dynamics.place(q);
    dynamics.locate();
    const Pose measured = dynamics.tip();
    dynamics.tip_jacobian(J_);
    const Vec3 translation = reference.translation - measured.translation;
    const Vec3 rotation = rotation_vector(reference.rotation, measured.rotation);
    error_ = {translation.x, translation.y, translation.z, rotation.x, rotation.y, rotation.z};
}

void TaskSpace::find_responses(Dynamics& dynamics) {
    dynamics.mass_matrix(inertia_);
    factorize(inertia_);
    for (size_t k = 0; k < 6; ++k) {
        for (size_t i = 0; i < n_; ++i) { column_[i] = J_(k, i); }
        solve(inertia_, column_);
        for (size_t i = 0; i < n_; ++i) { responses_(i, k) = column_[i]; }
    }
}

double TaskSpace::find_mobility(MatrixResult mobility) const {
    double trace = 0.0;
    for (size_t i = 0; i < mobility.rows; ++i) {
        for (size_t k = 0; k <= i; ++k) {
            double total = 0.0;
            for (size_t j = 0; j < n_; ++j) { total += J_(i, j) * responses_(j, k); }
            mobility(i, k) = total;
        }
        trace += mobility(i, i);
    }
    return trace;
}

void TaskSpace::factorize_mobility(MatrixResult factors) const {
    const double trace = find_mobility(factors);
    for (size_t i = 0; i < factors.rows; ++i) { factors(i, i) += singularity_damping * singularity_damping * trace; }
    factorize(factors);
}

void TaskSpace::add_joint_motion(Matrix factors, Result motion_of_tip, Result motion) const {
    solve(factors, motion_of_tip);
    for (size_t i = 0; i < n_; ++i) {
        for (size_t k = 0; k < motion_of_tip.size(); ++k) { motion[i] += responses_(i, k) * motion_of_tip[k]; }
    }
}

}  // namespace armctl
