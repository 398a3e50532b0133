// Linear quadratic regulator: state feedback on the errors of position and velocity and on the integral of position.
#pragma once
#include <limits>

#include "computed_torque.hpp"

namespace armctl {

// tau = ID(q, v, a_ref + G (e, e_dot, integral of e)), with the gains of the node whose configuration is nearest to the reference
//
// Inverse dynamics cancels what the linearized arm has of gravity and Coriolis torques, and G contains it again: so the torque is
// that of the linear quadratic regulator at the node, and elsewhere the accelerations of the feedback are the same.
class LQR final : public Cloneable<LQR, ComputedTorque> {
public:
    // `nodes` (k, n) are configurations, rad, and `feedback` (k, n, 3n) the gains there.
    LQR(const Model& model, const Arguments& gains)
        : Cloneable(model, gains, model->n()), nodes_(gains.length("nodes"), joints()), feedback_(nodes_.rows() * joints(), 3 * joints()) {
        nodes_.set(gains.matrix(nodes_.rows(), joints(), "nodes"));
        copy(gains.shaped({nodes_.rows(), joints(), 3 * joints()}, "feedback"), feedback_.numbers());
    }

    void torque(const State& state, const Setpoint& setpoint, Result tau) override {
        ComputedTorque::torque(state, setpoint, tau);
        // The integral waits while a motor is saturated, since the error is then not one of the model.
        for (size_t i = 0; i < joints(); ++i) {
            if (std::abs(tau[i]) > tau_max_[i]) { return; }
        }
        for (size_t i = 0; i < joints(); ++i) { further_memory()[i] += dt_ * growth_[i]; }
    }

private:
    // The memory holds the acceleration of the integral, so that it remains where the node changes.
    void correct(Vector q_ref) override {
        const size_t n = joints();
        const size_t first = nearest(q_ref) * n;
        for (size_t i = 0; i < n; ++i) {
            const Vector gains = feedback_.row(first + i);
            correction_[i] = dot(gains, error_, dot(gains.subspan(n), error_rate_, further_memory()[i]));
            growth_[i] = dot(gains.subspan(2 * n), error_);
        }
    }

    size_t nearest(Vector q_ref) const {
        size_t found = 0;
        double least = std::numeric_limits<double>::infinity();
        for (size_t k = 0; k < nodes_.rows(); ++k) {
            double square = 0.0;
            for (size_t i = 0; i < joints(); ++i) { square += (q_ref[i] - nodes_(k, i)) * (q_ref[i] - nodes_(k, i)); }
            if (square < least) {
                least = square;
                found = k;
            }
        }
        return found;
    }

    DenseMatrix nodes_;         // (k, n) rad
    DenseMatrix feedback_;      // (k n, 3n) 1/s^2, 1/s and 1/s^3
    Numbers growth_ = zeros();  // of the integral's acceleration, rad/s^3
};

}  // namespace armctl
