// Computed torque with a disturbance observer that estimates velocities.
#pragma once
#include "../dynamics.hpp"
#include "motion_estimate.hpp"

namespace armctl {

struct ComputedTorqueObserverGains {
    double stiffness = 0.0;           // 1/s^2
    double damping = 0.0;             // 1/s
    double disturbance_weight = 0.0;  // of the disturbance's low-pass in one control period
    Numbers torque_limit;             // (n,) N m, of the motors
    EstimateGains estimate;
};

// tau = ID(q, v, a_ref + stiffness (q_ref - q) + damping (v_ref - v)) - d at estimated q and v, with the estimated disturbance d.
//
// The model is that of the control period dt, and of continuous motion or of steps of MuJoCo.
//
// The steps of a tick, as a part of laws: `observe`, `control` and `cancel`, each with the memory of the law.
class DisturbanceObserver {
public:
    // The memory of a law in its parts.
    struct Memory {
        Memory(Result memory, size_t n)
            : motion(memory, n), disturbance(memory.subspan(MotionEstimate::memory_size(n), n)),
              last_torque(memory.subspan(MotionEstimate::memory_size(n) + n, n)), further(memory.subspan(memory_size(n))) {}

        MotionEstimate motion;
        Result disturbance;  // (n,) N m, estimated
        Result last_torque;  // (n,) N m, of the observer's model
        Result further;      // numbers of the law
    };

    static size_t memory_size(size_t n) { return MotionEstimate::memory_size(n) + 2 * n; }

    DisturbanceObserver(const Model& model, ComputedTorqueObserverGains gains)
        : dynamics(model), needed(model->n()), known(needed), gains_(std::move(gains)), last_position_(needed), last_velocity_(needed),
          corrected_velocity_(needed), lost_(needed) {
        require_size(gains_.torque_limit, model->n(), "torque_limit");
    }

    const ComputedTorqueObserverGains& gains() const { return gains_; }

    // Estimates position, velocity and disturbance, and finds the torque that the motion since the last tick needs.
    void observe(const State& state, Memory& memory) {
        MotionEstimate& motion = memory.motion;
        const bool is_first = !motion.has_begun();
        copy(motion.position, last_position_);
        copy(motion.velocity, last_velocity_);
        motion.update(state, gains_.estimate);
        if (is_first) { return; }
        dynamics.inverse_dynamics(last_position_, last_velocity_, motion.acceleration, needed);
        for (size_t i = 0; i < needed.size(); ++i) {
            memory.disturbance[i] += gains_.disturbance_weight * (needed[i] - memory.last_torque[i] - memory.disturbance[i]);
        }
    }

    // The torque of model and feedback at the estimated motion. Dry friction becomes the known torque.
    void control(const Setpoint& setpoint, Memory& memory, Result tau) {
        const MotionEstimate& motion = memory.motion;
        const Vector v_ref = setpoint.v_tick;
        const Vector a_ref = setpoint.a_tick;
        const double bandwidth = std::sqrt(gains_.stiffness);
        for (size_t i = 0; i < tau.size(); ++i) {
            const double error = setpoint.q[i] - motion.position[i];
            motion.acceleration[i] = a_ref[i] + gains_.stiffness * error + gains_.damping * (v_ref[i] - motion.velocity[i]);
            corrected_velocity_[i] = v_ref[i] + bandwidth * error - motion.velocity[i];
            known[i] = 0.0;
        }
        dynamics.inverse_dynamics(motion.position, motion.velocity, motion.acceleration, tau);
        // Damping is compensated at the velocity v_ref + bandwidth x error: the arm's own damping then helps the feedback, and the
        // error of a joint that hardly anything but damping resists decays as fast as those of the others. Compensated at the
        // estimated velocity, which is late, large damping would be a large positive feedback.
        dynamics.add_linear_damping(corrected_velocity_, tau);
        dynamics.add_friction(v_ref, a_ref, known);
    }

    // Subtracts the estimated disturbance from the torque, and adds what is known.
    void cancel(Memory& memory, Result tau) {
        bool is_clipped = false;
        for (size_t i = 0; i < tau.size(); ++i) {
            const double tau_max = gains_.torque_limit[i];
            tau[i] -= memory.disturbance[i];
            memory.last_torque[i] = clipped(tau[i] + known[i], tau_max) - known[i];
            lost_[i] = memory.last_torque[i] - tau[i];
            tau[i] += known[i];
            is_clipped = is_clipped || std::abs(tau[i]) > tau_max;
        }
        if (is_clipped) { take_lost(memory); }
    }

    // Takes the torque that the motors got instead of the last one.
    void take_applied(Vector tau, Memory& memory) {
        for (size_t i = 0; i < tau.size(); ++i) {
            const double applied = tau[i] - known[i];
            lost_[i] = applied - memory.last_torque[i];
            memory.last_torque[i] = applied;
        }
        take_lost(memory);
    }

    Dynamics dynamics;
    Numbers needed;  // N m, that the model needs for the motion since the last tick
    Numbers known;   // N m, that is known besides the observer's model, such as dry friction

private:
    // What is cut off is no disturbance: the motion is expected without it.
    void take_lost(Memory& memory) {
        dynamics.accelerate(lost_);
        for (size_t i = 0; i < lost_.size(); ++i) { memory.motion.acceleration[i] += lost_[i]; }
    }

    ComputedTorqueObserverGains gains_;
    Numbers last_position_, last_velocity_, corrected_velocity_;
    Numbers lost_;  // torque that the motors cut off
};

class ComputedTorqueObserver final : public Cloneable<ComputedTorqueObserver> {
public:
    ComputedTorqueObserver(const Model& model, ComputedTorqueObserverGains gains)
        : Cloneable(model->n(), DisturbanceObserver::memory_size(model->n())), observer_(model, std::move(gains)) {}

    void torque(const State& state, const Setpoint& setpoint, Result tau) noexcept override {
        DisturbanceObserver::Memory parts(memory(), joints());
        observer_.observe(state, parts);
        observer_.control(setpoint, parts, tau);
        observer_.cancel(parts, tau);
    }

    void applied(Vector tau) noexcept override {
        DisturbanceObserver::Memory parts(memory(), joints());
        observer_.take_applied(tau, parts);
    }

    // The estimated disturbance, (n,) N m.
    Result disturbance() { return DisturbanceObserver::Memory(memory(), joints()).disturbance; }

private:
    DisturbanceObserver observer_;
};

}  // namespace armctl
