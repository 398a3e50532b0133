// Hybrid force/motion control: forces along some axes of the tip, motion along the others.
#pragma once
#include "../errors.hpp"
#include "force_axis.hpp"
#include "task_space.hpp"

namespace armctl {

struct ForceAxes {
    std::array<bool, 6> is_force{};  // x, y, z, rx, ry, rz
    Vector6 targets{};               // N and N m
};

struct HybridForceGains {
    double bandwidth = 0.0;       // rad/s, of the tip's error along motion axes
    double damping_ratio = 0.0;   // 1 is critically damped
    bool in_tip_frame = false;    // whether the axes turn with the tip
    double approach_speed = 0.0;  // m/s; 0 for one that follows from target and effective mass
    double contact_force = 0.0;   // N; 0 for one that follows from the target
    double dt = 0.0;              // s, the control period
    ForceAxes axes;
};

// tau = ID(q, v, a_ref + posture + J# a_task) + J^T (A^T f - w)
//
// Source: Khatib, "A unified approach for motion and force control of robot manipulators: the operational space formulation"
// (1987). Along a force axis the tip approaches slowly until it measures a contact; a ForceAxis then raises the force. Along
// all other axes the tip follows its reference, and the measured wrench w on them, such as friction on a surface, is
// compensated. Arms of less than six joints control the position of the tip, not its orientation.
class HybridForce final : public Cloneable<HybridForce> {
public:
    HybridForce(const Model& model, const HybridForceGains& gains)
        : Cloneable(model->n(), 1 + 6 * ForceAxis::memory_size + 6 + model->n(), true), gains_(gains), task_(model, task_rows(model->n())) {
        set_axes(gains.axes);
    }

    // Replaces the force axes. One that comes back later begins with an approach.
    void set_axes(const ForceAxes& axes) {
        for (const double target : axes.targets) {
            if (!std::isfinite(target)) { throw InputError("target: need a finite number, got " + std::to_string(target)); }
        }
        gains_.axes = axes;
        force_axes_.clear();
        for (size_t k = 0; k < 6; ++k) {
            if (axes.is_force[k]) {
                force_axes_.push_back(k);
            } else {
                std::ranges::fill(axis_memory(k), 0.0);
            }
        }
    }

    // Whether every force axis with a target is in contact.
    bool in_contact() {
        return std::ranges::all_of(force_axes_,
                                   [this](size_t k) { return gains_.axes.targets[k] == 0.0 || ForceAxis(axis_memory(k)).touches != 0.0; });
    }

    void torque(const State& state, const Setpoint& setpoint, Result tau) noexcept override {
        const Vector v_ref = setpoint.v_tick;
        const Vector a_ref = setpoint.a_tick;
        filter_velocity(state.v);
        task_.measure(state.q, setpoint.q);
        find_directions();
        command_axes(state.wrench);
        const double posture_bandwidth = 0.5 * gains_.bandwidth;
        for (size_t i = 0; i < tau.size(); ++i) {
            posture_[i] = posture_bandwidth * posture_bandwidth * (setpoint.q[i] - state.q[i]);
            posture_[i] += 2.0 * posture_bandwidth * (v_ref[i] - velocity()[i]);
        }
        find_task(v_ref, a_ref);
        // Friction is compensated at the speed at which the tip is to correct its errors: at that of the reference, which may
        // stand still, the friction of the joints would hold the tip where it is.
        copy(v_ref, v_corrected_);
        task_.add_joint_motion(controlled(correction_), v_corrected_);
        copy(v_corrected_, v_friction_);
        Vector6 yielding = along_force_axes(&AxisCommand::yielding_speed);
        task_.add_joint_motion(controlled(yielding), v_friction_);
        const State filtered{.q = state.q, .v = velocity(), .wrench = {}};
        task_.torque(filtered, a_ref, controlled(motion_), posture_, v_corrected_, v_friction_, tau);
        Vector6 wrench = along_force_axes(&AxisCommand::force);
        subtract_compensated_wrench(state.wrench, wrench);
        tau += task_.J.transposed() * wrench;
    }

private:
    // rad/s; velocities that are differenced are ten times less noisy after it.
    static constexpr double velocity_filter = 100.0;
    // rad/s. The wrench on motion axes is compensated; faster, it would resonate on a wall.
    static constexpr double wrench_filter = 40.0;
    // Of the measured forces on motion axes. Where a tip sticks, friction is a strong damper. Compensated completely but late, it
    // would act like a mass, and the tip would swing slowly along the surface.
    static constexpr double compensated_share = 0.8;
    static constexpr double contact_ratio = 0.1;  // of the target, the default contact threshold
    // 1/s. A mass m that meets a wall of damping rate b at speed v exerts the force m b v at once. For MuJoCo's contacts b is
    // 2 / solref[0], 100 /s by default and 330 /s for one ten times stiffer.
    static constexpr double wall_damping_rate = 330.0;
    static constexpr double impact_ratio = 0.7;         // of the target, the force of such an impact
    static constexpr double min_impact_ratio = 0.1;     // where dry friction is larger
    static constexpr double max_approach_speed = 0.05;  // m/s

    // The memory: whether there was a tick, the axes, the filtered wrench, and the filtered velocity.
    Result axis_memory(size_t k) { return memory(1 + ForceAxis::memory_size * k, ForceAxis::memory_size); }
    Result filtered_wrench() { return memory(1 + 6 * ForceAxis::memory_size, 6); }
    Result velocity() { return memory(1 + 6 * ForceAxis::memory_size + 6, joints()); }

    // The rows of a twist that the arm controls.
    Result controlled(Vector6& twist) const { return Result(twist).first(task_.factors.rows()); }

