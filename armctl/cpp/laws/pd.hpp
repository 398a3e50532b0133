// PD laws: a spring and a damper at every joint, with or without a model.
#pragma once
#include "../dynamics.hpp"
#include "../law.hpp"

namespace armctl {

// tau = stiffness (q_ref - q) + damping (v_ref - v)
class PD : public Cloneable<PD> {
public:
    explicit PD(const Arguments& gains) : PD(gains, gains.length("stiffness")) {}
    PD(const Arguments& gains, size_t n) : Cloneable(n), stiffness_(gains.numbers(n, "stiffness")), damping_(gains.numbers(n, "damping")) {}

    void torque(const State& state, const Setpoint& setpoint, Result tau) override {
        for (size_t i = 0; i < tau.size(); ++i) { tau[i] = feedback(i, state, setpoint.q[i], setpoint.v[i]); }
    }

protected:
    double feedback(size_t i, const State& state, double q_ref, double v_ref) const {
        return stiffness_[i] * (q_ref - state.q[i]) + damping_[i] * (v_ref - state.v[i]);
    }

private:
    Numbers stiffness_;  // (n,) N m/rad
    Numbers damping_;    // (n,) N m s/rad
};

// tau = ID(q_ref, v_ref, a_ref) + stiffness (q_ref - q) + damping (v_ref - v)
class PDFeedforward final : public Cloneable<PDFeedforward, PD> {
public:
    PDFeedforward(const Model& model, const Arguments& gains) : Cloneable(gains, model->n()), dynamics_(model) {}

    void torque(const State& state, const Setpoint& setpoint, Result tau) override {
        dynamics_.inverse_dynamics(setpoint.q, setpoint.v_tick, setpoint.a_tick, tau);
        dynamics_.add_friction(setpoint.v_tick, setpoint.a_tick, tau);
        for (size_t i = 0; i < tau.size(); ++i) { tau[i] += feedback(i, state, setpoint.q[i], setpoint.v_tick[i]); }
    }

private:
    Dynamics dynamics_;
};

// tau = g(q) + stiffness (q_ref - q) + damping (v_ref - v)
//
// Source: Takegaki, Arimoto, "A new feedback method for dynamic control of manipulators" (1981).
class PDGravity final : public Cloneable<PDGravity, PD> {
public:
    PDGravity(const Model& model, const Arguments& gains) : Cloneable(gains, model->n()), dynamics_(model) {}

    void torque(const State& state, const Setpoint& setpoint, Result tau) override {
        dynamics_.gravity(state.q, tau);
        for (size_t i = 0; i < tau.size(); ++i) { tau[i] += feedback(i, state, setpoint.q[i], setpoint.v[i]); }
    }

private:
    Dynamics dynamics_;
};

}  // namespace armctl
