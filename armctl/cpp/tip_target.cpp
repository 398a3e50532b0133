#include "tip_target.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "factorization.hpp"

namespace armctl {

namespace {

constexpr int MAX_ITERATIONS = 4;
// Square of the error in m and rad: a full action is more than a thousand times its root.
constexpr double REACHED_SQUARED = 1e-10;

// The twist from a tip to a goal: the difference of positions, and the sine of the angle times the axis.
Twist tip_error(const Pose& goal, const Pose& tip) {
    Twist error{.linear = goal.translation - tip.translation, .angular = {}};
    error.angular += 0.5 * cross(tip.rotation.x, goal.rotation.x);
    error.angular += 0.5 * cross(tip.rotation.y, goal.rotation.y);
    error.angular += 0.5 * cross(tip.rotation.z, goal.rotation.z);
    return error;
}

}  // namespace

Rotation turned(Vec3 turn, const Rotation& R) {
    const double angle = norm(turn);
    if (angle < 1e-12) { return R; }
    const Vec3 axis{turn.x / angle, turn.y / angle, turn.z / angle};
    const double cosine = std::cos(angle);
    const double sine = std::sin(angle);
    const double rest = 1.0 - cosine;
    const auto turned_axis = [&](Vec3 column) {
        const double along = dot(axis, column) * rest;
        return cosine * column + sine * cross(axis, column) + along * axis;
    };
    return {turned_axis(R.x), turned_axis(R.y), turned_axis(R.z)};
}

TipTarget::TipTarget(std::shared_ptr<const ArmModel> model, size_t components, double damping)
    : dynamics_(std::move(model)), components_(components), damping_(damping), start_(dynamics_.model().n()), jacobian_(6 * start_.size()) {
}

Pose TipTarget::tip(Vector q) {
    dynamics_.place(q);
    dynamics_.locate();
    return dynamics_.tip();
}

void TipTarget::follow(const Pose& goal, std::span<const ActionLimits> limits, Vector ways, Result target) {
    const size_t n = target.size();
    const MatrixResult J{jacobian_.data(), 6, n};
    std::array<double, 36> squares;
    const MatrixResult A{squares.data(), components_, components_};
    std::ranges::copy(target, start_.begin());
    for (int iteration = 0; iteration < MAX_ITERATIONS; ++iteration) {
        const Twist twist = tip_error(goal, tip(target));
        std::array<double, 6> error{twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.x, twist.angular.y, twist.angular.z};
        double rest = 0.0;
        for (size_t k = 0; k < components_; ++k) { rest += error[k] * error[k]; }
        if (rest < REACHED_SQUARED) { return; }
        dynamics_.tip_jacobian(J);
        for (size_t r = 0; r < components_; ++r) {
            for (size_t c = 0; c < components_; ++c) {
                double total = r == c ? damping_ : 0.0;
                for (size_t i = 0; i < n; ++i) { total += J(r, i) * J(c, i); }
                A(r, c) = total;
            }
        }
        factorize(A);
        solve({A.data, components_, components_}, Result(error).first(components_));
        for (size_t i = 0; i < n; ++i) {
            double change = 0.0;
            for (size_t r = 0; r < components_; ++r) { change += J(r, i) * error[r]; }
            const double moved = std::min(std::max(target[i] + change, start_[i] - ways[i]), start_[i] + ways[i]);
            target[i] = std::min(std::max(moved, limits[i].q_min), limits[i].q_max);
        }
    }
}

}  // namespace armctl
