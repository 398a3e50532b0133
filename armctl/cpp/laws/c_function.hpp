// A user's own law: a compiled function of C.
#pragma once
#include <array>

#include "../law.hpp"

namespace armctl {

// `reference` has the rows q, v, a, v_tick, a_tick of n numbers; `wrench` has 6 numbers, which are 0 if the law does not need
// it. The memory is 0 at the first tick of a run. The function writes `tau`. It may neither throw nor keep state elsewhere.
using LawFunction = void (*)(const double* parameters, const double* q, const double* v, const double* reference, const double* wrench,
                             double* memory, double* tau, std::int64_t n);

struct CFunctionOptions {
    size_t n = 0;  // joints
    Numbers parameters;
    size_t memory_size = 0;
    bool needs_wrench = false;
};

class CFunctionLaw final : public Cloneable<CFunctionLaw> {
public:
    // The function has to exist as long as the law.
    CFunctionLaw(LawFunction function, CFunctionOptions options)
        : Cloneable(options.n, options.memory_size, options.needs_wrench), function_(function), parameters_(std::move(options.parameters)) {
    }

    void torque(const State& state, const Setpoint& setpoint, Result tau) noexcept override {
        const std::array<Vector, 5> rows{setpoint.q, setpoint.v, setpoint.a, setpoint.v_tick, setpoint.a_tick};
        for (size_t k = 0; k < rows.size(); ++k) { copy(rows[k], reference_.row(k)); }
        std::array<double, 6> wrench{};
        if (needs_wrench()) { copy(state.wrench, wrench); }
        function_(parameters_.data(), state.q.data(), state.v.data(), reference_.numbers().data(), wrench.data(), memory().data(),
                  tau.data(), static_cast<std::int64_t>(joints()));
    }

private:
    LawFunction function_;
    Numbers parameters_;
    Mat reference_{5, joints()};
};

}  // namespace armctl
