// Computed torque within the limits of torque, velocity and position, by a quadratic program.
#pragma once
#include "../quadratic_program.hpp"
#include "computed_torque.hpp"

namespace armctl {

// As ComputedTorque while the desired acceleration respects all limits. Otherwise a minimizes the square of J (a - a_desired),
// subject to
//
//     -tau_max <= M a + h <= tau_max,    -v_max <= v + dt a <= v_max,    and the viability of q,
//
// in which rotations weigh less than translations, and the joints decide what the tip leaves open. If the limits contradict
// each other, the torque limits hold and the violation of the others is minimal. If that is impossible too, because other
// limits, which a_desired respects, contradict the torque limits, the torque of a_desired is clipped.
class ComputedTorqueQP final : public Law {
public:
    struct Gains {
        double stiffness = 0.0;             // 1/s^2
        double damping = 0.0;               // 1/s
        std::vector<double> added_inertia;  // (n,) kg m^2, as of ComputedTorque
    };

    // (n,) each.
    struct Limits {
        std::vector<double> q_min;    // rad
        std::vector<double> q_max;    // rad
        std::vector<double> v_max;    // rad/s
        std::vector<double> a_max;    // rad/s^2
        std::vector<double> tau_max;  // N m
    };

    // The program of a tick.
    struct Program {
        Matrix H;       // (n, n)
        Matrix M;       // (n, n) inertia of one control period: the torque of a deviation is M x
        Vector lower;   // (2n,) bounds of x and M x
        Vector upper;   // (2n,)
        Vector torque;  // (n,) N m, without limits
    };

    // The model is that of the control period dt. `length` is that of the arm, m, by which rotations of the tip and motions of
    // the joints are converted to distances.
    ComputedTorqueQP(std::shared_ptr<const ArmModel> model, Gains gains, Limits limits, double length, double dt, bool continuous);

    size_t joints() const override { return unlimited_.joints(); }
    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::span<double> memory() override { return unlimited_.memory(); }
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

    // The program of the last tick, if the torque was limited.
    std::optional<Program> last_program() const;

private:
    bool make_program(const State& state, const Setpoint& setpoint, Result tau);
    void add_acceleration_of_added_torque();
    void find_tip_offset(const State& state, const Setpoint& setpoint);
    Vec3 tip_law(Vector q, Vector v, Vector a);
    void set_metric();
    void follow_tip(double feedback, Result tau);
    bool find_bounds(const State& state, Vector tau);
    double stopping_speed(double distance, double v, double deceleration) const;
    void find_deviation();
    void relax_bounds();

    double stiffness_;
    double damping_;
    Limits limits_;
    double length_;
    double dt_;          // in continuous time, 0, there are only torque limits
    double mean_share_;  // of the present velocity in the mean one of the period: 0.5 if the arm moves continuously, else 0
    ComputedTorque unlimited_;
    Dynamics dynamics_;  // at the start of the control period
    ActiveSetSolver solver_;
    bool is_limited_ = false;

    // Scratch memory.
    std::vector<double> desired_;  // (n,) acceleration
    std::vector<double> offset_;   // (n,) J^T c: c is what the tip's acceleration lacks of its own feedback law
    std::vector<double> torque_;   // (n,) without limits
    DenseMatrix J_;                // (6, n)
    DenseMatrix H_;
    DenseMatrix M_;
    DenseMatrix factors_;
    std::vector<double> lower_;
    std::vector<double> upper_;
    // The program with costs in the place of bounds that contradict others.
    DenseMatrix relaxed_H_;
    std::vector<double> relaxed_cost_;
    std::vector<double> relaxed_lower_;
    std::vector<double> relaxed_upper_;
    std::vector<double> deviation_;  // (n,) from the desired acceleration
};

}  // namespace armctl
