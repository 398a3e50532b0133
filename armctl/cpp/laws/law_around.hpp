// A law around another one, whose torques it changes.
#pragma once
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
    // `own` numbers of memory come before those of the inner law.
    LawAround(std::shared_ptr<Law> inner, size_t own)
        : Law(inner->joints(), own + inner->memory().size(), inner->needs_wrench()), inner_(std::move(inner)), own_(own) {}
    LawAround(const LawAround& other) : Law(other), inner_(other.inner_->clone()), own_(other.own_) {}
    LawAround& operator=(const LawAround&) = delete;

    Result own_memory() { return memory(0, own_); }

    void inner_torque(const State& state, const Setpoint& setpoint, Result tau) {
        copy(inner_memory(), inner_->memory());
        inner_->torque(state, setpoint, tau);
        copy(inner_->memory(), inner_memory());
    }

private:
    Result inner_memory() { return memory().subspan(own_); }

    std::shared_ptr<Law> inner_;
    size_t own_;
};

}  // namespace armctl
