// Cartesian impedance: the tip yields to forces like a spring and a damper around its reference.
#pragma once
#include "task_space.hpp"

namespace armctl {

struct ImpedanceGains {
    Numbers stiffness;           // (6,) N/m and N m/rad, of the tip
    Numbers max_error;           // (6,) m and rad, to which the spring stretches
    Numbers posture_stiffness;   // (n,) N m/rad
    double damping_ratio = 0.0;  // 1 is critically damped
};

// tau = ID(q, v, a_ref) + J^T K e + D (v_ref - v) + posture
//
// Sources: Hogan, "Impedance control" (1985). D follows from stiffness and mass matrix by simultaneous diagonalization, so
// every mode has the same damping ratio: Albu-Schaeffer, Ott, Hirzinger, "A unified passivity-based control framework for
// position, torque and impedance control of flexible joint robots" (2007). The posture spring acts in the null space.
class Impedance final : public Cloneable<Impedance> {
public:
    Impedance(const Model& model, ImpedanceGains gains) : Cloneable(model->n()), gains_(std::move(gains)), task_(model, 6) {
        require_size(gains_.stiffness, 6, "stiffness");
        require_size(gains_.max_error, 6, "max_error");
        require_size(gains_.posture_stiffness, joints(), "posture_stiffness");
    }

    // Replaces the stiffness of the tip, (6,) N/m and N m/rad.
    void set_stiffness(Numbers stiffness) {
        require_size(stiffness, 6, "stiffness");
        gains_.stiffness = std::move(stiffness);
    }

    void torque(const State& state, const Setpoint& setpoint, Result tau) noexcept override {
        const Vector v_ref = setpoint.v_tick;
        const Vector a_ref = setpoint.a_tick;
        const Mat& J = task_.J;
        task_.measure(state.q, setpoint.q);
        find_posture_stiffness();
        for (size_t i = 0; i < tau.size(); ++i) {
            error_[i] = setpoint.q[i] - state.q[i];
            error_rate_[i] = v_ref[i] - state.v[i];
            feedback_[i] = 0.0;
        }
        Vector6 stretch{};
        for (size_t j = 0; j < 6; ++j) { stretch[j] = clipped(task_.error[j], gains_.max_error[j]); }
        const Diagonal stiffness{gains_.stiffness};
        Result(feedback_) += K_ * error_;
        Result(feedback_) += J.transposed() * stiffness * stretch;
        K_ += transposed(stiffness * J) * J;
        add_critical_damping();
        task_.dynamics.inverse_dynamics(state.q, state.v, a_ref, tau);
        task_.dynamics.add_linear_damping(error_rate_, tau);
        task_.dynamics.add_friction(v_ref, a_ref, tau);
        for (size_t i = 0; i < tau.size(); ++i) { tau[i] += feedback_[i]; }
    }

private:
    // K = N^T diag(springs) N with N = 1 - M^-1 J^T (J M^-1 J^T)^-1 J: the posture springs in the null space of the tip.
    void find_posture_stiffness() {
        inverse_ = task_.responses;
        for (size_t i = 0; i < joints(); ++i) { solve(task_.factors, inverse_.row(i)); }
        set_identity(null_space_);
        null_space_ -= inverse_ * task_.J;
        K_ = transposed(Diagonal{gains_.posture_stiffness} * null_space_) * null_space_;
    }

    // Adds 2 ratio L (L^-1 K L^-T)^1/2 L^T rate, with the Cholesky factor L of M: it damps every mode of M and K equally.
    void add_critical_damping() {
        const size_t n = joints();
        take_roots(task_.inertia);
        const Mat& L = task_.inertia;
        for (int side = 0; side < 2; ++side) {  // L^-1 K, then L^-1 K L^-T; K is symmetric
            for (size_t k = 0; k < n; ++k) { forward_substitute(L, K_.row(k)); }
            for (size_t k = 0; k < n; ++k) {
                for (size_t i = 0; i < k; ++i) { std::swap(K_(i, k), K_(k, i)); }
            }
        }
        for (size_t i = 0; i < n; ++i) {
            scaled_rate_[i] = 0.0;
            for (size_t k = i; k < n; ++k) { scaled_rate_[i] += L(k, i) * error_rate_[k]; }
        }
        diagonalize(K_, modes_);
        for (size_t m = 0; m < n; ++m) {
            const double amplitude = 2.0 * gains_.damping_ratio * std::sqrt(std::max(K_(m, m), 0.0)) * dot(modes_.column(m), scaled_rate_);
            for (size_t i = 0; i < n; ++i) {
                double total = 0.0;
                for (size_t k = 0; k <= i; ++k) { total += L(i, k) * modes_(k, m); }
                feedback_[i] += amplitude * total;
            }
        }
    }

    ImpedanceGains gains_;
    TaskSpace task_;
    Mat inverse_{joints(), 6};            // the dynamically consistent one of the Jacobian
    Mat null_space_{joints(), joints()};  // projection
    Mat K_{joints(), joints()};           // stiffness as seen by the joints, then that of the modes
    Mat modes_{joints(), joints()};
    Numbers error_ = zeros(), error_rate_ = zeros(), scaled_rate_ = zeros(), feedback_ = zeros();
};

}  // namespace armctl
