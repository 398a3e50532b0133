// The interface of a control law: the torque of the motors from the measured state and the setpoint of a tick.
#pragma once
#include <algorithm>
#include <cstddef>
#include <memory>
#include <vector>

#include "spans.hpp"

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
};

// A setpoint from the (5, n) rows q, v, a, v_tick, a_tick.
inline Setpoint setpoint_of(Matrix reference) {
    return {reference.row(0), reference.row(1), reference.row(2), reference.row(3), reference.row(4)};
}

// A control law. Its calls use memory and scratch of the object: one thread at a time, and one arm.
class Law {
public:
    virtual ~Law() = default;

    // The number of joints.
    virtual size_t joints() const = 0;

    // Whether `torque` reads the measured wrench.
    virtual bool needs_wrench() const { return false; }

    // The torque for the coming control period, (n,) N m. It ends for any numbers, throws nothing and allocates nothing.
    virtual void torque(const State& state, const Setpoint& setpoint, Result tau) = 0;

    // What the law keeps from tick to tick, such as integrals: 0 at the first tick of a run. Scratch is not part of it.
    virtual std::span<double> memory() { return {}; }

    // Takes over the memory of a clone.
    virtual void set_memory(Vector numbers) { std::ranges::copy(numbers, memory().begin()); }

    // Begins a new run.
    void reset();

    // The same law and gains with memory of its own, at the start of a run.
    virtual std::unique_ptr<Law> clone() const = 0;
};

// The usual `Law::clone`: a copy of a law, at the start of a run.
template <class ConcreteLaw>
std::unique_ptr<Law> fresh_copy(const ConcreteLaw& law) {
    auto copy = std::make_unique<ConcreteLaw>(law);
    copy->reset();
    return copy;
}

// Checks of gains. They throw InputError with the name.

// A finite number of at least 0.
double checked_gain(double value, const char* name);

// Gains of n joints, finite and at least 0.
std::vector<double> checked_gains(std::vector<double> values, size_t n, const char* name);

// Limits of n joints, at least 0 or infinite.
std::vector<double> checked_limits(std::vector<double> values, size_t n, const char* name);

// A control period, s; 0 for continuous time.
double checked_period(double dt);

// A value within [-bound, bound]; a value that is not a number remains one.
inline double clipped(double value, double bound) { return std::min(std::max(value, -bound), bound); }

}  // namespace armctl
