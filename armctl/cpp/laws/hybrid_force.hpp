// Hybrid force/motion control: forces along some axes of the tip, motion along the others.
#pragma once
#include "../law.hpp"
#include "force_axis.hpp"
#include "task_space.hpp"

namespace armctl {

// tau = ID(q, v, a_ref + posture + J# a_task) + J^T (A^T f - w)
//
// Source: Khatib, "A unified approach for motion and force control of robot manipulators: the operational space formulation"
// (1987). Along a force axis the tip approaches slowly until it measures a contact; `command_axis` then raises the force. Along
// all other axes the tip follows its reference, and the measured wrench w on them, such as friction on a surface, is
// compensated. Arms of less than six joints control the position of the tip, not its orientation.
class HybridForce final : public Law {
public:
    struct Axis {
        bool is_force = false;
        double target = 0.0;  // N or N m
    };
    using Axes = std::array<Axis, 6>;  // x, y, z, rx, ry, rz

    struct Gains {
        double bandwidth = 0.0;       // rad/s, of the tip's error along motion axes
        double damping_ratio = 0.0;   // 1 is critically damped
        bool in_tip_frame = false;    // whether the axes turn with the tip
        double approach_speed = 0.0;  // m/s; 0 for one that follows from target and effective mass
        double contact_force = 0.0;   // N; 0 for one that follows from the target
    };

    HybridForce(std::shared_ptr<const ArmModel> model, Gains gains, const Axes& axes, double dt);

    size_t joints() const override { return dynamics_.model().n(); }
    bool needs_wrench() const override { return true; }
    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::span<double> memory() override { return memory_; }
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

    // Replaces the force axes. A force axis that comes back later begins with an approach.
    void set_axes(const Axes& axes);

    // Whether every force axis with a target is in contact.
    bool in_contact();

private:
    using Vector6 = std::array<double, 6>;

    double& has_begun() { return memory_[0]; }
    AxisMemory axis(size_t k) { return AxisMemory(std::span(memory_).subspan(1 + AxisMemory::size * k, AxisMemory::size)); }
    Result filtered_wrench() { return std::span(memory_).subspan(1 + 6 * AxisMemory::size, 6); }
    Result velocity() { return std::span(memory_).subspan(1 + 6 * AxisMemory::size + 6, joints()); }  // filtered

    void filter_velocity(Vector v);
    void find_directions();
    void command_axes(Vector wrench);
    AxisTick axis_tick(size_t k, double trace);
    double contact_mobility(Vector direction, double trace) const;
    void find_task(Vector v_ref, Vector a_ref);
    void subtract_compensated_wrench(Vector measured, Vector6& wrench);
    double along(size_t k, Vector twist) const;
    Vector6 along_force_axes(double AxisCommand::* command) const;

    Gains gains_;
    Axes axes_;
    double dt_;
    Dynamics dynamics_;
    TaskSpace task_;

    std::vector<double> memory_;

    // Scratch memory.
    size_t rows_;             // of a twist that the arm controls
    DenseMatrix factors_;     // (rows, rows), of the tip's damped mobility
    DenseMatrix mobility_;    // (6, 6) of the tip
    DenseMatrix directions_;  // (6, 6) the unit twist of each axis in the world
    std::array<AxisCommand, 6> commands_;
    Vector6 motion_{};      // acceleration of the tip minus that of the posture
    Vector6 correction_{};  // velocity of the tip that corrects its errors
    std::vector<double> acceleration_;
    std::vector<double> v_friction_;
    std::vector<double> change_;
    std::vector<double> rate_;
};

}  // namespace armctl
