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
class ComputedTorqueQP : public Cloneable<ComputedTorqueQP, ComputedTorque> {
public:
    // The gains are those of ComputedTorque and the members below. `q_min` and `q_max` may be infinite.
    ComputedTorqueQP(const Model& model, const Arguments& gains, size_t memory_size = 0)
        : Cloneable(model, gains, memory_size), q_min_(gains.numbers(joints(), "q_min")), q_max_(gains.numbers(joints(), "q_max")),
          v_max_(gains.numbers(joints(), "v_max")), a_max_(gains.numbers(joints(), "a_max")), length_(gains.number("length")),
          mean_share_(gains.flag("continuous") ? 0.5 : 0.0), start_(at_start(*model)), solver_(joints()) {}

    void torque(const State& state, const Setpoint& setpoint, Result tau) override {
        if (!make_program(state, setpoint, tau)) { return; }
        // If the limits contradict each other, those of velocity and position become costs.
        const QuadraticProgram program{.H = H_, .f = {}, .M = M_, .lower = lower_, .upper = upper_};
        double trace = 0.0;
        for (size_t i = 0; i < joints(); ++i) { trace += H_(i, i); }
        std::fill_n(weights_.begin(), joints(), violation_weight * trace);
        const bool is_solved = solver_.solve(program, deviation_) || solver_.solve_relaxed(program, weights_, deviation_);
        if (!is_solved) { std::ranges::fill(deviation_, 0.0); }
        for (size_t i = 0; i < tau.size(); ++i) { tau[i] = clipped(dot(M_.row(i), deviation_, tau[i]), tau_max_[i]); }
    }

protected:
    // Changes the desired acceleration and the torque before the limits of this tick; M_ and H_ are those of this tick.
    virtual void plan(const State&, const Setpoint&, Result) {}

    static constexpr double min_brake_share = 0.05;  // of the torque limit, for joints whose motors hardly hold them
    DenseMatrix square() const { return {joints(), joints()}; }

    Numbers q_min_;      // rad
    Numbers q_max_;      // rad
    Numbers v_max_;      // rad/s
    Numbers a_max_;      // rad/s^2
    double length_;      // of the arm, m, by which rotations of the tip and motions of the joints are converted to distances
    double mean_share_;  // of the present velocity in the mean one of the period: 0.5 if the arm moves continuously, else 0
    double min_brake_share_ = min_brake_share;
    Dynamics start_;             // of the control period
    Numbers desired_ = zeros();  // acceleration
    DenseMatrix J_{6, joints()}, H_ = square(), M_ = square(), factors_ = square();

private:
    // Weights of a deviation from the desired acceleration, relative to that of the tip's position: the joints decide only what
    // the tip leaves open, with which a direction that the tip cannot move in costs little.
    static constexpr double rotation_weight = 0.03;
    static constexpr double joint_weight = 0.003;
    static constexpr double max_tip_share = 0.5;     // of the feedback's acceleration: the largest correction for the tip's curved motion
    static constexpr double brake_share = 0.8;       // of the torque left, with which a joint has to be able to stop
    static constexpr double tolerance = 1e-9;        // relative, at which a limit counts as respected
    static constexpr double violation_weight = 1e4;  // of limits that cannot be respected, relative to the deviation of the tip

    // The model at the start of its control period.
    static Model at_start(const ArmModel& model) {
        auto start = std::make_shared<ArmModel>(model);
        start->half_step = 0.0;
        return start;
    }

    // Computes the torque without limits and the program of one control period; whether the torque exceeds a limit.
    bool make_program(const State& state, const Setpoint& setpoint, Result tau) {
        const Vector a_ref = setpoint.a_tick;
        ComputedTorque::torque(state, setpoint, tau);
        start_.place(state.q);
        start_.mass_matrix(M_);
        start_.add_step_inertia(M_);
        for (size_t i = 0; i < joints(); ++i) { desired_[i] = correction_[i] + a_ref[i]; }
        // The tip's law is that of stiffness and damping alone. With the added torques, which are of first order in the errors, the
        // offset would cancel them, by a share that is not linear.
        find_tip_offset(state, setpoint);
        add_acceleration_of_added_torque();
        double feedback = 0.0;
        for (size_t i = 0; i < joints(); ++i) { feedback += (desired_[i] - a_ref[i]) * (desired_[i] - a_ref[i]); }
        set_metric();
        follow_tip(feedback, tau);
        plan(state, setpoint, tau);
        return find_bounds(state, tau);
    }

    // J^T c: c is what the tip's acceleration lacks of its own feedback law; leaves the Jacobian at q in J.
    //
    // It is of second order in the errors of the joints, so it changes neither exact tracking nor the linear loop.
    void find_tip_offset(const State& state, const Setpoint& setpoint) {
        const Vec3 wanted = tip_law(setpoint.q, setpoint.v_tick, setpoint.a_tick);
        const Vec3 missing = wanted - tip_law(state.q, state.v, desired_);
        for (size_t i = 0; i < joints(); ++i) { offset_[i] = J_(0, i) * missing.x + J_(1, i) * missing.y + J_(2, i) * missing.z; }
    }

