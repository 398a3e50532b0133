// Laws around another one, whose torques they change: linear filters, which are notches and low-passes, and limits of the rate.
#pragma once
#include <utility>

#include "../law.hpp"

namespace armctl {

// The inner law is shared with its owner, who sees its memory. The memory of a law is one vector, so it contains that of the
// inner law, which gets it in each tick.
class LawAround : public Law {
public:
    void set_memory(Vector numbers) override {
        Law::set_memory(numbers);
        inner_->set_memory(inner_memory());
    }

protected:
    // `own` numbers of memory come before those of the inner law, after whether there was a tick.
    LawAround(std::shared_ptr<Law> inner, size_t own)
        : Law(inner->joints(), 1 + own + inner->memory().size(), inner->needs_wrench()), inner_(std::move(inner)), own_(own) {}
    LawAround(const LawAround& other) : Law(other), inner_(other.inner_->clone()), own_(other.own_) {}
    LawAround& operator=(const LawAround&) = delete;

    Result own_memory() { return memory(1, own_); }

    // Whether this is the first tick of a run.
    bool inner_torque(const State& state, const Setpoint& setpoint, Result tau) {
        copy(inner_memory(), inner_->memory());
        inner_->torque(state, setpoint, tau);
        copy(inner_->memory(), inner_memory());
        return std::exchange(memory()[0], 1.0) == 0.0;
    }

private:
    Result inner_memory() { return memory().subspan(1 + own_); }

    std::shared_ptr<Law> inner_;
    size_t own_;
};

// A second-order section in direct form II transposed: y = b0 x + s0, s0 = b1 x - a1 y + s1, s1 = b2 x - a2 y.
struct Biquad {
    double b0;
    double b1;
    double b2;
    double a1;
    double a2;

    // The output for the input x; s are the two numbers of its state.
    double output(double x, Result s) const {
        const double y = b0 * x + s[0];
        s[0] = b1 * x - a1 * y + s[1];
        s[1] = b2 * x - a2 * y;
        return y;
    }

    // The state in which a constant input x gives a constant output.
    void settle(double x, Result s) const {
        const double y = x * (b0 + b1 + b2) / (1.0 + a1 + a2);
        s[1] = b2 * x - a2 * y;
        s[0] = b1 * x - a1 * y + s[1];
    }
};

// Filters as biquads in series, the same for all joints. They begin a run settled at its first torque.
class TorqueFilter final : public Cloneable<TorqueFilter, LawAround> {
public:
    TorqueFilter(const std::shared_ptr<Law>& filtered, std::vector<Biquad> sections)
        : Cloneable(filtered, 2 * sections.size() * filtered->joints()), sections_(std::move(sections)) {}

    void torque(const State& state, const Setpoint& setpoint, Result tau) override {
        const bool is_first = inner_torque(state, setpoint, tau);
        Result states = own_memory();
        for (const Biquad& section : sections_) {
            for (double& torque : tau) {
                const Result own = states.first(2);
                if (is_first) { section.settle(torque, own); }
                torque = section.output(torque, own);
                states = states.subspan(2);
            }
        }
    }

private:
    std::vector<Biquad> sections_;
};

// A limit of the rate of the torques, such as that of a robot's interface. The first torque of a run is not limited.
class TorqueRateLimit final : public Cloneable<TorqueRateLimit, LawAround> {
public:
    // Of a rate (n,) N m/s, and a control period, s.
    TorqueRateLimit(const std::shared_ptr<Law>& limited, Numbers tau_rate_max, double dt)
        : Cloneable(limited, limited->joints()), max_change_(std::move(tau_rate_max)) {
        require_size(max_change_, joints(), "tau_rate_max");
        for (double& change : max_change_) { change *= dt; }
    }

    void torque(const State& state, const Setpoint& setpoint, Result tau) override {
        const bool is_first = inner_torque(state, setpoint, tau);
        const Result last = own_memory();
        for (size_t i = 0; i < tau.size(); ++i) {
            if (!is_first) { tau[i] = std::clamp(tau[i], last[i] - max_change_[i], last[i] + max_change_[i]); }
            last[i] = tau[i];
        }
    }

private:
    Numbers max_change_;  // (n,) N m, in one control period
};

}  // namespace armctl
