// Computed torque within the limits of torque, velocity and position, by a quadratic program.
#pragma once
#include "../quadratic_program.hpp"
#include "computed_torque.hpp"

namespace armctl {

struct ComputedTorqueQPGains {
    double stiffness = 0.0;   // 1/s^2
    double damping = 0.0;     // 1/s
    Numbers added_damping;    // (n,) N m s/rad
    double decay_rate = 0.0;  // 1/s
    Numbers torque_limit;     // (n,) N m, of the motors
    Numbers q_min;            // (n,) rad, may be infinite
    Numbers q_max;            // (n,) rad, may be infinite
    Numbers v_max;            // (n,) rad/s
    Numbers a_max;            // (n,) rad/s^2
    double length = 0.0;      // of the arm, m, by which rotations of the tip and motions of the joints are converted to distances
    double dt = 0.0;          // s, the period
    bool continuous = false;  // whether the arm moves continuously in it
};

// As ComputedTorque while the desired acceleration respects all limits. Otherwise a minimizes the square of J (a - a_desired),
// subject to
//
//     -tau_max <= M a + h <= tau_max,    -v_max <= v + dt a <= v_max,    and the viability of q,
//
// in which rotations weigh less than translations, and the joints decide what the tip leaves open. If the limits contradict
// each other, the torque limits hold and the violation of the others is minimal. If that is impossible too, because other
// limits, which a_desired respects, contradict the torque limits, the torque of a_desired is clipped.
//
// The program of a tick, as a part of laws: `begin`, whose results may be changed, and `limit`.
class AccelerationProgram {
public:
    static constexpr double min_brake_share = 0.05;  // of the torque limit, for joints whose motors hardly hold them

    AccelerationProgram(const Model& model, ComputedTorqueQPGains gains)
        : desired(model->n()), H(model->n(), model->n()), M(H), gains_(std::move(gains)),
          control_(model, {.stiffness = gains_.stiffness,
                           .damping = gains_.damping,
                           .added_damping = gains_.added_damping,
                           .decay_rate = gains_.decay_rate,
                           .torque_limit = gains_.torque_limit,
                           .estimate = {}}),
          start_(at_start(*model)), J_(6, model->n()), factors_(H), offset_(desired), deviation_(desired), lower_(2 * model->n()),
          upper_(lower_), weights_(lower_), solver_(model->n()) {
        require_size(gains_.q_min, n(), "q_min");
        require_size(gains_.q_max, n(), "q_max");
        require_size(gains_.v_max, n(), "v_max");
        require_size(gains_.a_max, n(), "a_max");
    }

    size_t n() const { return desired.size(); }
    const ComputedTorqueQPGains& gains() const { return gains_; }

    // Computes the torque without limits, and all of the program of one control period but its bounds.
    void begin(const State& state, const Setpoint& setpoint, Result tau) {
        const Vector a_ref = setpoint.a_tick;
        control_.feed_back(state, setpoint, {});
        control_.torque(state, setpoint, {}, tau);
        start_.place(state.q);
        start_.mass_matrix(M);
        start_.add_step_inertia(M);
        for (size_t i = 0; i < n(); ++i) { desired[i] = control_.correction[i] + a_ref[i]; }
        // The tip's law is that of stiffness and damping alone. With the added torques, which are of first order in the errors, the
        // offset would cancel them, by a share that is not linear.
        find_tip_offset(state, setpoint);
        add_acceleration_of_added_torque();
        double feedback = 0.0;
        for (size_t i = 0; i < n(); ++i) { feedback += (desired[i] - a_ref[i]) * (desired[i] - a_ref[i]); }
        set_metric();
        follow_tip(feedback, tau);
    }

