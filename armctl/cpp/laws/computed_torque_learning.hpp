// Computed torque with a disturbance observer, which learns payload, friction and delay, and feeds them forward.
#pragma once
#include "computed_torque_observer.hpp"

namespace armctl {

// The parameters of a rigid body at the tip: the mass m, the first moment m c (3,) and the second moments S, xx yy zz xy xz yz,
// kg m^2, in the tip's frame. Its inertia about the tip is tr(S) 1 - S. The torque is linear in them.
//
// Source: Atkeson, An, Hollerbach, "Estimation of inertial parameters of manipulator loads and links" (1986).
constexpr size_t body_parameters = 10;

// The torques of a body at the tip per parameter, the first ten columns of Y (n, 10 or more), at a motion of the arm.
//
// A point x of the body has the acceleration a + A x with A = [alpha] + [omega]^2 and a that of the tip minus gravity. Its
// force and moment about the tip are therefore m a + A h and h x a + sum over i, j of S_ij e_i x A e_j.
inline void payload_regressor(Dynamics& dynamics, Vector q, Vector v, Vector a, MatrixResult Y) {
    const BodyMotion motion = dynamics.tip_motion(q, v, a);
    const Rotation rotation = dynamics.tip().rotation;
    const Matrix J = dynamics.tip_jacobian();
    const Vec3 w = motion.omega;
    const Vec3 alpha = motion.alpha;
    const double square = dot(w, w);
    const std::array<Vec3, 3> A{{
        // its columns
        {w.x * w.x - square, w.y * w.x + alpha.z, w.z * w.x - alpha.y},
        {w.x * w.y - alpha.z, w.y * w.y - square, w.z * w.y + alpha.x},
        {w.x * w.z + alpha.y, w.y * w.z - alpha.x, w.z * w.z - square},
    }};
    for (size_t i = 0; i < Y.rows; ++i) {
        const Vec3 linear = rotation.inverse_times({J(0, i), J(1, i), J(2, i)});
        const Vec3 angular = rotation.inverse_times({J(3, i), J(4, i), J(5, i)});
        // angular . (e_k x a) = e_k . (a x angular)
        const Vec3 moment = cross(motion.linear, angular);
        // Component i of vector k is angular . (e_i x A e_k).
        const Vec3 x = cross(A[0], angular);
        const Vec3 y = cross(A[1], angular);
        const Vec3 z = cross(A[2], angular);
        const std::array<double, body_parameters> torques{
            dot(linear, motion.linear),
            moment.x + dot(linear, A[0]),
            moment.y + dot(linear, A[1]),
            moment.z + dot(linear, A[2]),
            x.x,
            y.y,
            z.z,
            y.x + x.y,
            z.x + x.z,
            z.y + y.z,
        };
        copy(torques, Y.row(i));
    }
}

struct ComputedTorqueLearningGains {
    ComputedTorqueObserverGains observer;
    double filter_weight = 0.0;       // of each of two low-passes in one control period
    double information_weight = 0.0;  // of one control period
    double forgetting = 0.0;          // per control period
    Numbers torque_precision;         // (n,) 1/(N m), reciprocal standard deviations of unexplained torques
    Numbers prior_deviations;         // (p,) standard deviations of the unknowns before any motion
};

// tau = computed torque with observer + Y(q_ref, v_ref, a_ref) theta + friction sign(v_ref) + T tau_ref'
//
// A recursive Bayesian estimator finds p unknowns: the ten inertial parameters theta of a rigid body at the tip; the delay T of the
// motors, because the torque tau(t - T) acts, so tau(t) exceeds what the motion needs by T times its rate; and the dry friction
// of each joint that the model does not contain, N m. tau_ref' is the rate of the torque that the reference needs.
//
// Source: Ljung, System Identification (1999), 11.2.
class ComputedTorqueLearning final : public Cloneable<ComputedTorqueLearning> {
public:
    ComputedTorqueLearning(const Model& model, ComputedTorqueLearningGains gains)
        : Cloneable(model->n(), DisturbanceObserver::memory_size(model->n()) + memory_size(model->n())),
          observer_(model, std::move(gains.observer)), gains_(std::move(gains)) {
        require_size(gains_.torque_precision, joints(), "torque_precision");
        require_size(gains_.prior_deviations, p_, "prior_deviations");
    }

