// A user's own law: a compiled function of C.
#pragma once
#include <array>
#include <cstdint>

#include "../dense_matrix.hpp"
#include "../law.hpp"

namespace armctl {

// `reference` has the rows q, v, a, v_tick, a_tick of n numbers; `wrench` has 6 numbers, which are 0 if the law does not need
// it. The memory is 0 at the first tick of a run. The function writes `tau`. It may neither throw nor keep state elsewhere.
using LawFunction = void (*)(const double* parameters, const double* q, const double* v, const double* reference, const double* wrench,
                             double* memory, double* tau, std::int64_t n);

class CFunctionLaw final : public Law {
public:
    // Throws InputError if there is no function or no joint.
    CFunctionLaw(LawFunction function, size_t n, std::vector<double> parameters, size_t memory_size, bool needs_wrench);

    size_t joints() const override { return n_; }
    bool needs_wrench() const override { return needs_wrench_; }
    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::span<double> memory() override { return memory_; }
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

private:
    LawFunction function_;
    size_t n_;
    std::vector<double> parameters_;
    std::vector<double> memory_;
    bool needs_wrench_;
    DenseMatrix reference_;  // (5, n) scratch memory
};

}  // namespace armctl
