// Computed torque with a disturbance observer that estimates velocities.
#pragma once
#include "estimated_motion.hpp"

namespace armctl {

// tau = ID(q, v, a_ref + stiffness (q_ref - q) + damping (v_ref - v)) - d at estimated q and v, with the estimated disturbance d.
//
// The model is that of the control period dt, and of continuous motion or of steps of MuJoCo.
class ComputedTorqueObserver : public Cloneable<ComputedTorqueObserver, EstimatedMotion> {
public:
    // `own_memory` are further numbers for a derived law.
    ComputedTorqueObserver(const Model& model, const Arguments& gains, size_t own_memory = 0)
        : Cloneable(model, gains, true, 2 * model->n() + own_memory), disturbance_weight_(gains.number("disturbance_weight")) {}

    void torque(const State& state, const Setpoint& setpoint, Result tau) override {
        observe(state);
        control(setpoint, tau);
        cancel(tau);
    }

    // The estimated disturbance, (n,) N m.
    Result disturbance() { return further_memory().first(joints()); }

protected:
    // The steps of a tick, in this order.

    // Estimates position, velocity and disturbance, and finds the torque that the motion since the last tick needs.
    void observe(const State& state) {
        const bool is_first = !has_begun();
        copy(position(), last_position_);
        copy(velocity(), last_velocity_);
        estimate(state);
        if (is_first) { return; }
        dynamics_.inverse_dynamics(last_position_, last_velocity_, acceleration(), needed_);
        for (size_t i = 0; i < joints(); ++i) {
            disturbance()[i] += disturbance_weight_ * (needed_[i] - last_torque()[i] - disturbance()[i]);
        }
    }

    // The torque of model and feedback at the estimated motion. Dry friction becomes the known torque.
    void control(const Setpoint& setpoint, Result tau) {
        const Vector v_ref = setpoint.v_tick;
        const Vector a_ref = setpoint.a_tick;
        const double bandwidth = std::sqrt(stiffness_);
        for (size_t i = 0; i < joints(); ++i) {
            const double error = setpoint.q[i] - position()[i];
            acceleration()[i] = a_ref[i] + stiffness_ * error + damping_ * (v_ref[i] - velocity()[i]);
            corrected_velocity_[i] = v_ref[i] + bandwidth * error - velocity()[i];
            known_[i] = 0.0;
        }
        dynamics_.inverse_dynamics(position(), velocity(), acceleration(), tau);
        // Damping is compensated at the velocity v_ref + bandwidth x error: the arm's own damping then helps the feedback, and the
        // error of a joint that hardly anything but damping resists decays as fast as those of the others. Compensated at the
        // estimated velocity, which is late, large damping would be a large positive feedback.
        dynamics_.add_linear_damping(corrected_velocity_, tau);
        dynamics_.add_friction(v_ref, a_ref, known_);
    }

    // Subtracts the estimated disturbance from the torque, and adds what is known.
    void cancel(Result tau) {
        bool is_clipped = false;
        for (size_t i = 0; i < joints(); ++i) {
            tau[i] -= disturbance()[i];
            last_torque()[i] = clipped(tau[i] + known_[i], tau_max_[i]) - known_[i];
            lost_[i] = last_torque()[i] - tau[i];
            tau[i] += known_[i];
            is_clipped = is_clipped || std::abs(tau[i]) > tau_max_[i];
        }
        if (!is_clipped) { return; }
        // What the motors cut off is no disturbance.
        dynamics_.accelerate(lost_);
        for (size_t i = 0; i < joints(); ++i) { acceleration()[i] += lost_[i]; }
    }

    Result last_torque() { return further_memory().subspan(joints(), joints()); }  // N m, of the observer's model
    Result own_memory() { return further_memory().subspan(2 * joints()); }

    Numbers needed_ = zeros();  // N m, that the model needs for the motion since the last tick
    Numbers known_ = zeros();   // N m, that is known besides the observer's model, such as dry friction

private:
    double disturbance_weight_;  // of the disturbance's low-pass in one control period
    Numbers last_position_ = zeros(), last_velocity_ = zeros(), corrected_velocity_ = zeros();
    Numbers lost_ = zeros();  // torque that the motors cut off
};

}  // namespace armctl
