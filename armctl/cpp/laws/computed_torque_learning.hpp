// Computed torque with a disturbance observer, which learns payload, friction and delay, and feeds them forward.
#pragma once
#include "computed_torque_observer.hpp"
#include "payload_estimator.hpp"

namespace armctl {

// tau = computed torque with observer + Y(q_ref, v_ref, a_ref) theta + friction sign(v_ref) + T tau_ref'
//
// theta are the ten inertial parameters of a rigid body at the tip, friction is the dry friction of each joint that the model
// does not contain, T is the delay of the motors, and tau_ref' the rate of the torque that the reference needs.
class ComputedTorqueLearning final : public ComputedTorqueObserver {
public:
    ComputedTorqueLearning(std::shared_ptr<const ArmModel> model, Gains gains, PayloadEstimator::Settings settings, double dt,
                           bool continuous);

    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

    // (p,): the ten parameters of the payload, the delay, s, and the dry friction of the joints, N m.
    Result estimate() { return memory_parts().estimator.estimate; }

private:
    // Of the last tick, besides the estimator's memory. The regressor has the torques per unknown, (n, p).
    struct Memory {
        PayloadEstimator::Memory estimator;
        MatrixResult regressor;
        Result fed_forward;  // (n,) N m
        Result needed;       // (n,) N m, that the model needs for the reference
        Result last_rate;    // (n,) N m/s, of the torque that the reference needs
        double& reference_moved;
    };

    static size_t memory_size(size_t n);
    Memory memory_parts();
    void learn(Memory& memory);
    void find_rates(const Setpoint& setpoint, bool is_first, Memory& memory);
    void feed_forward(Vector v_ref, Memory& memory) const;

    PayloadEstimator estimator_;

    // Scratch memory.
    std::vector<double> previous_estimate_;  // (p,)
    std::vector<double> unmodelled_;         // (n,) N m
    std::vector<double> rate_;               // (n,) N m/s, of the torque that the reference needs
    DenseMatrix J_;                          // (6, n)
};

}  // namespace armctl
