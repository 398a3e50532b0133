// Linear filters of the torques of another law: notches and low-passes.
#pragma once
#include "law_around.hpp"

namespace armctl {

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
    // `sections` has rows of b0, b1, b2, a0 = 1, a1, a2, as in SciPy.
    TorqueFilter(const std::shared_ptr<Law>& filtered, const Arguments& gains)
        : Cloneable(filtered, 2 * gains.length("sections") * filtered->joints()) {
        const size_t count = gains.length("sections");
        for (size_t k = 0; k < count; ++k) {
            const Vector row = gains.matrix(count, 6, "sections").row(k);
            sections_.push_back({.b0 = row[0], .b1 = row[1], .b2 = row[2], .a1 = row[4], .a2 = row[5]});
        }
    }

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

}  // namespace armctl
