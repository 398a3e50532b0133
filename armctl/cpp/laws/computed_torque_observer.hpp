// Computed torque with a disturbance observer that estimates velocities.
#pragma once
#include "../dense_matrix.hpp"
#include "../dynamics.hpp"
#include "../law.hpp"
#include "motion_estimate.hpp"

namespace armctl {

// tau = ID(q, v, a_ref + stiffness (q_ref - q) + damping (v_ref - v)) - d at estimated q and v, with the estimated disturbance
// d.
//
// The commanded acceleration predicts position and velocity, and the measured position corrects both.
class ComputedTorqueObserver : public Law {
public:
    struct Gains {
        double stiffness = 0.0;            // 1/s^2
        double damping = 0.0;              // 1/s
        EstimateWeights estimate;          // of position and velocity
        double disturbance_weight = 0.0;   // of the disturbance's low-pass in one control period
        std::vector<double> torque_limit;  // (n,) N m
    };

    // The model is that of the control period dt, and of continuous motion or of steps of MuJoCo.
    ComputedTorqueObserver(std::shared_ptr<const ArmModel> model, Gains gains, double dt, bool continuous);

    size_t joints() const override { return torque_limit_.size(); }
    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::span<double> memory() override { return memory_; }
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

    // The estimated disturbance, (n,) N m.
    Result disturbance() { return memory_vector(0); }

protected:
    // As above, with further numbers of memory for a derived law.
    ComputedTorqueObserver(std::shared_ptr<const ArmModel> model, Gains gains, double dt, bool continuous, size_t further_memory);

    // The steps of a tick, in this order.

    // Estimates position, velocity and disturbance, and finds the torque that the motion since the last tick needs. The
    // velocity is measured at the first tick only, because it is noisy where it is differenced from positions.
    void observe(const State& state);

    // The torque of model and feedback at the estimated motion. Dry friction becomes the known torque.
    void control(const Setpoint& setpoint, Result tau);

    // Subtracts the estimated disturbance from the torque, to which the caller then adds what is known.
    void cancel(Result tau);

    // Adds the torque that is known besides the observer's model, such as dry friction.
    void add_known(Result tau) const;

    bool has_begun() const { return memory_[0] != 0.0; }
    Result last_torque() { return memory_vector(1); }  // N m, of the observer's model
    Vector needed() const { return needed_; }          // N m, that the model needs for the motion since the last tick
    Result known() { return known_; }                  // N m
    Result further_memory() { return std::span(memory_).subspan(1 + memory_vectors * joints()); }
    Dynamics& dynamics() { return dynamics_; }
    double period() const { return dt_; }

private:
    static constexpr size_t memory_vectors = 5;

    Result memory_vector(size_t k) { return std::span(memory_).subspan(1 + k * joints(), joints()); }
    Result acceleration() { return memory_vector(4); }  // commanded; after the tick that which the motors then achieve
    MotionEstimate estimate() { return {memory_vector(2), memory_vector(3), acceleration()}; }
    void subtract_lost_acceleration();

    double stiffness_;
    double damping_;
    EstimateWeights weights_;
    double disturbance_weight_;
    std::vector<double> torque_limit_;
    double dt_;
    double position_step_;
    Dynamics dynamics_;

    std::vector<double> memory_;  // whether there was a tick, then the vectors above

    // Scratch memory.
    std::vector<double> known_;
    std::vector<double> needed_;
    std::vector<double> last_position_;
    std::vector<double> last_velocity_;
    std::vector<double> corrected_velocity_;
    std::vector<double> lost_;  // torque that the motors cut off
    DenseMatrix inertia_;
};

}  // namespace armctl