    // Changes the torque of the desired acceleration so that it respects the limits.
    void limit(const State& state, Result tau) {
        if (!find_bounds(state, tau)) { return; }
        // If the limits contradict each other, those of velocity and position become costs.
        const QuadraticProgram program{.H = H, .f = {}, .M = M, .lower = lower_, .upper = upper_};
        double trace = 0.0;
        for (size_t i = 0; i < n(); ++i) { trace += H(i, i); }
        std::fill_n(weights_.begin(), n(), violation_weight * trace);
        const bool is_solved = solver_.solve(program, deviation_) || solver_.solve_relaxed(program, weights_, deviation_);
        if (!is_solved) { std::ranges::fill(deviation_, 0.0); }
        for (size_t i = 0; i < n(); ++i) { tau[i] = clipped(dot(M.row(i), deviation_, tau[i]), gains_.torque_limit[i]); }
    }

    Numbers desired;                       // acceleration, (n,)
    Mat H;                                 // the cost of deviations from it
    Mat M;                                 // inertia
    double brake_share = min_brake_share;  // of the torque limit, the least with which a joint is taken to brake before a limit

private:
    // Weights of a deviation from the desired acceleration, relative to that of the tip's position: the joints decide only what
    // the tip leaves open, with which a direction that the tip cannot move in costs little.
    static constexpr double rotation_weight = 0.03;
    static constexpr double joint_weight = 0.003;
    static constexpr double max_tip_share = 0.5;     // of the feedback's acceleration: the largest correction for the tip's curved motion
    static constexpr double usable_share = 0.8;      // of the torque left, with which a joint has to be able to stop
    static constexpr double violation_weight = 1e4;  // of limits that cannot be respected, relative to the deviation of the tip

    // The model at the start of its control period.
    static Model at_start(const ArmModel& model) {
        auto start = std::make_shared<ArmModel>(model);
        start->half_step = 0.0;
        return start;
    }

    // J^T c: c is what the tip's acceleration lacks of its own feedback law; leaves the Jacobian at q in J.
    //
    // It is of second order in the errors of the joints, so it changes neither exact tracking nor the linear loop.
    void find_tip_offset(const State& state, const Setpoint& setpoint) {
        const Vec3 wanted = tip_law(setpoint.q, setpoint.v_tick, setpoint.a_tick);
        const Vec3 missing = wanted - tip_law(state.q, state.v, desired);
        for (size_t i = 0; i < n(); ++i) { offset_[i] = J_(0, i) * missing.x + J_(1, i) * missing.y + J_(2, i) * missing.z; }
    }

    // Acceleration minus gravity plus damping times velocity plus stiffness times position of the tip, in the world.
    Vec3 tip_law(Vector q, Vector v, Vector a) {
        const Vec3 acceleration = start_.tip_motion(q, v, a).linear;
        const Pose tip = start_.tip();
        J_.set(start_.tip_jacobian());
        Vec3 total = gains_.stiffness * tip.translation;
        total = total + acceleration.x * tip.rotation.x + acceleration.y * tip.rotation.y + acceleration.z * tip.rotation.z;
        for (size_t i = 0; i < n(); ++i) {
            total += {gains_.damping * J_(0, i) * v[i], gains_.damping * J_(1, i) * v[i], gains_.damping * J_(2, i) * v[i]};
        }
        return total;
    }

    void add_acceleration_of_added_torque() {
        if (std::ranges::all_of(control_.added_torque, [](double torque) { return torque == 0.0; })) { return; }
        factors_ = M;
        factorize(factors_);
        copy(control_.added_torque, deviation_);
        solve(factors_, deviation_);
        for (size_t i = 0; i < n(); ++i) { desired[i] += deviation_[i]; }
    }

    // The squared deviation of the tip, with the weights above; J is overwritten.
    void set_metric() {
        for (size_t k = 3; k < 6; ++k) {
            for (double& each : J_.row(k)) { each *= rotation_weight * gains_.length; }
        }
        std::ranges::fill(H.numbers(), 0.0);
        for (size_t i = 0; i < n(); ++i) { H(i, i) = (joint_weight * gains_.length) * (joint_weight * gains_.length); }
        H += J_.transposed() * J_;
    }

