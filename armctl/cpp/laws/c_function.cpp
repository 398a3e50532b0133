#include "c_function.hpp"

#include <algorithm>
#include <utility>

#include "../errors.hpp"

namespace armctl {

CFunctionLaw::CFunctionLaw(LawFunction function, size_t n, std::vector<double> parameters, size_t memory_size, bool needs_wrench)
    : function_(function), n_(n), parameters_(std::move(parameters)), memory_(memory_size), needs_wrench_(needs_wrench), reference_(5, n) {
    if (function_ == nullptr) { throw InputError("address: need that of a function, got 0"); }
    if (n == 0) { throw InputError("n: need at least one joint"); }
}

void CFunctionLaw::torque(const State& state, const Setpoint& setpoint, Result tau) {
    const std::array<Vector, 5> rows{setpoint.q, setpoint.v, setpoint.a, setpoint.v_tick, setpoint.a_tick};
    for (size_t k = 0; k < rows.size(); ++k) { std::ranges::copy(rows[k], reference_.row(k).begin()); }
    std::array<double, 6> wrench{};
    if (needs_wrench_) { std::ranges::copy(state.wrench, wrench.begin()); }
    function_(parameters_.data(), state.q.data(), state.v.data(), reference_.numbers().data(), wrench.data(), memory_.data(), tau.data(),
              static_cast<std::int64_t>(n_));
}

}  // namespace armctl