    void torque(const State& state, const Setpoint& setpoint, Result tau) noexcept override {
        DisturbanceObserver::Memory observed(memory(), joints());
        Memory memory = parts(observed);
        const bool is_first = !observed.motion.has_begun();
        observer_.observe(state, observed);
        if (!is_first) { learn(memory, observed); }
        observer_.control(setpoint, observed, tau);
        find_rates(setpoint, is_first, memory);
        feed_forward(setpoint.v_tick, memory);
        for (size_t i = 0; i < joints(); ++i) { observer_.known[i] += memory.fed_forward[i]; }
        observer_.cancel(observed, tau);
    }

    void applied(Vector tau) noexcept override {
        DisturbanceObserver::Memory observed(memory(), joints());
        observer_.take_applied(tau, observed);
    }

    // The estimated disturbance, (n,) N m.
    Result disturbance() { return DisturbanceObserver::Memory(memory(), joints()).disturbance; }

    // (p,): the ten parameters of the payload, the delay, s, and the dry friction of the joints, N m.
    Result estimate() {
        const DisturbanceObserver::Memory observed(memory(), joints());
        return parts(observed).estimate;
    }

private:
    static constexpr size_t delay_unknown = body_parameters;
    static constexpr size_t first_friction_unknown = body_parameters + 1;
    static constexpr double friction_speed = 1e-3;  // rad/s (m/s), above which friction that is fed forward does not depend on speed
    static constexpr double max_misfit = 50.0;  // mean square of the residual, in units of the noise, up to which forgetting accelerates

    // What belongs to the last tick, and to the estimator, which sees regressors and torques through two low-passes.
    struct Memory {
        double* next;  // part of the memory
        size_t n;
        size_t p;
        Result estimate = vector(p);
        // Torques per unknown, and in the last column those that the estimate is to explain: now, and behind each low-pass.
        MatrixResult regressor = matrix(n);
        std::array<MatrixResult, 2> filtered = {matrix(n), matrix(n)};
        MatrixResult information = matrix(p + 1);  // the last row is the information vector
        Result fed_forward = vector(n);            // N m
        Result needed = vector(n);                 // N m, that the model needs for the reference
        Result last_rate = vector(n);              // N m/s, of the torque that the reference needs
        double& reference_moved = vector(1)[0];

        Result vector(size_t size) {
            next += size;
            return {next - size, size};
        }
        MatrixResult matrix(size_t rows) { return {vector(rows * (p + 1)).data(), rows, p + 1}; }
    };

    static size_t unknown_count(size_t n) { return first_friction_unknown + n; }

    static size_t memory_size(size_t n) {
        const size_t p = unknown_count(n);
        return p + (3 * n + p + 1) * (p + 1) + 3 * n + 1;
    }

    Memory parts(const DisturbanceObserver::Memory& observed) const { return {.next = observed.further.data(), .n = joints(), .p = p_}; }

    // Updates the estimate with the torque that the motors gave beyond the model's. The observer's estimate changes by the opposite
    // torque: the sum does not jump.
    //
    // Old information fades, faster if the estimate does not explain the torques (Fortescue, Kershenbaum, Ydstie, "Implementation
    // of self-tuning regulators with variable forgetting factors", 1981).
    void learn(Memory& memory, DisturbanceObserver::Memory& observed) {
        copy(memory.estimate, previous_estimate_);
        const double misfit = filter(memory, observed.last_torque);
        if (memory.reference_moved != 0.0) {
            const double mean_misfit = misfit / static_cast<double>(joints());
            add_information(1.0 - gains_.forgetting * (1.0 + std::min(mean_misfit, max_misfit)), memory);
            factorize(factors_);
            copy(memory.information.row(p_).first(p_), memory.estimate);
            solve(factors_, memory.estimate);
            for (size_t k = 0; k < p_; ++k) { memory.estimate[k] *= gains_.prior_deviations[k]; }
        }
        for (size_t i = 0; i < joints(); ++i) {
            for (size_t k = 0; k < p_; ++k) {
                observed.disturbance[i] += memory.regressor(i, k) * (memory.estimate[k] - previous_estimate_[k]);
            }
        }
    }

