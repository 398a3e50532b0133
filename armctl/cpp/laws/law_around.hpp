// A law around another one, whose torques it changes.
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

}  // namespace armctl
