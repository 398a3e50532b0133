#include "payload_estimator.hpp"

#include <algorithm>
#include <utility>

#include "../factorization.hpp"
#include "../law.hpp"
#include "memory_parts.hpp"

namespace armctl {

namespace {

constexpr double max_misfit = 50.0;  // mean square of the residual, in units of the noise, up to which forgetting accelerates

// The columns of [alpha] + [omega]^2: a point x of a body has the acceleration a + A x.
std::array<Vec3, 3> acceleration_field(const BodyMotion& motion) {
    const Vec3 w = motion.omega;
    const Vec3 alpha = motion.alpha;
    const double square = dot(w, w);
    return {{
        {w.x * w.x - square, w.y * w.x + alpha.z, w.z * w.x - alpha.y},
        {w.x * w.y - alpha.z, w.y * w.y - square, w.z * w.y + alpha.x},
        {w.x * w.z + alpha.y, w.y * w.z - alpha.x, w.z * w.z - square},
    }};
}

}  // namespace

// A point x of the body has the acceleration a + A x with A = [alpha] + [omega]^2 and a that of the tip minus gravity. Its
// force and moment about the tip are therefore m a + A h and h x a + sum over i, j of S_ij e_i x A e_j.
void payload_regressor(Dynamics& dynamics, Vector q, Vector v, Vector a, MatrixResult J, MatrixResult Y) {
    const BodyMotion motion = dynamics.tip_motion(q, v, a);
    const Rotation rotation = dynamics.tip().rotation;
    dynamics.tip_jacobian(J);
    const std::array<Vec3, 3> field = acceleration_field(motion);
    for (size_t i = 0; i < Y.rows; ++i) {
        const Vec3 linear = rotation.inverse_times({J(0, i), J(1, i), J(2, i)});
        const Vec3 angular = rotation.inverse_times({J(3, i), J(4, i), J(5, i)});
        // angular . (e_k x a) = e_k . (a x angular)
        const Vec3 moment = cross(motion.linear, angular);
        // Component i of vector k is angular . (e_i x A e_k).
        const Vec3 from_x = cross(field[0], angular);
        const Vec3 from_y = cross(field[1], angular);
        const Vec3 from_z = cross(field[2], angular);
        const Result row = Y.row(i);
        row[0] = dot(linear, motion.linear);
        row[1] = moment.x + dot(linear, field[0]);
        row[2] = moment.y + dot(linear, field[1]);
        row[3] = moment.z + dot(linear, field[2]);
        row[4] = from_x.x;
        row[5] = from_y.y;
        row[6] = from_z.z;
        row[7] = from_y.x + from_x.y;
        row[8] = from_z.x + from_x.z;
        row[9] = from_z.y + from_y.z;
    }
}

PayloadEstimator::Memory::Memory(std::span<double> numbers, size_t n) {
    const size_t p = unknown_count(n);
    MemoryParts parts(numbers);
    estimate = parts.vector(p);
    regressors = {parts.matrix(n, p), parts.matrix(n, p)};
    torques = {parts.vector(n), parts.vector(n)};
    information = parts.matrix(p, p);
    information_vector = parts.vector(p);
}

size_t PayloadEstimator::Memory::size(size_t n) {
    const size_t p = unknown_count(n);
    return p + 2 * n * p + 2 * n + p * p + p;
}

PayloadEstimator::PayloadEstimator(Settings settings)
    : filter_weight_(checked_gain(settings.filter_weight, "filter_weight")),
      information_weight_(checked_gain(settings.information_weight, "information_weight")),
      forgetting_(checked_gain(settings.forgetting, "forgetting")),
      factors_(settings.prior_deviations.size(), settings.prior_deviations.size()) {
    const size_t n = settings.torque_precision.size();
    torque_precision_ = checked_gains(std::move(settings.torque_precision), n, "torque_precision");
    prior_deviations_ = checked_gains(std::move(settings.prior_deviations), unknown_count(n), "prior_deviations");
}

void PayloadEstimator::learn(Matrix Y, Vector torque, bool is_moving, Memory& memory) {
    const double misfit = filter(Y, torque, memory);
    if (!is_moving) { return; }
    const double mean_misfit = misfit / static_cast<double>(Y.rows);
    add_information(1.0 - forgetting_ * (1.0 + std::min(mean_misfit, max_misfit)), memory);
    factorize(factors_);
    std::ranges::copy(memory.information_vector, memory.estimate.begin());
    solve(factors_, memory.estimate);
    for (size_t k = 0; k < memory.estimate.size(); ++k) { memory.estimate[k] *= prior_deviations_[k]; }
}

// Filters regressor and torque, in units of prior and noise; the sum of the squares of what the estimate does not explain.
double PayloadEstimator::filter(Matrix Y, Vector torque, Memory& memory) const {
    double misfit = 0.0;
    for (size_t i = 0; i < Y.rows; ++i) {
        const double scale = torque_precision_[i];
        double& first_torque = memory.torques[0][i];
        double& second_torque = memory.torques[1][i];
        first_torque += filter_weight_ * (scale * torque[i] - first_torque);
        second_torque += filter_weight_ * (first_torque - second_torque);
        double residual = second_torque;
        for (size_t k = 0; k < Y.columns; ++k) {
            double& first = memory.regressors[0](i, k);
            double& second = memory.regressors[1](i, k);
            first += filter_weight_ * (scale * prior_deviations_[k] * Y(i, k) - first);
            second += filter_weight_ * (first - second);
            residual -= second * memory.estimate[k] / prior_deviations_[k];
        }
        misfit += residual * residual;
    }
    return misfit;
}

// Adds the information of one control period to that which is kept, and the prior to the copy that is to be factorized.
void PayloadEstimator::add_information(double keep, Memory& memory) {
    const MatrixResult Y = memory.regressors[1];
    const Result torque = memory.torques[1];
    for (size_t k = 0; k < Y.columns; ++k) {
        double total = 0.0;
        for (size_t i = 0; i < Y.rows; ++i) { total += Y(i, k) * torque[i]; }
        memory.information_vector[k] = keep * memory.information_vector[k] + information_weight_ * total;
        for (size_t j = 0; j <= k; ++j) {
            total = 0.0;
            for (size_t i = 0; i < Y.rows; ++i) { total += Y(i, k) * Y(i, j); }
            memory.information(k, j) = keep * memory.information(k, j) + information_weight_ * total;
            factors_(k, j) = memory.information(k, j);
        }
        factors_(k, k) += 1.0;  // the prior, in units of its standard deviations
    }
}

}  // namespace armctl
