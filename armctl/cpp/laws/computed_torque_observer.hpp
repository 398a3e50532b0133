// Computed torque with a disturbance observer that estimates velocities.
#pragma once
#include "../dynamics.hpp"
#include "motion_estimate.hpp"

namespace armctl {

// tau = ID(q, v, a_ref + stiffness (q_ref - q) + damping (v_ref - v)) - d at estimated q and v, with the estimated disturbance d.
//
// The commanded acceleration predicts position and velocity, and the measured position corrects both. The model is that of the
// control period dt, and of continuous motion or of steps of MuJoCo.
class ComputedTorqueObserver : public Cloneable<ComputedTorqueObserver> {
public:
    ComputedTorqueObserver(const Model& model, const Arguments& gains) : ComputedTorqueObserver(model, gains, 0) {}

    void torque(const State& state, const Setpoint& setpoint, Result tau) override {
        observe(state);
        control(setpoint, tau);
        cancel(tau);
    }

    // The estimated disturbance, (n,) N m.
    Result disturbance() { return vector_of_memory(0); }

protected:
    // As above, with further numbers of memory for a derived law.
    ComputedTorqueObserver(const Model& model, const Arguments& gains, size_t further_memory)
        : Cloneable(model->n(), memory_size(model->n()) + further_memory), dynamics_(model), weights_(gains),
          stiffness_(gains.number("stiffness")), damping_(gains.number("damping")), disturbance_weight_(gains.number("disturbance_weight")),
          torque_limit_(gains.numbers(model->n(), "torque_limit")) {}

    // The steps of a tick, in this order.

    // Estimates position, velocity and disturbance, and finds the torque that the motion since the last tick needs. The
    // velocity is measured at the first tick only, because it is noisy where it is differenced from positions.
    void observe(const State& state) {
        if (!has_begun()) {
            motion().begin(state);
            return;
        }
        copy(motion().position, last_position_);
        copy(motion().velocity, last_velocity_);
        motion().correct(state.q, weights_);
        dynamics_.inverse_dynamics(last_position_, last_velocity_, motion().acceleration, needed_);
        for (size_t i = 0; i < joints(); ++i) {
            disturbance()[i] += disturbance_weight_ * (needed_[i] - last_torque()[i] - disturbance()[i]);
        }
    }

    // The torque of model and feedback at the estimated motion. Dry friction becomes the known torque.
    void control(const Setpoint& setpoint, Result tau) {
        const auto [position, velocity, acceleration] = motion();
        const Vector v_ref = setpoint.v_tick;
        const Vector a_ref = setpoint.a_tick;
        const double bandwidth = std::sqrt(stiffness_);
        for (size_t i = 0; i < joints(); ++i) {
            const double error = setpoint.q[i] - position[i];
            acceleration[i] = a_ref[i] + stiffness_ * error + damping_ * (v_ref[i] - velocity[i]);
            corrected_velocity_[i] = v_ref[i] + bandwidth * error - velocity[i];
            known_[i] = 0.0;
        }
        dynamics_.inverse_dynamics(position, velocity, acceleration, tau);
        // Damping is compensated at the velocity v_ref + bandwidth x error: the arm's own damping then helps the feedback, and the
        // error of a joint that hardly anything but damping resists decays as fast as those of the others. Compensated at the
        // estimated velocity, which is late, large damping would be a large positive feedback.
        dynamics_.add_linear_damping(corrected_velocity_, tau);
        dynamics_.add_friction(v_ref, a_ref, known_);
    }

    // Subtracts the estimated disturbance from the torque, and adds what is known.
    void cancel(Result tau) {
        bool is_clipped = false;
        memory()[0] = 1.0;
        for (size_t i = 0; i < joints(); ++i) {
            tau[i] -= disturbance()[i];
            last_torque()[i] = clipped(tau[i] + known_[i], torque_limit_[i]) - known_[i];
            lost_[i] = last_torque()[i] - tau[i];
            tau[i] += known_[i];
            is_clipped = is_clipped || std::abs(tau[i]) > torque_limit_[i];
        }
        if (!is_clipped) { return; }
        // What the motors cut off is no disturbance.
        dynamics_.mass_matrix(inertia_);
        dynamics_.add_step_inertia(inertia_);
        factorize(inertia_);
        solve(inertia_, lost_);
        for (size_t i = 0; i < joints(); ++i) { motion().acceleration[i] += lost_[i]; }
    }

    bool has_begun() { return memory()[0] != 0.0; }
    Result last_torque() { return vector_of_memory(1); }  // N m, of the observer's model
    Result further_memory() { return memory().subspan(memory_size(joints())); }

    Dynamics dynamics_;
    EstimateWeights weights_;
    Numbers needed_ = zeros();  // N m, that the model needs for the motion since the last tick
    Numbers known_ = zeros();   // N m, that is known besides the observer's model, such as dry friction

private:
    // Whether there was a tick, and five vectors.
    static size_t memory_size(size_t n) { return 1 + 5 * n; }
    Result vector_of_memory(size_t k) { return memory(1 + k * joints(), joints()); }
    // Estimated; after the tick, the acceleration is that which the motors then achieve.
    MotionEstimate motion() { return {vector_of_memory(2), vector_of_memory(3), vector_of_memory(4)}; }

    double stiffness_;           // 1/s^2
    double damping_;             // 1/s
    double disturbance_weight_;  // of the disturbance's low-pass in one control period
    Numbers torque_limit_;       // (n,) N m
    Numbers last_position_ = zeros(), last_velocity_ = zeros(), corrected_velocity_ = zeros();
    Numbers lost_ = zeros();  // torque that the motors cut off
    DenseMatrix inertia_{joints(), joints()};
};

}  // namespace armctl
