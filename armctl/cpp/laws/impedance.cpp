#include "impedance.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "../factorization.hpp"
#include "symmetric_eigenvalues.hpp"

namespace armctl {

Impedance::Impedance(std::shared_ptr<const ArmModel> model, Gains gains)
    : gains_{
          .stiffness = checked_gains(std::move(gains.stiffness), 6, "stiffness"),
          .max_error = checked_limits(std::move(gains.max_error), 6, "max_error"),
          .posture_stiffness = checked_gains(std::move(gains.posture_stiffness), model->n(), "posture_stiffness"),
          .damping_ratio = checked_gain(gains.damping_ratio, "damping_ratio"),
      },
      dynamics_(model), task_(model->n()), mobility_(6, 6), inverse_(model->n(), 6), null_space_(model->n(), model->n()),
      posture_stiffness_(model->n(), model->n()), stiffness_(model->n(), model->n()), scaled_stiffness_(model->n(), model->n()),
      modes_(model->n(), model->n()), error_rate_(model->n()), scaled_rate_(model->n()), feedback_(model->n()) {}

void Impedance::set_stiffness(std::vector<double> stiffness) { gains_.stiffness = checked_gains(std::move(stiffness), 6, "stiffness"); }

void Impedance::torque(const State& state, const Setpoint& setpoint, Result tau) {
    const size_t n = tau.size();
    const Vector v_ref = setpoint.v_tick;
    const Vector a_ref = setpoint.a_tick;
    task_.measure_tip(dynamics_, state.q, setpoint.q);
    task_.find_responses(dynamics_);
    task_.factorize_mobility(mobility_);
    find_posture_stiffness();
    const Matrix J = task_.J();
    const Vector error = task_.error();
    for (size_t i = 0; i < n; ++i) {
        error_rate_[i] = v_ref[i] - state.v[i];
        feedback_[i] = 0.0;
        for (size_t k = 0; k < n; ++k) {
            stiffness_(i, k) = posture_stiffness_(i, k);
            feedback_[i] += posture_stiffness_(i, k) * (setpoint.q[k] - state.q[k]);
            for (size_t j = 0; j < 6; ++j) { stiffness_(i, k) += gains_.stiffness[j] * J(j, i) * J(j, k); }
        }
        for (size_t j = 0; j < 6; ++j) { feedback_[i] += J(j, i) * gains_.stiffness[j] * clipped(error[j], gains_.max_error[j]); }
    }
    add_critical_damping();
    dynamics_.inverse_dynamics(state.q, state.v, a_ref, tau);
    dynamics_.add_linear_damping(error_rate_, tau);
    dynamics_.add_friction(v_ref, a_ref, tau);
    for (size_t i = 0; i < n; ++i) { tau[i] += feedback_[i]; }
}

// The posture springs in the null space of the tip, N^T diag(springs) N with N = 1 - M^-1 J^T (J M^-1 J^T)^-1 J.
void Impedance::find_posture_stiffness() {
    const size_t n = joints();
    const Matrix J = task_.J();
    for (size_t i = 0; i < n; ++i) {
        std::ranges::copy(task_.responses().row(i), inverse_.row(i).begin());
        solve(mobility_, inverse_.row(i));
        for (size_t k = 0; k < n; ++k) {
            double total = i == k ? 1.0 : 0.0;
            for (size_t j = 0; j < 6; ++j) { total -= inverse_(i, j) * J(j, k); }
            null_space_(i, k) = total;
        }
    }
    for (size_t i = 0; i < n; ++i) {
        for (size_t k = 0; k <= i; ++k) {
            double total = 0.0;
            for (size_t j = 0; j < n; ++j) { total += gains_.posture_stiffness[j] * null_space_(j, i) * null_space_(j, k); }
            posture_stiffness_(i, k) = total;
            posture_stiffness_(k, i) = total;
        }
    }
}

// Adds 2 ratio L (L^-1 K L^-T)^1/2 L^T rate, with the Cholesky factor L of M: it damps every mode of M and K equally.
void Impedance::add_critical_damping() {
    const size_t n = joints();
    take_roots(task_.inertia());
    const Matrix L = task_.inertia();
    for (size_t k = 0; k < n; ++k) {  // the columns of L^-1 K
        for (size_t i = 0; i < n; ++i) {
            double rest = stiffness_(i, k);
            for (size_t j = 0; j < i; ++j) { rest -= L(i, j) * scaled_stiffness_(j, k); }
            scaled_stiffness_(i, k) = rest / L(i, i);
        }
    }
    for (size_t i = 0; i < n; ++i) {  // the rows of L^-1 K L^-T
        for (size_t k = 0; k < n; ++k) {
            double rest = scaled_stiffness_(i, k);
            for (size_t j = 0; j < k; ++j) { rest -= L(k, j) * scaled_stiffness_(i, j); }
            scaled_stiffness_(i, k) = rest / L(k, k);
        }
    }
    diagonalize(scaled_stiffness_, modes_);
    for (size_t i = 0; i < n; ++i) {
        scaled_rate_[i] = 0.0;
        for (size_t k = i; k < n; ++k) { scaled_rate_[i] += L(k, i) * error_rate_[k]; }
    }
    for (size_t m = 0; m < n; ++m) {
        double amplitude = 0.0;
        for (size_t i = 0; i < n; ++i) { amplitude += modes_(i, m) * scaled_rate_[i]; }
        amplitude *= 2.0 * gains_.damping_ratio * std::sqrt(std::max(scaled_stiffness_(m, m), 0.0));
        for (size_t i = 0; i < n; ++i) {
            double total = 0.0;
            for (size_t k = 0; k <= i; ++k) { total += L(i, k) * modes_(k, m); }
            feedback_[i] += amplitude * total;
        }
    }
}

}  // namespace armctl