    // Filters regressor and torque, in units of prior and noise; the sum of the squares of what the estimate does not explain.
    double filter(Memory& memory, Vector last_torque) const {
        double misfit = 0.0;
        for (size_t i = 0; i < joints(); ++i) {
            memory.regressor(i, p_) = last_torque[i] + memory.fed_forward[i] - observer_.needed[i];
            double residual = 0.0;
            for (size_t k = p_ + 1; k-- > 0;) {
                double& first = memory.filtered[0](i, k);
                double& second = memory.filtered[1](i, k);
                const double unit = k < p_ ? gains_.prior_deviations[k] : 1.0;
                first += gains_.filter_weight * (gains_.torque_precision[i] * unit * memory.regressor(i, k) - first);
                second += gains_.filter_weight * (first - second);
                residual += k < p_ ? -second * memory.estimate[k] / unit : second;
            }
            misfit += residual * residual;
        }
        return misfit;
    }

    // Adds the information of one control period to that which is kept, and the prior to the copy that is to be factorized.
    void add_information(double keep, Memory& memory) {
        const MatrixResult Y = memory.filtered[1];
        for (size_t k = 0; k <= p_; ++k) {
            for (size_t j = 0; j <= k; ++j) {
                double total = 0.0;
                for (size_t i = 0; i < Y.rows; ++i) { total += Y(i, k) * Y(i, j); }
                memory.information(k, j) = keep * memory.information(k, j) + gains_.information_weight * total;
                if (k < p_) { factors_(k, j) = memory.information(k, j); }
            }
        }
        for (size_t k = 0; k < p_; ++k) { factors_(k, k) += 1.0; }  // the prior, in units of its standard deviations
    }

    // The torque of the reference with the present estimate, and how fast it changed since the last tick.
    void find_rates(const Setpoint& setpoint, bool is_first, Memory& memory) {
        const Vector payload = memory.estimate.first(body_parameters);
        for (size_t i = 0; i < joints(); ++i) { rate_[i] = -dot(memory.regressor.row(i), payload, memory.needed[i]); }
        payload_regressor(observer_.dynamics, setpoint.q, setpoint.v_tick, setpoint.a_tick, memory.regressor);
        observer_.dynamics.inverse_dynamics(setpoint.q, setpoint.v_tick, setpoint.a_tick, memory.needed);
        for (size_t i = 0; i < joints(); ++i) {
            rate_[i] += dot(memory.regressor.row(i), payload, memory.needed[i]);
            rate_[i] = is_first || dt() == 0.0 ? 0.0 : rate_[i] / dt();
        }
    }

    // Completes the regressor, and finds the torque that is fed forward.
    void feed_forward(Vector v_ref, Memory& memory) const {
        const MatrixResult Y = memory.regressor;
        bool moves = false;
        for (size_t i = 0; i < Y.rows; ++i) {
            Y(i, delay_unknown) = rate_[i];
            Y(i, first_friction_unknown + i) = v_ref[i] / (std::abs(v_ref[i]) + friction_speed);
            memory.fed_forward[i] = dot(Y.row(i), memory.estimate);
            if (dt() != 0.0) {  // what is fed forward against the delay is late, too
                Y(i, delay_unknown) += memory.estimate[delay_unknown] * (rate_[i] - memory.last_rate[i]) / dt();
            }
            memory.last_rate[i] = rate_[i];
            moves = moves || v_ref[i] != 0.0;
        }
        memory.reference_moved = moves ? 1.0 : 0.0;
    }

    double dt() const { return observer_.gains().estimate.dt; }

    size_t p_ = unknown_count(joints());
    DisturbanceObserver observer_;
    ComputedTorqueLearningGains gains_;
    Mat factors_{p_, p_};
    Numbers previous_estimate_ = Numbers(p_);
    Numbers rate_ = zeros();  // (n,) N m/s, of the torque that the reference needs
};

}  // namespace armctl
