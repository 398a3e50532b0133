// Laws around another one, whose torques they change: linear filters, which are notches and low-passes, and limits of the rate.
#pragma once
#include <utility>

#include "../law.hpp"

namespace armctl {

// The inner law of another one. It is shared with its owner, who sees its memory. The memory of a law is one vector, so that of the
// outer law contains that of the inner one, which gets it in each tick.
class InnerLaw {
public:
    // Numbers of an outer law's memory: whether there was a tick, `own` ones of the outer law, and those of the inner one.
    static size_t memory_size(const Law& inner, size_t own) { return 1 + own + inner.memory_size(); }

    InnerLaw(std::shared_ptr<Law> law, size_t own) : law_(std::move(law)), own_(own) {}
    InnerLaw(const InnerLaw& other) : law_(other.law_->clone()), own_(other.own_) {}
    InnerLaw& operator=(const InnerLaw&) = delete;

    // The torque of the inner law, from the memory of the outer one. Returns whether this is the first tick of a run.
    [[nodiscard]] bool torque(const State& state, const Setpoint& setpoint, Result memory, Result tau) {
        const Result inner_memory = memory.subspan(1 + own_);
        copy(inner_memory, law_->memory());
        law_->torque(state, setpoint, tau);
        copy(law_->memory(), inner_memory);
        return std::exchange(memory[0], 1.0) == 0.0;
    }

    // Takes over its part of the memory of the outer law.
    void set_memory(Vector memory) { law_->set_memory(memory.subspan(1 + own_)); }

    // The numbers of the outer law in its memory.
    Result own(Result memory) const { return memory.subspan(1, own_); }

private:
    std::shared_ptr<Law> law_;
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
class TorqueFilter final : public Cloneable<TorqueFilter> {
public:
    TorqueFilter(const std::shared_ptr<Law>& filtered, std::vector<Biquad> sections)
        : Cloneable(filtered->joints(), InnerLaw::memory_size(*filtered, state_size(*filtered, sections)), filtered->needs_wrench()),
          inner_(filtered, state_size(*filtered, sections)), sections_(std::move(sections)) {}

    void torque(const State& state, const Setpoint& setpoint, Result tau) noexcept override {
        const bool is_first = inner_.torque(state, setpoint, memory(), tau);
        Result states = inner_.own(memory());
        for (const Biquad& section : sections_) {
            for (double& torque : tau) {
                const Result own = states.first(2);
                if (is_first) { section.settle(torque, own); }
                torque = section.output(torque, own);
                states = states.subspan(2);
            }
        }
    }

    void set_memory(Vector numbers) override {
        Law::set_memory(numbers);
        inner_.set_memory(numbers);
    }

private:
    // Two numbers for each section and joint.
    static size_t state_size(const Law& law, const std::vector<Biquad>& sections) { return 2 * sections.size() * law.joints(); }

    InnerLaw inner_;
    std::vector<Biquad> sections_;
};

// A limit of the rate of the torques, such as that of a robot's interface. The first torque of a run is not limited.
class TorqueRateLimit final : public Cloneable<TorqueRateLimit> {
public:
    // Of a rate (n,) N m/s, and a control period, s.
    TorqueRateLimit(const std::shared_ptr<Law>& limited, Numbers tau_rate_max, double dt)
        : Cloneable(limited->joints(), InnerLaw::memory_size(*limited, limited->joints()), limited->needs_wrench()),
          inner_(limited, limited->joints()), max_change_(std::move(tau_rate_max)) {
        require_size(max_change_, joints(), "tau_rate_max");
        for (double& change : max_change_) { change *= dt; }
    }

    void torque(const State& state, const Setpoint& setpoint, Result tau) noexcept override {
        const bool is_first = inner_.torque(state, setpoint, memory(), tau);
        const Result last = inner_.own(memory());
        for (size_t i = 0; i < tau.size(); ++i) {
            if (!is_first) { tau[i] = std::clamp(tau[i], last[i] - max_change_[i], last[i] + max_change_[i]); }
            last[i] = tau[i];
        }
    }

    void set_memory(Vector numbers) override {
        Law::set_memory(numbers);
        inner_.set_memory(numbers);
    }

private:
    InnerLaw inner_;
    Numbers max_change_;  // (n,) N m, in one control period
};

}  // namespace armctl