    // Low-pass of the measured velocity, which begins with the first one of a run.
    void filter_velocity(Vector v) {
        if (memory()[0] == 0.0) { copy(v, velocity()); }
        memory()[0] = 1.0;
        for (size_t i = 0; i < v.size(); ++i) { velocity()[i] += low_pass_weight(velocity_filter, gains_.dt) * (v[i] - velocity()[i]); }
    }

    // The unit twists of the axes in the world, at the located joints.
    void find_directions() {
        const Rotation R = gains_.in_tip_frame ? task_.dynamics.tip().rotation : Rotation();
        for (size_t k = 0; k < 3; ++k) {
            const Vec3 axis = std::array{R.x, R.y, R.z}[k];
            directions_[k] = numbers({axis, {}});
            directions_[3 + k] = numbers({{}, axis});
        }
    }

    // The twist or wrench that has a command of the force axes along these, and nothing along the others.
    Vector6 along_force_axes(double AxisCommand::* command) const {
        Vector6 total{};
        for (const size_t k : force_axes_) {
            for (size_t j = 0; j < 6; ++j) { total[j] += directions_[k][j] * commands_[k].*command; }
        }
        return total;
    }

    void command_axes(Vector wrench) {
        Vector6 twist{};
        for (size_t k = 0; k < 6; ++k) { twist[k] = dot(task_.J.row(k), velocity()); }
        for (const size_t k : force_axes_) { commands_[k] = ForceAxis(axis_memory(k)).command(axis_tick(k, wrench, twist)); }
    }

    AxisTick axis_tick(size_t k, Vector wrench, const Vector6& twist) const {
        // The motion of the joints at unit speed along the axis, and its inertia.
        Vector6 direction = directions_[k];
        const Result unit = controlled(direction);
        solve(task_.factors, unit);
        double mass = 0.0;
        double dry_friction = 0.0;
        for (size_t i = 0; i < joints(); ++i) {
            const double rate = dot(task_.responses.row(i), unit);
            for (size_t j = 0; j < unit.size(); ++j) { mass += unit[j] * task_.J(j, i) * rate; }
            dry_friction += std::abs(rate) * task_.dynamics.model().drives[i].friction.loss;
        }
        const double target = std::abs(gains_.axes.targets[k]);
        double approach_speed = gains_.approach_speed;
        if (approach_speed == 0.0) {
            // When the tip stops, the wall bears the force that moved the joints against their dry friction.
            const double impact = std::max(impact_ratio * target - dry_friction, min_impact_ratio * target);
            approach_speed = std::min(max_approach_speed, impact / (wall_damping_rate * mass));
        }
        return {
            .target = gains_.axes.targets[k],
            .measured = -dot(directions_[k], wrench),  // the tip exerts the opposite of the wrench on it
            .speed = dot(directions_[k], twist),
            .mass = mass,
            .approach_speed = approach_speed,
            .threshold = gains_.contact_force > 0.0 ? gains_.contact_force : contact_ratio * target,
            .dt = gains_.dt,
        };
    }

    // The acceleration of the tip, and the velocity that corrects its errors.
    void find_task(Vector v_ref, Vector a_ref) {
        Vector6 feedforward{};
        for (size_t k = 0; k < 6; ++k) {
            const double rate = task_.error_rate(k, v_ref, velocity());
            feedforward[k] = dot(task_.J.row(k), a_ref);
            motion_[k] = gains_.bandwidth * gains_.bandwidth * task_.error[k] + 2.0 * gains_.damping_ratio * gains_.bandwidth * rate;
            correction_[k] = 0.5 * gains_.bandwidth * task_.error[k];
        }
        for (const size_t k : force_axes_) {  // they are orthogonal, so one after the other can be replaced
            const double missing = commands_[k].acceleration - dot(directions_[k], motion_) - dot(directions_[k], feedforward);
            const double missing_speed = commands_[k].speed - dot(directions_[k], correction_);
            for (size_t j = 0; j < 6; ++j) {
                motion_[j] += missing * directions_[k][j];
                correction_[j] += missing_speed * directions_[k][j];
            }
        }
    }

    // Subtracts the measured wrench on motion axes in contact: friction, and the moment of a contact beside the tip.
    void subtract_compensated_wrench(Vector measured, Vector6& wrench) {
        const Result filtered = filtered_wrench();
        const bool in_contact = this->in_contact();
        Vector6 compensated{};
        for (size_t j = 0; j < 6; ++j) {
            filtered[j] += low_pass_weight(wrench_filter, gains_.dt) * (measured[j] - filtered[j]);
            if (!in_contact) { filtered[j] = 0.0; }
            compensated[j] = filtered[j];
        }
        for (const size_t k : force_axes_) {
            const double part = dot(directions_[k], filtered);
            for (size_t j = 0; j < 6; ++j) { compensated[j] -= part * directions_[k][j]; }
        }
        for (size_t j = 0; j < task_.factors.rows(); ++j) { wrench[j] -= (j < 3 ? compensated_share : 1.0) * compensated[j]; }
    }

    HybridForceGains gains_;
    std::vector<size_t> force_axes_;  // 0 to 5 for x, y, z, rx, ry, rz
    TaskSpace task_;
    std::array<Vector6, 6> directions_{};  // the unit twist of each axis in the world
    std::array<AxisCommand, 6> commands_;
    Vector6 motion_{};                                      // acceleration of the tip
    Vector6 correction_{};                                  // velocity of the tip that corrects its errors
    Numbers posture_ = zeros();                             // acceleration
    Numbers v_corrected_ = zeros(), v_friction_ = zeros();  // velocities at which damping and friction are compensated
};

}  // namespace armctl
