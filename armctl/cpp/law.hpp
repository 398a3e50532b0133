// The interface of a control law: the torque of the motors from the measured state and the setpoint of a tick.
#pragma once
#include <cmath>
#include <memory>

#include "errors.hpp"
#include "linear_algebra.hpp"

namespace armctl {

// What is measured at a tick.
struct State {
    Vector q;       // (n,) rad
    Vector v;       // (n,) rad/s
    Vector wrench;  // (6,) N and N m, of the environment on the tip: force first, world axes, at the tip; empty if not measured
};

// Where the arm should be at a tick.
struct Setpoint {
    Vector q;       // (n,) rad
    Vector v;       // (n,) rad/s
    Vector a;       // (n,) rad/s^2
    Vector v_tick;  // (n,) rad/s, mean velocity over the coming control period
    Vector a_tick;  // (n,) rad/s^2, the change of v_tick over the control period
    // Rows of q, v_tick and a_tick from this tick on, (k, n), as far as they are known; none where they are not.
    Matrix q_ahead{};
    Matrix v_ahead{};
    Matrix a_ahead{};
};

// A control law. Its calls use memory and scratch of the object: one thread at a time, and one arm.
//
// A law is made from its model and a struct of its gains; InputError if these do not fit the arm.
class Law {
public:
    virtual ~Law() = default;

    size_t joints() const { return joints_; }

    // Whether `torque` reads the measured wrench.
    bool needs_wrench() const { return needs_wrench_; }

    // The torque for the coming control period, (n,) N m. It ends for any numbers, throws nothing and allocates nothing.
    virtual void torque(const State& state, const Setpoint& setpoint, Result tau) noexcept = 0;

    // Tells that the motors got torques (n,) N m that are not those of the last call of `torque`: limits of their rate, or a tick
    // that was lost.
    virtual void applied(Vector /*tau*/) noexcept {}

    // What the law keeps from tick to tick, such as integrals: 0 at the first tick of a run. Scratch is not part of it.
    Result memory() { return memory_; }
    size_t memory_size() const { return memory_.size(); }

    // Takes over the memory of a clone.
    virtual void set_memory(Vector numbers) { copy(numbers, memory_); }

    // Begins a new run.
    void reset() { std::ranges::fill(memory_, 0.0); }

    // The same law and gains with memory of its own, at the start of a run.
    [[nodiscard]] virtual std::unique_ptr<Law> clone() const = 0;

protected:
    explicit Law(size_t joints, size_t memory_size = 0, bool needs_wrench = false)
        : joints_(joints), needs_wrench_(needs_wrench), memory_(memory_size) {}

    Result memory(size_t first, size_t size) { return memory().subspan(first, size); }

    // A number for each joint.
    Numbers zeros() const { return Numbers(joints_); }

private:
    size_t joints_;
    bool needs_wrench_;
    Numbers memory_;
};

// A law whose clone is a copy at the start of a run. What laws share is a part of each, not a law above them.
template <class ConcreteLaw>
class Cloneable : public Law {  // NOLINT(bugprone-crtp-constructor-accessibility): laws have no default constructor
public:
    [[nodiscard]] std::unique_ptr<Law> clone() const override {
        auto copy = std::make_unique<ConcreteLaw>(static_cast<const ConcreteLaw&>(*this));
        copy->reset();
        return copy;
    }

protected:
    using Law::Law;
};

// A value within [-bound, bound]; a value that is not a number remains one.
inline double clipped(double value, double bound) { return std::min(std::max(value, -bound), bound); }

// The weight of a new sample in a low-pass of first order, of a rate in 1/s.
inline double low_pass_weight(double rate, double dt) { return -std::expm1(-rate * dt); }

}  // namespace armctl
