// PD and PID with gravity compensation: gravity from the model, everything else from feedback.
//
// Source: Takegaki, Arimoto, "A new feedback method for dynamic control of manipulators" (1981).
#pragma once
#include "../dynamics.hpp"
#include "pd.hpp"

namespace armctl {

// tau = g(q) + stiffness (q_ref - q) + damping (v_ref - v)
class PDGravity final : public Law {
public:
    PDGravity(std::shared_ptr<const ArmModel> model, PDGains gains);

    size_t joints() const override { return feedback_.joints(); }
    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

private:
    PD feedback_;
    Dynamics dynamics_;
    std::vector<double> gravity_;  // (n,) N m
};

struct PIDGains {
    PDGains feedback;
    std::vector<double> integral;      // (n,) N m/(rad s)
    std::vector<double> torque_limit;  // (n,) N m, at which a joint stops to integrate
};

// As PDGravity, plus the integral of integral (q_ref - q).
//
// Anti-windup by conditional integration (Astrom and Hagglund, Advanced PID Control, 2006, 3.5): a joint does not integrate
// while its motor is at its limit and the error has the same sign.
class PIDGravity final : public Law {
public:
    PIDGravity(std::shared_ptr<const ArmModel> model, PIDGains gains, double dt);

    size_t joints() const override { return feedback_.joints(); }
    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::span<double> memory() override { return integral_; }
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

private:
    PD feedback_;
    Dynamics dynamics_;
    std::vector<double> gain_per_tick_;  // (n,) N m/rad, integral gain x control period
    std::vector<double> torque_limit_;   // (n,) N m
    std::vector<double> gravity_;        // (n,) N m
    std::vector<double> integral_;       // (n,) N m
};

}  // namespace armctl
