#include "computed_torque_learning.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "memory_parts.hpp"

namespace armctl {

namespace {

constexpr double friction_speed = 1e-3;  // rad/s (m/s), above which the friction that is fed forward does not depend on the speed

// The torque of model and payload at a joint.
double payload_torque(Vector needed, Matrix regressor, Vector estimate, size_t joint) {
    double torque = needed[joint];
    for (size_t k = 0; k < body_parameters; ++k) { torque += regressor(joint, k) * estimate[k]; }
    return torque;
}

}  // namespace

ComputedTorqueLearning::ComputedTorqueLearning(std::shared_ptr<const ArmModel> model, Gains gains, PayloadEstimator::Settings settings,
                                               double dt, bool continuous)
    : ComputedTorqueObserver(model, std::move(gains), dt, continuous, memory_size(model->n())),
      estimator_({
          .filter_weight = settings.filter_weight,
          .information_weight = settings.information_weight,
          .forgetting = settings.forgetting,
          .torque_precision = checked_gains(std::move(settings.torque_precision), model->n(), "torque_precision"),
          .prior_deviations = std::move(settings.prior_deviations),
      }),
      previous_estimate_(unknown_count(model->n())), unmodelled_(model->n()), rate_(model->n()), J_(6, model->n()) {}

size_t ComputedTorqueLearning::memory_size(size_t n) { return PayloadEstimator::Memory::size(n) + n * unknown_count(n) + 3 * n + 1; }

ComputedTorqueLearning::Memory ComputedTorqueLearning::memory_parts() {
    const size_t n = joints();
    MemoryParts parts(further_memory());
    return {
        .estimator = PayloadEstimator::Memory(parts.vector(PayloadEstimator::Memory::size(n)), n),
        .regressor = parts.matrix(n, unknown_count(n)),
        .fed_forward = parts.vector(n),
        .needed = parts.vector(n),
        .last_rate = parts.vector(n),
        .reference_moved = parts.number(),
    };
}

void ComputedTorqueLearning::torque(const State& state, const Setpoint& setpoint, Result tau) {
    Memory memory = memory_parts();
    const bool is_first = !has_begun();
    observe(state);
    if (!is_first) { learn(memory); }
    control(setpoint, tau);
    find_rates(setpoint, is_first, memory);
    feed_forward(setpoint.v_tick, memory);
    for (size_t i = 0; i < joints(); ++i) { known()[i] += memory.fed_forward[i]; }
    cancel(tau);
    add_known(tau);
}

// Updates the estimate. The observer's estimate changes by the opposite torque: the sum does not jump.
void ComputedTorqueLearning::learn(Memory& memory) {
    const Result estimate = memory.estimator.estimate;
    const MatrixResult Y = memory.regressor;
    std::ranges::copy(estimate, previous_estimate_.begin());
    for (size_t i = 0; i < joints(); ++i) { unmodelled_[i] = last_torque()[i] + memory.fed_forward[i] - needed()[i]; }
    estimator_.learn(Y, unmodelled_, memory.reference_moved != 0.0, memory.estimator);
    for (size_t i = 0; i < joints(); ++i) {
        for (size_t k = 0; k < Y.columns; ++k) { disturbance()[i] += Y(i, k) * (estimate[k] - previous_estimate_[k]); }
    }
}

// The torque of the reference with the present estimate, and how fast it changed since the last tick.
void ComputedTorqueLearning::find_rates(const Setpoint& setpoint, bool is_first, Memory& memory) {
    const Vector estimate = memory.estimator.estimate;
    for (size_t i = 0; i < joints(); ++i) { rate_[i] = -payload_torque(memory.needed, memory.regressor, estimate, i); }
    payload_regressor(dynamics(), setpoint.q, setpoint.v_tick, setpoint.a_tick, J_, memory.regressor);
    dynamics().inverse_dynamics(setpoint.q, setpoint.v_tick, setpoint.a_tick, memory.needed);
    for (size_t i = 0; i < joints(); ++i) {
        rate_[i] += payload_torque(memory.needed, memory.regressor, estimate, i);
        rate_[i] = is_first || period() == 0.0 ? 0.0 : rate_[i] / period();
    }
}

// Completes the regressor, and finds the torque that is fed forward.
void ComputedTorqueLearning::feed_forward(Vector v_ref, Memory& memory) const {
    const MatrixResult Y = memory.regressor;
    const Vector estimate = memory.estimator.estimate;
    bool moves = false;
    for (size_t i = 0; i < Y.rows; ++i) {
        Y(i, delay_unknown) = rate_[i];
        Y(i, first_friction_unknown + i) = v_ref[i] / (std::abs(v_ref[i]) + friction_speed);
        memory.fed_forward[i] = 0.0;
        for (size_t k = 0; k < Y.columns; ++k) { memory.fed_forward[i] += Y(i, k) * estimate[k]; }
        if (period() != 0.0) {  // what is fed forward against the delay is late, too
            Y(i, delay_unknown) += estimate[delay_unknown] * (rate_[i] - memory.last_rate[i]) / period();
        }
        memory.last_rate[i] = rate_[i];
        moves = moves || v_ref[i] != 0.0;
    }
    memory.reference_moved = moves ? 1.0 : 0.0;
}

}  // namespace armctl
