// Computed torque: the model's inverse dynamics turn every joint into a unit mass, which a PD or PID law controls.
//
// Source: Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control (2009), 8.5.2.
#pragma once
#include "../dynamics.hpp"
#include "../law.hpp"

namespace armctl {

// tau = ID(q, v, a_ref + stiffness (q_ref - q) + damping (v_ref - v) + integral of the error)
class ComputedTorque final : public Law {
public:
    struct Gains {
        double stiffness = 0.0;             // 1/s^2
        double damping = 0.0;               // 1/s
        double integral = 0.0;              // 1/s^3; 0 without integral action
        std::vector<double> added_inertia;  // (n,) kg m^2, with which the feedback of joints of negligible inertia acts
        std::vector<double> torque_limit;   // (n,) N m, at which a joint stops to integrate
    };

    // Whether the law inverts the motion over one control period, with a reference that is differenced on the tick grid, or the
    // differential equation.
    enum class Form { discrete, textbook };

    // The model is that of the control period dt for the discrete form, and that of continuous time for the textbook form.
    ComputedTorque(std::shared_ptr<const ArmModel> model, Gains gains, Form form, double dt);

    size_t joints() const override { return added_inertia_.size(); }
    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::span<double> memory() override { return integral_; }
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

    // Of the last tick, (n,): the acceleration of the feedback without integral action, and the torque of the added inertia and
    // of the damping, which inverse dynamics does not contain.
    Vector correction() const { return correction_; }
    Vector added_torque() const { return added_torque_; }

private:
    void integrate(const State& state, const Setpoint& setpoint, Vector tau);

    double stiffness_;
    double damping_;
    double gain_per_tick_;  // 1/s^2, integral gain x control period
    std::vector<double> added_inertia_;
    std::vector<double> torque_limit_;
    Form form_;
    Dynamics dynamics_;

    std::vector<double> integral_;  // (n,) rad/s^2

    // Scratch memory, (n,) each.
    std::vector<double> correction_;
    std::vector<double> acceleration_;
    std::vector<double> error_rate_;
    std::vector<double> added_torque_;
};

}  // namespace armctl