    // Changes acceleration and torque so that the tip follows its own feedback law, by a share of the feedback at most.
    void follow_tip(double feedback, Result tau) {
        factors_ = H;
        factorize(factors_);
        solve(factors_, offset_);
        const double square = dot(offset_, offset_);
        if (square == 0.0) { return; }
        const double share = std::min(1.0, max_tip_share * std::sqrt(feedback / square));
        for (size_t i = 0; i < n(); ++i) { desired[i] += share * offset_[i]; }
        tau += share * M * offset_;
    }

    // The bounds of the deviation and of its torque; whether zero is outside.
    bool find_bounds(const State& state, Vector tau) {
        const size_t n = this->n();
        bool limited = false;
        for (size_t i = 0; i < n; ++i) {
            const double q = state.q[i];
            const double v = state.v[i];
            const double tau_max = gains_.torque_limit[i];
            const double bias = tau[i] - dot(M.row(i), desired);
            const double slowest = brake_share * tau_max;
            const double down = std::min(gains_.a_max[i], std::max(usable_share * (tau_max + bias), slowest) / M(i, i));
            const double up = std::min(gains_.a_max[i], std::max(usable_share * (tau_max - bias), slowest) / M(i, i));
            const double highest = std::min(gains_.v_max[i], stopping_speed(gains_.q_max[i] - q, v, down));
            const double lowest = -std::min(gains_.v_max[i], stopping_speed(q - gains_.q_min[i], -v, up));
            lower_[i] = -unbounded;
            upper_[i] = unbounded;
            if (gains_.dt > 0.0) {  // in continuous time, there are only torque limits
                lower_[i] = std::max((lowest - v) / gains_.dt - desired[i], -unbounded);
                upper_[i] = std::min((highest - v) / gains_.dt - desired[i], unbounded);
            }
            lower_[n + i] = std::max(-tau_max - tau[i], -unbounded);
            upper_[n + i] = std::min(tau_max - tau[i], unbounded);
            const double slack = limit_tolerance * (std::abs(desired[i]) + 1.0);
            const double load = limit_tolerance * std::abs(tau[i]);
            limited = limited || lower_[i] > slack || upper_[i] < -slack || lower_[n + i] > load || upper_[n + i] < -load;
        }
        return limited;
    }

    // Of the present velocity in the mean one of the period.
    double mean_share() const { return gains_.continuous ? 0.5 : 0.0; }

    // The highest speed at the end of the period from which a joint still stops before its limit, at a distance now.
    //
    // The viability bound of Del Prete, "Joint position and velocity bounds in discrete-time acceleration/torque control of robot
    // manipulators" (2018): the speed s after the period travels s dt / 2 + s^2 / (2 deceleration) until it stops.
    double stopping_speed(double distance, double v, double deceleration) const {
        const double rest = distance - mean_share() * v * gains_.dt;
        if (!(rest > 0.0)) { return 0.0; }
        const double half = 0.5 * deceleration * gains_.dt;
        const double speed = std::sqrt(half * half + 2.0 * deceleration * rest) - half;
        return std::min(speed, rest / std::max((1.0 - mean_share()) * gains_.dt, 1e-300));
    }

    ComputedTorqueQPGains gains_;
    InverseDynamicsControl control_;
    Dynamics start_;  // of the control period
    Mat J_, factors_;
    Numbers offset_;     // J^T c: c is what the tip's acceleration lacks of its own feedback law
    Numbers deviation_;  // from the desired acceleration
    // The bounds of the deviation and of its torque, and the weights of the former where they cannot be respected.
    Numbers lower_, upper_, weights_;
    ActiveSetSolver solver_;
};

class ComputedTorqueQP final : public Cloneable<ComputedTorqueQP> {
public:
    ComputedTorqueQP(const Model& model, ComputedTorqueQPGains gains) : Cloneable(model->n()), program_(model, std::move(gains)) {}

    void torque(const State& state, const Setpoint& setpoint, Result tau) noexcept override {
        program_.begin(state, setpoint, tau);
        program_.limit(state, tau);
    }

private:
    AccelerationProgram program_;
};

}  // namespace armctl
