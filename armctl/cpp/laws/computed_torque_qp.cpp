#include "computed_torque_qp.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "../errors.hpp"
#include "../factorization.hpp"

namespace armctl {

namespace {

// Weights of a deviation from the desired acceleration, relative to that of the tip's position: the joints decide only what the
// tip leaves open, with which a direction that the tip cannot move in costs little.
constexpr double rotation_weight = 0.03;
constexpr double joint_weight = 0.003;
constexpr double max_tip_share = 0.5;     // of the feedback's acceleration: the largest correction for the tip's curved motion
constexpr double brake_share = 0.8;       // of the torque left, with which a joint has to be able to stop
constexpr double min_brake_share = 0.05;  // of the torque limit, for joints whose motors hardly hold them
constexpr double tolerance = 1e-9;        // relative, at which a limit counts as respected
constexpr double violation_weight = 1e4;  // of limits that cannot be respected, relative to the deviation of the tip

// The model at the start of its control period.
std::shared_ptr<const ArmModel> at_start(const ArmModel& model) {
    auto start = std::make_shared<ArmModel>(model);
    start->half_step = 0.0;
    return start;
}

ComputedTorqueQP::Limits checked(ComputedTorqueQP::Limits limits, size_t n) {
    for (const std::vector<double>* positions : {&limits.q_min, &limits.q_max}) {
        if (positions->size() != n || std::ranges::any_of(*positions, [](double q) { return std::isnan(q); })) {
            throw InputError("q_min and q_max: need " + std::to_string(n) + " numbers each");
        }
    }
    return {
        .q_min = std::move(limits.q_min),
        .q_max = std::move(limits.q_max),
        .v_max = checked_limits(std::move(limits.v_max), n, "v_max"),
        .a_max = checked_limits(std::move(limits.a_max), n, "a_max"),
        .tau_max = checked_limits(std::move(limits.tau_max), n, "tau_max"),
    };
}

}  // namespace

ComputedTorqueQP::ComputedTorqueQP(std::shared_ptr<const ArmModel> model, Gains gains, Limits limits, double length, double dt,
                                   bool continuous)
    : stiffness_(gains.stiffness), damping_(gains.damping), limits_(checked(std::move(limits), model->n())),
      length_(checked_gain(length, "length")), dt_(checked_period(dt)), mean_share_(continuous ? 0.5 : 0.0),
      unlimited_(model,
                 {
                     .stiffness = gains.stiffness,
                     .damping = gains.damping,
                     .added_inertia = std::move(gains.added_inertia),
                     .estimate = {},
                     .torque_limit = limits_.tau_max,
                 },
                 ComputedTorque::Form::discrete, dt, continuous),
      dynamics_(at_start(*model)), solver_(model->n()), desired_(model->n()), offset_(model->n()), torque_(model->n()), J_(6, model->n()),
      H_(model->n(), model->n()), M_(model->n(), model->n()), factors_(model->n(), model->n()), lower_(2 * model->n()),
      upper_(2 * model->n()), relaxed_H_(model->n(), model->n()), relaxed_cost_(model->n()), relaxed_lower_(2 * model->n()),
      relaxed_upper_(2 * model->n()), deviation_(model->n()) {}

void ComputedTorqueQP::torque(const State& state, const Setpoint& setpoint, Result tau) {
    is_limited_ = make_program(state, setpoint, tau);
    if (!is_limited_) { return; }
    find_deviation();
    for (size_t i = 0; i < tau.size(); ++i) {
        torque_[i] = tau[i];
        for (size_t k = 0; k < tau.size(); ++k) { tau[i] += M_(i, k) * deviation_[k]; }
        const double tau_max = limits_.tau_max[i];
        if (tau[i] > tau_max) {
            tau[i] = tau_max;
        } else if (tau[i] < -tau_max) {
            tau[i] = -tau_max;
        }
    }
}

std::optional<ComputedTorqueQP::Program> ComputedTorqueQP::last_program() const {
    if (!is_limited_) { return std::nullopt; }
    return Program{.H = H_, .M = M_, .lower = lower_, .upper = upper_, .torque = torque_};
}

// Computes the torque without limits and the program of one control period; whether the torque exceeds a limit.
bool ComputedTorqueQP::make_program(const State& state, const Setpoint& setpoint, Result tau) {
    const size_t n = tau.size();
    const Vector a_ref = setpoint.a_tick;
    unlimited_.torque(state, setpoint, tau);
    dynamics_.place(state.q);
    dynamics_.mass_matrix(M_);
    dynamics_.add_step_inertia(M_);
    for (size_t i = 0; i < n; ++i) { desired_[i] = unlimited_.correction()[i] + a_ref[i]; }
    // The tip's law is that of stiffness and damping alone. With the added torques, which are of first order in the errors, the
    // offset would cancel them, by a share that is not linear.
    find_tip_offset(state, setpoint);
    add_acceleration_of_added_torque();
    double feedback = 0.0;
    for (size_t i = 0; i < n; ++i) {
        const double missing = desired_[i] - a_ref[i];
        feedback += missing * missing;
    }
    set_metric();
    follow_tip(feedback, tau);
    return find_bounds(state, tau);
}

// J^T c: c is what the tip's acceleration lacks of its own feedback law; leaves the Jacobian at q in J.
//
// It is of second order in the errors of the joints, so it changes neither exact tracking nor the linear loop.
void ComputedTorqueQP::find_tip_offset(const State& state, const Setpoint& setpoint) {
    const Vec3 wanted = tip_law(setpoint.q, setpoint.v_tick, setpoint.a_tick);
    const Vec3 missing = wanted - tip_law(state.q, state.v, desired_);
    for (size_t i = 0; i < joints(); ++i) { offset_[i] = J_(0, i) * missing.x + J_(1, i) * missing.y + J_(2, i) * missing.z; }
}

// Acceleration minus gravity plus damping times velocity plus stiffness times position of the tip, in the world.
Vec3 ComputedTorqueQP::tip_law(Vector q, Vector v, Vector a) {
    const Vec3 acceleration = dynamics_.tip_motion(q, v, a).linear;
    const Pose tip = dynamics_.tip();
    const Rotation& R = tip.rotation;
    dynamics_.tip_jacobian(J_);
    const auto component = [acceleration](double spring, Vec3 row) {
        return spring + row.x * acceleration.x + row.y * acceleration.y + row.z * acceleration.z;
    };
    Vec3 total{
        component(stiffness_ * tip.translation.x, R.row_x()),
        component(stiffness_ * tip.translation.y, R.row_y()),
        component(stiffness_ * tip.translation.z, R.row_z()),
    };
    for (size_t i = 0; i < joints(); ++i) {
        total.x += damping_ * J_(0, i) * v[i];
        total.y += damping_ * J_(1, i) * v[i];
        total.z += damping_ * J_(2, i) * v[i];
    }
    return total;
}

void ComputedTorqueQP::add_acceleration_of_added_torque() {
    const Vector added_torque = unlimited_.added_torque();
    if (std::ranges::all_of(added_torque, [](double torque) { return torque == 0.0; })) { return; }
    std::ranges::copy(M_.numbers(), factors_.numbers().begin());
    factorize(factors_);
    const Result acceleration = deviation_;  // is not known yet
    std::ranges::copy(added_torque, acceleration.begin());
    solve(factors_, acceleration);
    for (size_t i = 0; i < joints(); ++i) { desired_[i] += acceleration[i]; }
}

// The squared deviation of the tip, with the weights above; J is overwritten.
void ComputedTorqueQP::set_metric() {
    const size_t n = joints();
    for (size_t i = 0; i < n; ++i) {
        for (size_t k = 3; k < 6; ++k) { J_(k, i) *= rotation_weight * length_; }
    }
    for (size_t i = 0; i < n; ++i) {
        for (size_t j = 0; j < n; ++j) {
            double total = i == j ? (joint_weight * length_) * (joint_weight * length_) : 0.0;
            for (size_t k = 0; k < 6; ++k) { total += J_(k, i) * J_(k, j); }
            H_(i, j) = total;
        }
    }
}

// Changes acceleration and torque so that the tip follows its own feedback law, by a share of the feedback at most.
void ComputedTorqueQP::follow_tip(double feedback, Result tau) {
    const size_t n = joints();
    std::ranges::copy(H_.numbers(), factors_.numbers().begin());
    factorize(factors_);
    solve(factors_, offset_);
    double square = 0.0;
    for (const double acceleration : offset_) { square += acceleration * acceleration; }
    if (square == 0.0) { return; }
    const double share = std::min(1.0, max_tip_share * std::sqrt(feedback / square));
    for (size_t i = 0; i < n; ++i) {
        desired_[i] += share * offset_[i];
        for (size_t k = 0; k < n; ++k) { tau[i] += share * M_(i, k) * offset_[k]; }
    }
}

// The bounds of the deviation and of its torque; whether zero is outside.
bool ComputedTorqueQP::find_bounds(const State& state, Vector tau) {
    const size_t n = joints();
    bool limited = false;
    for (size_t i = 0; i < n; ++i) {
        const double q = state.q[i];
        const double v = state.v[i];
        const double tau_max = limits_.tau_max[i];
        const double v_max = limits_.v_max[i];
        double inertial = 0.0;
        for (size_t k = 0; k < n; ++k) { inertial += M_(i, k) * desired_[k]; }
        const double bias = tau[i] - inertial;
        const double slowest = min_brake_share * tau_max;
        const double down = std::min(limits_.a_max[i], std::max(brake_share * (tau_max + bias), slowest) / M_(i, i));
        const double up = std::min(limits_.a_max[i], std::max(brake_share * (tau_max - bias), slowest) / M_(i, i));
        const double highest = std::min(v_max, stopping_speed(limits_.q_max[i] - q, v, down));
        const double lowest = -std::min(v_max, stopping_speed(q - limits_.q_min[i], -v, up));
        lower_[i] = -unbounded;
        upper_[i] = unbounded;
        if (dt_ > 0.0) {
            lower_[i] = std::max((lowest - v) / dt_ - desired_[i], -unbounded);
            upper_[i] = std::min((highest - v) / dt_ - desired_[i], unbounded);
        }
        lower_[n + i] = std::max(-tau_max - tau[i], -unbounded);
        upper_[n + i] = std::min(tau_max - tau[i], unbounded);
        const double slack = tolerance * (std::abs(desired_[i]) + 1.0);
        const double load = tolerance * std::abs(tau[i]);
        if (lower_[i] > slack || upper_[i] < -slack || lower_[n + i] > load || upper_[n + i] < -load) { limited = true; }
    }
    return limited;
}

// The highest speed at the end of the period from which a joint still stops before its limit, at a distance now.
//
// The viability bound of Del Prete, "Joint position and velocity bounds in discrete-time acceleration/torque control of robot
// manipulators" (2018): the speed s after the period travels s dt / 2 + s^2 / (2 deceleration) until it stops.
double ComputedTorqueQP::stopping_speed(double distance, double v, double deceleration) const {
    const double rest = distance - mean_share_ * v * dt_;
    if (!(rest > 0.0)) { return 0.0; }
    const double half = 0.5 * deceleration * dt_;
    const double speed = std::sqrt(half * half + 2.0 * deceleration * rest) - half;
    return std::min(speed, rest / std::max((1.0 - mean_share_) * dt_, 1e-300));
}

// Solves the program. Where limits contradict each other, those of velocity and position become costs.
void ComputedTorqueQP::find_deviation() {
    std::ranges::fill(relaxed_cost_, 0.0);
    const QuadraticProgram program{.H = H_, .f = relaxed_cost_, .M = M_, .lower = lower_, .upper = upper_};
    if (solver_.solve(program, deviation_)) { return; }
    relax_bounds();
    const QuadraticProgram relaxed{.H = relaxed_H_, .f = relaxed_cost_, .M = M_, .lower = relaxed_lower_, .upper = relaxed_upper_};
    if (!solver_.solve(relaxed, deviation_)) { std::ranges::fill(deviation_, 0.0); }
}

// Makes costs of the bounds of the deviation that exclude zero.
void ComputedTorqueQP::relax_bounds() {
    const size_t n = joints();
    double trace = 0.0;
    for (size_t i = 0; i < n; ++i) { trace += H_(i, i); }
    std::ranges::copy(H_.numbers(), relaxed_H_.numbers().begin());
    std::ranges::copy(lower_, relaxed_lower_.begin());
    std::ranges::copy(upper_, relaxed_upper_.begin());
    for (size_t i = 0; i < n; ++i) {
        const double nearest = std::min(std::max(0.0, lower_[i]), upper_[i]);
        if (nearest != 0.0) {
            const double weight = violation_weight * trace;
            relaxed_H_(i, i) += weight;
            relaxed_cost_[i] = -weight * nearest;
            relaxed_lower_[i] = -unbounded;
            relaxed_upper_[i] = unbounded;
        }
    }
}

}  // namespace armctl
