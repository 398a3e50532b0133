// Linear quadratic regulator: state feedback on the errors of position and velocity and on the integral of position.
#pragma once
#include <limits>

#include "computed_torque.hpp"

namespace armctl {

struct LQRGains {
    Mat nodes;             // (k, n) rad, configurations
    Mat feedback;          // (k n, 3n) 1/s^2, 1/s and 1/s^3, the n rows of each node one after the other
    Numbers torque_limit;  // (n,) N m, of the motors
    EstimateGains estimate;
};

// tau = ID(q, v, a_ref + G (e, e_dot, integral of e)), with the gains of the node whose configuration is nearest to the reference
//
// Inverse dynamics cancels what the linearized arm has of gravity and Coriolis torques, and G contains it again: so the torque is
// that of the linear quadratic regulator at the node, and elsewhere the accelerations of the feedback are the same.
class LQR final : public Cloneable<LQR> {
public:
    LQR(const Model& model, LQRGains gains)
        : Cloneable(model->n(), inverse_dynamics_gains(model->n(), gains).memory_size(model->n()) + model->n()),
          control_(model, inverse_dynamics_gains(model->n(), gains)), nodes_(std::move(gains.nodes)), feedback_(std::move(gains.feedback)) {
        const size_t n = joints();
        if (nodes_.rows() == 0 || nodes_.columns() != n || feedback_.rows() != nodes_.rows() * n || feedback_.columns() != 3 * n) {
            throw InputError("nodes, feedback: need configurations (k, n), and gains (k, n, 3n) there, with n = " + std::to_string(n));
        }
    }

    void torque(const State& measured, const Setpoint& setpoint, Result tau) noexcept override {
        const State state = control_.feed_back(measured, setpoint, memory());
        correct(setpoint.q);
        control_.torque(state, setpoint, memory(), tau);
        // The integral waits while a motor is saturated, since the error is then not one of the model.
        for (size_t i = 0; i < joints(); ++i) {
            if (std::abs(tau[i]) > control_.gains().torque_limit[i]) { return; }
        }
        for (size_t i = 0; i < joints(); ++i) { integral()[i] += control_.gains().estimate.dt * growth_[i]; }
    }

    void applied(Vector tau) noexcept override { control_.take_applied(tau, memory()); }

private:
    static ComputedTorqueGains inverse_dynamics_gains(size_t n, const LQRGains& gains) {
        return {.added_damping = Numbers(n), .torque_limit = gains.torque_limit, .estimate = gains.estimate};
    }

    // The acceleration of the integral, (n,), so that it remains where the node changes.
    Result integral() { return memory().last(joints()); }

    void correct(Vector q_ref) {
        const size_t n = joints();
        const size_t first = nearest(q_ref) * n;
        for (size_t i = 0; i < n; ++i) {
            const Vector gains = feedback_.row(first + i);
            control_.correction[i] = dot(gains, control_.error, dot(gains.subspan(n), control_.error_rate, integral()[i]));
            growth_[i] = dot(gains.subspan(2 * n), control_.error);
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

    InverseDynamicsControl control_;
    Mat nodes_;
    Mat feedback_;
    Numbers growth_ = zeros();  // of the integral's acceleration, rad/s^3
};

}  // namespace armctl
