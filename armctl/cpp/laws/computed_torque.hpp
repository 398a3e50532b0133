// Computed torque: the model's inverse dynamics turn every joint into a unit mass, which a PD law controls.
//
// Source: Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control (2009), 8.5.2.
#pragma once
#include "../dense_matrix.hpp"
#include "../dynamics.hpp"
#include "../law.hpp"
#include "motion_estimate.hpp"

namespace armctl {

// tau = ID(q, v, a_ref + stiffness (q_ref - q) + damping (v_ref - v)), at measured or estimated q and v
class ComputedTorque final : public Law {
public:
    struct Gains {
        double stiffness = 0.0;             // 1/s^2
        double damping = 0.0;               // 1/s
        std::vector<double> added_inertia;  // (n,) kg m^2, with which the feedback of joints of negligible inertia acts
        EstimateWeights estimate;           // of position and velocity; 0 if they are the measured ones
        std::vector<double> torque_limit;   // (n,) N m, of the motors, for the estimate
    };

    // Whether the law inverts the motion over one control period, with a reference that is differenced on the tick grid, or the
    // differential equation.
    enum class Form { discrete, textbook };

    // The model is that of the control period dt for the discrete form, and that of continuous time for the textbook form.
    ComputedTorque(std::shared_ptr<const ArmModel> model, Gains gains, Form form, double dt, bool continuous);

    size_t joints() const override { return added_inertia_.size(); }
    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::span<double> memory() override { return memory_; }
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

    // Of the last tick, (n,): the acceleration of the feedback, and the torque of the added inertia and
    // of the damping, which inverse dynamics does not contain.
    Vector correction() const { return correction_; }
    Vector added_torque() const { return added_torque_; }

private:
    Result memory_vector(size_t k) { return std::span(memory_).subspan(1 + k * joints(), joints()); }
    State estimated(const State& state);
    void predict(Vector tau);

    double stiffness_;
    double damping_;
    std::vector<double> added_inertia_;
    EstimateWeights weights_;
    std::vector<double> torque_limit_;
    Form form_;
    double dt_;
    double position_step_;
    Dynamics dynamics_;

    std::vector<double> memory_;  // whether there was a tick, then the estimate; empty if positions are measured

    // Scratch memory, (n,) each.
    std::vector<double> correction_;
    std::vector<double> acceleration_;
    std::vector<double> error_rate_;
    std::vector<double> added_torque_;
    std::vector<double> further_acceleration_;
    DenseMatrix inertia_;
};

}  // namespace armctl
