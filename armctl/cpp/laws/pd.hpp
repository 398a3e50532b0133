// PD laws: a spring and a damper at every joint, with or without a model.
#pragma once
#include "../dynamics.hpp"
#include "../law.hpp"

namespace armctl {

struct PDGains {
    Numbers stiffness;  // (n,) N m/rad
    Numbers damping;    // (n,) N m s/rad

    double torque(size_t i, const State& state, double q_ref, double v_ref) const {
        return stiffness[i] * (q_ref - state.q[i]) + damping[i] * (v_ref - state.v[i]);
    }

    void check(size_t n) const {
        require_size(stiffness, n, "stiffness");
        require_size(damping, n, "damping");
    }
};

// tau = stiffness (q_ref - q) + damping (v_ref - v)
class PD final : public Cloneable<PD> {
public:
    explicit PD(PDGains gains) : Cloneable(gains.stiffness.size()), gains_(std::move(gains)) { gains_.check(joints()); }

    void torque(const State& state, const Setpoint& setpoint, Result tau) noexcept override {
        for (size_t i = 0; i < tau.size(); ++i) { tau[i] = gains_.torque(i, state, setpoint.q[i], setpoint.v[i]); }
    }

private:
    PDGains gains_;
};

// tau = ID(q_ref, v_ref, a_ref) + stiffness (q_ref - q) + damping (v_ref - v)
class PDFeedforward final : public Cloneable<PDFeedforward> {
public:
    PDFeedforward(const Model& model, PDGains gains) : Cloneable(model->n()), gains_(std::move(gains)), dynamics_(model) {
        gains_.check(joints());
    }

    void torque(const State& state, const Setpoint& setpoint, Result tau) noexcept override {
        dynamics_.inverse_dynamics(setpoint.q, setpoint.v_tick, setpoint.a_tick, tau);
        dynamics_.add_friction(setpoint.v_tick, setpoint.a_tick, tau);
        for (size_t i = 0; i < tau.size(); ++i) { tau[i] += gains_.torque(i, state, setpoint.q[i], setpoint.v_tick[i]); }
    }

private:
    PDGains gains_;
    Dynamics dynamics_;
};

// tau = g(q) + stiffness (q_ref - q) + damping (v_ref - v)
//
// Source: Takegaki, Arimoto, "A new feedback method for dynamic control of manipulators" (1981).
class PDGravity final : public Cloneable<PDGravity> {
public:
    PDGravity(const Model& model, PDGains gains) : Cloneable(model->n()), gains_(std::move(gains)), dynamics_(model) {
        gains_.check(joints());
    }

    void torque(const State& state, const Setpoint& setpoint, Result tau) noexcept override {
        dynamics_.gravity(state.q, tau);
        for (size_t i = 0; i < tau.size(); ++i) { tau[i] += gains_.torque(i, state, setpoint.q[i], setpoint.v[i]); }
    }

private:
    PDGains gains_;
    Dynamics dynamics_;
};

}  // namespace armctl
