#include "hybrid_force.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "../errors.hpp"
#include "../factorization.hpp"

namespace armctl {

namespace {

constexpr double velocity_filter = 100.0;  // rad/s; velocities that are differenced are ten times less noisy after it
constexpr double wrench_filter = 40.0;     // rad/s. The wrench on motion axes is compensated; faster, it would resonate on a wall.
// Of the measured forces on motion axes. Where a tip sticks, friction is a strong damper. Compensated completely but late, it
// would act like a mass, and the tip would swing slowly along the surface.
constexpr double compensated_share = 0.8;
constexpr double contact_ratio = 0.1;  // of the target, the default contact threshold
// 1/s. A mass m that meets a wall of damping rate b at speed v exerts the force m b v at once. For MuJoCo's contacts b is
// 2 / solref[0], 100 /s by default and 330 /s for one ten times stiffer.
constexpr double wall_damping_rate = 330.0;
constexpr double impact_ratio = 0.7;         // of the target, the force of such an impact
constexpr double min_impact_ratio = 0.1;     // where dry friction is larger
constexpr double max_approach_speed = 0.05;  // m/s
constexpr double max_lever = 0.2;            // m; a hand may touch a wall this far from the tip, where its effective mass is larger
constexpr double min_mobility_ratio = 0.1;   // of the mobility of the tip, a lower bound for that of another point

HybridForce::Axes checked(const HybridForce::Axes& axes) {
    for (const HybridForce::Axis& axis : axes) {
        if (!std::isfinite(axis.target)) { throw InputError("target: need a finite number, got " + std::to_string(axis.target)); }
    }
    return axes;
}

}  // namespace

HybridForce::HybridForce(std::shared_ptr<const ArmModel> model, Gains gains, const Axes& axes, double dt)
    : gains_(gains), axes_(checked(axes)), dt_(checked_period(dt)), dynamics_(model), task_(model->n()),
      memory_(1 + 6 * AxisMemory::size + 6 + model->n()), rows_(task_rows(model->n())), factors_(rows_, rows_), mobility_(6, 6),
      directions_(6, 6), acceleration_(model->n()), v_friction_(model->n()), change_(model->n()), rate_(model->n()) {
    checked_gain(gains.bandwidth, "bandwidth");
    checked_gain(gains.damping_ratio, "damping_ratio");
    checked_gain(gains.approach_speed, "approach_speed");
    checked_gain(gains.contact_force, "contact_force");
}

void HybridForce::set_axes(const Axes& axes) {
    axes_ = checked(axes);
    for (size_t k = 0; k < 6; ++k) {
        if (!axes_[k].is_force) { std::ranges::fill(std::span(memory_).subspan(1 + AxisMemory::size * k, AxisMemory::size), 0.0); }
    }
}

bool HybridForce::in_contact() {
    bool all = true;
    for (size_t k = 0; k < 6; ++k) {
        const bool is_pressing = axes_[k].is_force && axes_[k].target != 0.0;
        all = all && !(is_pressing && axis(k).touches == 0.0);
    }
    return all;
}

void HybridForce::torque(const State& state, const Setpoint& setpoint, Result tau) {
    const size_t n = tau.size();
    const Vector v_ref = setpoint.v_tick;
    const Vector a_ref = setpoint.a_tick;
    filter_velocity(state.v);
    task_.measure_tip(dynamics_, state.q, setpoint.q);
    find_directions();
    task_.find_responses(dynamics_);
    task_.factorize_mobility(factors_);
    command_axes(state.wrench);

    const double posture_bandwidth = 0.5 * gains_.bandwidth;
    for (size_t i = 0; i < n; ++i) {
        acceleration_[i] = posture_bandwidth * posture_bandwidth * (setpoint.q[i] - state.q[i]);
        acceleration_[i] += 2.0 * posture_bandwidth * (v_ref[i] - velocity()[i]);
        change_[i] = 0.0;
    }
    find_task(v_ref, a_ref);
    task_.add_joint_motion(factors_, Result(motion_).first(rows_), acceleration_);
    // Friction is compensated at the speed at which the tip is to correct its errors: at that of the reference, which may stand
    // still, the friction of the joints would hold the tip where it is.
    task_.add_joint_motion(factors_, Result(correction_).first(rows_), change_);
    for (size_t i = 0; i < n; ++i) {
        acceleration_[i] += a_ref[i];
        v_friction_[i] = v_ref[i] + change_[i];
        rate_[i] = v_friction_[i] - velocity()[i];
    }
    dynamics_.inverse_dynamics(state.q, state.v, acceleration_, tau);
    dynamics_.add_linear_damping(rate_, tau);
    Vector6 yielding = along_force_axes(&AxisCommand::yielding_speed);
    task_.add_joint_motion(factors_, Result(yielding).first(rows_), v_friction_);
    dynamics_.add_friction(v_friction_, a_ref, tau);
    Vector6 wrench = along_force_axes(&AxisCommand::force);
    subtract_compensated_wrench(state.wrench, wrench);
    for (size_t i = 0; i < n; ++i) {
        for (size_t k = 0; k < 6; ++k) { tau[i] += task_.J()(k, i) * wrench[k]; }
    }
}

// Low-pass of the measured velocity, which begins with the first one of a run.
void HybridForce::filter_velocity(Vector v) {
    const Result filtered = velocity();
    if (has_begun() == 0.0) {
        has_begun() = 1.0;
        std::ranges::copy(v, filtered.begin());
    }
    for (size_t i = 0; i < v.size(); ++i) { filtered[i] += low_pass_weight(velocity_filter, dt_) * (v[i] - filtered[i]); }
}

// The unit twists of the axes in the world, at the located joints.
void HybridForce::find_directions() {
    const Rotation rotation = gains_.in_tip_frame ? dynamics_.tip().rotation : Rotation();
    const std::array<Vec3, 3> axes{rotation.x, rotation.y, rotation.z};
    std::ranges::fill(directions_.numbers(), 0.0);
    for (size_t k = 0; k < 3; ++k) {
        const std::array<double, 3> axis{axes[k].x, axes[k].y, axes[k].z};
        std::ranges::copy(axis, directions_.row(k).begin());
        std::ranges::copy(axis, directions_.row(3 + k).begin() + 3);
    }
}

// The part of a twist or a wrench (6,) along axis k.
double HybridForce::along(size_t k, Vector twist) const {
    double total = 0.0;
    for (size_t j = 0; j < 6; ++j) { total += directions_(k, j) * twist[j]; }
    return total;
}

// The twist or wrench that has a command of the force axes along these, and nothing along the others.
HybridForce::Vector6 HybridForce::along_force_axes(double AxisCommand::* command) const {
    Vector6 total{};
    for (size_t k = 0; k < 6; ++k) {
        if (axes_[k].is_force) {
            for (size_t j = 0; j < 6; ++j) { total[j] += directions_(k, j) * commands_[k].*command; }
        }
    }
    return total;
}

void HybridForce::command_axes(Vector wrench) {
    const Matrix J = task_.J();
    const double trace = task_.find_mobility(mobility_);
    Vector6 twist{};
    for (size_t k = 0; k < 6; ++k) {
        for (size_t i = 0; i < joints(); ++i) { twist[k] += J(k, i) * velocity()[i]; }
        for (size_t j = 0; j < k; ++j) { mobility_(j, k) = mobility_(k, j); }
    }
    for (size_t k = 0; k < 6; ++k) {
        if (!axes_[k].is_force) { continue; }
        AxisTick tick = axis_tick(k, trace);
        tick.measured = -along(k, wrench);  // the tip exerts the opposite of the wrench on it
        tick.speed = along(k, twist);
        commands_[k] = command_axis(tick, axis(k));
    }
}

// Mass, approach speed and contact threshold of a force axis.
AxisTick HybridForce::axis_tick(size_t k, double trace) {
    const Matrix J = task_.J();
    const Matrix W = task_.responses();
    // The motion of the joints at unit speed along the axis, and its inertia.
    Vector6 direction{};
    std::ranges::copy(directions_.row(k), direction.begin());
    const Result unit = Result(direction).first(rows_);
    solve(factors_, unit);
    double mass = 0.0;
    double dry_friction = 0.0;
    for (size_t i = 0; i < joints(); ++i) {
        double rate = 0.0;
        for (size_t j = 0; j < rows_; ++j) { rate += W(i, j) * unit[j]; }
        for (size_t j = 0; j < rows_; ++j) { mass += unit[j] * J(j, i) * rate; }
        dry_friction += std::abs(rate) * dynamics_.model().drives[i].friction.loss;
    }
    const double target = std::abs(axes_[k].target);
    double approach_speed = gains_.approach_speed;
    if (approach_speed == 0.0) {
        // When the tip stops, the wall bears the force that moved the joints against their dry friction.
        const double impact = std::max(impact_ratio * target - dry_friction, min_impact_ratio * target);
        const double mobility = contact_mobility(directions_.row(k), trace);
        approach_speed = std::min(max_approach_speed, impact * mobility / wall_damping_rate);
    }
    return {
        .target = axes_[k].target,
        .mass = mass,
        .approach_speed = approach_speed,
        .threshold = gains_.contact_force > 0.0 ? gains_.contact_force : contact_ratio * target,
        .dt = dt_,
    };
}

// The smallest mobility, 1/kg, of any point of the hand that may touch, in a direction (6,), a unit twist.
//
// The mobility of a point at the lever r is that of the twist (n, r x n). It is smallest where the hand does not turn.
double HybridForce::contact_mobility(Vector direction, double trace) const {
    std::array<double, 9> turning_numbers{};
    const MatrixResult turning{turning_numbers.data(), 3, 3};
    std::array<double, 3> lever{};
    std::array<double, 3> coupling{};
    double tip = 0.0;
    for (size_t i = 0; i < 6; ++i) {
        for (size_t j = 0; j < 6; ++j) { tip += direction[i] * mobility_(i, j) * direction[j]; }
    }
    for (size_t i = 0; i < 3; ++i) {
        for (size_t j = 0; j < 3; ++j) {
            coupling[i] += mobility_(3 + i, j) * direction[j];
            turning(i, j) = mobility_(3 + i, 3 + j);
        }
        turning(i, i) += 1e-9 * trace;
        lever[i] = -coupling[i];
    }
    factorize(turning);
    solve(turning, lever);
    const double length = std::sqrt(lever[0] * lever[0] + lever[1] * lever[1] + lever[2] * lever[2]);
    const double scale = std::min(1.0, max_lever / std::max(length, 1e-12));
    double value = tip;
    for (size_t i = 0; i < 3; ++i) {
        value += 2.0 * scale * lever[i] * coupling[i];
        for (size_t j = 0; j < 3; ++j) {
            const double inertia_part = mobility_(3 + i, 3 + j) + (i == j ? 1e-9 * trace : 0.0);
            value += scale * scale * lever[i] * inertia_part * lever[j];
        }
    }
    return std::max(value, min_mobility_ratio * tip);
}

// The acceleration of the tip minus that of the posture, and the velocity that corrects its errors.
void HybridForce::find_task(Vector v_ref, Vector a_ref) {
    const double bandwidth = gains_.bandwidth;
    const Matrix J = task_.J();
    const Matrix J_ref = task_.J_ref();
    const Vector error = task_.error();
    Vector6 feedforward{};
    for (size_t k = 0; k < 6; ++k) {
        double rate = 0.0;
        for (size_t i = 0; i < joints(); ++i) {
            rate += J_ref(k, i) * v_ref[i] - J(k, i) * velocity()[i];
            feedforward[k] += J(k, i) * a_ref[i];
        }
        motion_[k] = bandwidth * bandwidth * error[k] + 2.0 * gains_.damping_ratio * bandwidth * rate;
        correction_[k] = 0.5 * bandwidth * error[k];
    }
    for (size_t k = 0; k < 6; ++k) {  // the axes are orthogonal, so one after the other can be replaced
        if (axes_[k].is_force) {
            const double missing = commands_[k].acceleration - along(k, motion_) - along(k, feedforward);
            const double missing_speed = commands_[k].speed - along(k, correction_);
            for (size_t j = 0; j < 6; ++j) {
                motion_[j] += missing * directions_(k, j);
                correction_[j] += missing_speed * directions_(k, j);
            }
        }
    }
    for (size_t k = 0; k < 6; ++k) {
        for (size_t i = 0; i < joints(); ++i) { motion_[k] -= J(k, i) * acceleration_[i]; }
    }
}

// Subtracts the measured wrench on motion axes in contact: friction, and the moment of a contact beside the tip.
void HybridForce::subtract_compensated_wrench(Vector measured, Vector6& wrench) {
    const Result filtered = filtered_wrench();
    const bool in_contact = this->in_contact();
    Vector6 compensated{};
    for (size_t j = 0; j < 6; ++j) {
        filtered[j] += low_pass_weight(wrench_filter, dt_) * (measured[j] - filtered[j]);
        if (!in_contact) { filtered[j] = 0.0; }
        compensated[j] = filtered[j];
    }
    for (size_t k = 0; k < 6; ++k) {
        if (axes_[k].is_force) {
            const double part = along(k, filtered);
            for (size_t j = 0; j < 6; ++j) { compensated[j] -= part * directions_(k, j); }
        }
    }
    for (size_t j = 0; j < rows_; ++j) { wrench[j] -= (j < 3 ? compensated_share : 1.0) * compensated[j]; }
}

}  // namespace armctl