    // Acceleration minus gravity plus damping times velocity plus stiffness times position of the tip, in the world.
    Vec3 tip_law(Vector q, Vector v, Vector a) {
        const Vec3 acceleration = start_.tip_motion(q, v, a).linear;
        const Pose tip = start_.tip();
        J_.set(start_.tip_jacobian());
        Vec3 total = stiffness_ * tip.translation;
        total = total + acceleration.x * tip.rotation.x + acceleration.y * tip.rotation.y + acceleration.z * tip.rotation.z;
        for (size_t i = 0; i < joints(); ++i) {
            total += {damping_ * J_(0, i) * v[i], damping_ * J_(1, i) * v[i], damping_ * J_(2, i) * v[i]};
        }
        return total;
    }

    void add_acceleration_of_added_torque() {
        if (std::ranges::all_of(added_torque_, [](double torque) { return torque == 0.0; })) { return; }
        factors_ = M_;
        factorize(factors_);
        const Result acceleration = deviation_;  // is not known yet
        copy(added_torque_, acceleration);
        solve(factors_, acceleration);
        for (size_t i = 0; i < joints(); ++i) { desired_[i] += acceleration[i]; }
    }

    // The squared deviation of the tip, with the weights above; J is overwritten.
    void set_metric() {
        const size_t n = joints();
        for (size_t i = 0; i < n; ++i) {
            for (size_t k = 3; k < 6; ++k) { J_(k, i) *= rotation_weight * length_; }
        }
        for (size_t i = 0; i < n; ++i) {
            for (size_t j = 0; j < n; ++j) {
                H_(i, j) = i == j ? (joint_weight * length_) * (joint_weight * length_) : 0.0;
                for (size_t k = 0; k < 6; ++k) { H_(i, j) += J_(k, i) * J_(k, j); }
            }
        }
    }

    // Changes acceleration and torque so that the tip follows its own feedback law, by a share of the feedback at most.
    void follow_tip(double feedback, Result tau) {
        factors_ = H_;
        factorize(factors_);
        solve(factors_, offset_);
        const double square = dot(offset_, offset_);
        if (square == 0.0) { return; }
        const double share = std::min(1.0, max_tip_share * std::sqrt(feedback / square));
        for (size_t i = 0; i < joints(); ++i) {
            desired_[i] += share * offset_[i];
            for (size_t k = 0; k < joints(); ++k) { tau[i] += share * M_(i, k) * offset_[k]; }
        }
    }

    // The bounds of the deviation and of its torque; whether zero is outside.
    bool find_bounds(const State& state, Vector tau) {
        const size_t n = joints();
        bool limited = false;
        for (size_t i = 0; i < n; ++i) {
            const double q = state.q[i];
            const double v = state.v[i];
            const double tau_max = tau_max_[i];
            const double bias = tau[i] - dot(M_.row(i), desired_);
            const double slowest = min_brake_share_ * tau_max;
            const double down = std::min(a_max_[i], std::max(brake_share * (tau_max + bias), slowest) / M_(i, i));
            const double up = std::min(a_max_[i], std::max(brake_share * (tau_max - bias), slowest) / M_(i, i));
            const double highest = std::min(v_max_[i], stopping_speed(q_max_[i] - q, v, down));
            const double lowest = -std::min(v_max_[i], stopping_speed(q - q_min_[i], -v, up));
            lower_[i] = -unbounded;
            upper_[i] = unbounded;
            if (dt_ > 0.0) {  // in continuous time, there are only torque limits
                lower_[i] = std::max((lowest - v) / dt_ - desired_[i], -unbounded);
                upper_[i] = std::min((highest - v) / dt_ - desired_[i], unbounded);
            }
            lower_[n + i] = std::max(-tau_max - tau[i], -unbounded);
            upper_[n + i] = std::min(tau_max - tau[i], unbounded);
            const double slack = tolerance * (std::abs(desired_[i]) + 1.0);
            const double load = tolerance * std::abs(tau[i]);
            limited = limited || lower_[i] > slack || upper_[i] < -slack || lower_[n + i] > load || upper_[n + i] < -load;
        }
        return limited;
    }

    // The highest speed at the end of the period from which a joint still stops before its limit, at a distance now.
    //
    // The viability bound of Del Prete, "Joint position and velocity bounds in discrete-time acceleration/torque control of robot
    // manipulators" (2018): the speed s after the period travels s dt / 2 + s^2 / (2 deceleration) until it stops.
    double stopping_speed(double distance, double v, double deceleration) const {
        const double rest = distance - mean_share_ * v * dt_;
        if (!(rest > 0.0)) { return 0.0; }
        const double half = 0.5 * deceleration * dt_;
        const double speed = std::sqrt(half * half + 2.0 * deceleration * rest) - half;
        return std::min(speed, rest / std::max((1.0 - mean_share_) * dt_, 1e-300));
    }

    ActiveSetSolver solver_;
    Numbers offset_ = zeros();  // J^T c: c is what the tip's acceleration lacks of its own feedback law
    // The bounds of the deviation and of its torque, and the weights of the former where they cannot be respected.
    Numbers lower_ = Numbers(2 * joints()), upper_ = lower_, weights_ = lower_;
    Numbers deviation_ = zeros();  // from the desired acceleration
};

}  // namespace armctl
