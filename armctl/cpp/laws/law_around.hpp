// A law around another one, whose torques it changes.
#pragma once
#include "../law.hpp"

namespace armctl {

// The inner law is shared with its owner, who sees its memory. The memory of a law is one vector, so it contains that of the
// inner law, which gets it in each tick.
class LawAround : public Law {
public:
    size_t joints() const override { return inner_->joints(); }
    bool needs_wrench() const override { return inner_->needs_wrench(); }
    std::span<double> memory() override { return memory_; }
    void set_memory(Vector numbers) override {
        std::ranges::copy(numbers, memory_.begin());
        inner_->set_memory(inner_memory());
    }

protected:
    // `own` numbers of memory come before those of the inner law.
    LawAround(std::shared_ptr<Law> inner, size_t own) : inner_(std::move(inner)), own_(own), memory_(own + inner_->memory().size()) {}
    LawAround(const LawAround& other) : Law(other), inner_(other.inner_->clone()), own_(other.own_), memory_(other.memory_) {}
    LawAround& operator=(const LawAround&) = delete;

    Result own_memory() { return std::span(memory_).first(own_); }

    void inner_torque(const State& state, const Setpoint& setpoint, Result tau) {
        std::ranges::copy(inner_memory(), inner_->memory().begin());
        inner_->torque(state, setpoint, tau);
        std::ranges::copy(inner_->memory(), inner_memory().begin());
    }

private:
    Result inner_memory() { return std::span(memory_).subspan(own_); }

    std::shared_ptr<Law> inner_;
    size_t own_;
    std::vector<double> memory_;
};

}  // namespace armctl
