#include "tip_follower.hpp"

#include <algorithm>
#include <cmath>

#include "factorization.hpp"

namespace armctl {

namespace {

constexpr double max_change = 0.08;  // rad (m), of any joint in one step: four times as far as a step is meant to go
constexpr int max_newton_iterations = 8;
constexpr double newton_tolerance = 1e-10;  // m and rad
constexpr double damping = 1e-12;           // of the pseudo-inverse
constexpr double min_room = 1e-3;           // of a joint at a limit; in the middle of its range it is 1

// The rotation vector, in world axes, that turns one orientation to another.
Vec3 rotation_between(const Rotation& from, const Rotation& to) {
    const Rotation turn = {to * from.row_x(), to * from.row_y(), to * from.row_z()};  // to from^T
    const Quaternion unit = quaternion(turn);
    const double sine = std::sqrt(unit.x * unit.x + unit.y * unit.y + unit.z * unit.z);
    const double scale = sine > 0.0 ? 2.0 * std::atan2(sine, unit.w) / sine : 2.0;
    return {scale * unit.x, scale * unit.y, scale * unit.z};
}

}  // namespace

TipFollower::TipFollower(const std::shared_ptr<const ArmModel>& model, Vector q_min, Vector q_max, double centering, bool oriented)
    : dynamics_(model), centering_(centering), rows_(oriented ? 6 : 3), jacobian_(6 * model->n()), velocity_(model->n()),
      change_(model->n()) {
    for (size_t i = 0; i < model->n(); ++i) {
        const bool is_bounded = std::isfinite(q_min[i]) && std::isfinite(q_max[i]) && q_max[i] > q_min[i];
        ranges_.push_back(is_bounded ? JointRange{q_min[i], q_max[i] - q_min[i]} : JointRange{0.0, 0.0});
    }
}

// 1 in the middle of the range, less near its ends.
double TipFollower::JointRange::room(double q) const {
    if (width == 0.0) { return 1.0; }
    const double share = (q - low) / width;
    return std::max(4.0 * share * (1.0 - share), min_room);
}

// How fast a joint goes to the middle of its range if nothing else moves it.
double TipFollower::centering_speed(size_t joint, double q) const {
    const JointRange& range = ranges_[joint];
    return range.width == 0.0 ? 0.0 : centering_ * (range.middle() - q);
}

void TipFollower::slope(Vector q, Vector twist, Result v) {
    dynamics_.place(q);
    dynamics_.locate();
    const Result x = Result(twist_).first(rows_);
    std::copy(twist.begin(), twist.end(), x.begin());
    if (centering_ > 0.0) {
        const MatrixResult J = {jacobian_.data(), 6, n()};
        dynamics_.tip_jacobian(J);
        for (size_t i = 0; i < n(); ++i) {
            const double wanted = centering_speed(i, q[i]);
            for (size_t r = 0; r < x.size(); ++r) { x[r] -= J(r, i) * wanted; }
        }
    }
    least_velocities(q, x, v);
    if (centering_ > 0.0) {
        for (size_t i = 0; i < n(); ++i) { v[i] += centering_speed(i, q[i]); }
    }
}

bool TipFollower::step(Vector q, Vector slope_here, double length, Vector halfway, const PathPoint& end, Result moved) {
    const Result v = velocity_;
    std::fill(change_.begin(), change_.end(), 0.0);
    std::copy(slope_here.begin(), slope_here.end(), v.begin());
    for (int stage = 0; stage < 4; ++stage) {
        const bool is_inner = stage == 1 || stage == 2;
        const double weight = is_inner ? 2.0 : 1.0;
        for (size_t i = 0; i < n(); ++i) { change_[i] += length / 6.0 * weight * v[i]; }
        if (stage == 3) { break; }
        const bool reaches_end = stage == 2;
        for (size_t i = 0; i < n(); ++i) { moved[i] = q[i] + (reaches_end ? 1.0 : 0.5) * length * v[i]; }
        slope(moved, reaches_end ? end.twist : halfway, v);
    }
    for (size_t i = 0; i < n(); ++i) {
        if (!(std::abs(change_[i]) <= max_change)) { return false; }
        moved[i] = q[i] + change_[i];
    }
    const Result missing = Result(twist_).first(rows_);
    for (int iteration = 0; iteration < max_newton_iterations; ++iteration) {
        dynamics_.place(moved);
        dynamics_.locate();
        if (error(end.pose, missing) < newton_tolerance) { return true; }
        least_velocities(moved, missing, v);
        for (size_t i = 0; i < n(); ++i) { moved[i] += v[i]; }
    }
    return false;
}

double TipFollower::distance(Vector q, const Pose& goal) {
    dynamics_.place(q);
    dynamics_.locate();
    return error(goal, Result(twist_).first(rows_));
}

// The least joint velocities that make a twist, at the located joints; a joint near its limits counts for more. `twist` is
// replaced.
void TipFollower::least_velocities(Vector q, Result twist, Result v) {
    const size_t rows = twist.size();
    const MatrixResult J = {jacobian_.data(), 6, n()};
    const MatrixResult A = {square_.data(), rows, rows};
    dynamics_.tip_jacobian(J);
    for (size_t r = 0; r < rows; ++r) {
        for (size_t c = 0; c <= r; ++c) {
            double total = 0.0;
            for (size_t i = 0; i < n(); ++i) { total += ranges_[i].room(q[i]) * J(r, i) * J(c, i); }
            A(r, c) = total;
        }
        A(r, r) += damping;
    }
    factorize(A);
    solve({A.data, rows, rows}, twist);
    for (size_t i = 0; i < n(); ++i) {
        double total = 0.0;
        for (size_t r = 0; r < rows; ++r) { total += J(r, i) * twist[r]; }
        v[i] = ranges_[i].room(q[i]) * total;
    }
}

// Fills the twist (3,) or (6,) that takes the tip, at the located joints, to a pose, and returns its length.
double TipFollower::error(const Pose& goal, Result twist) const {
    const Pose tip = dynamics_.tip();
    const Vec3 linear = goal.translation - tip.translation;
    twist[0] = linear.x;
    twist[1] = linear.y;
    twist[2] = linear.z;
    if (twist.size() == 6) {
        const Vec3 angular = rotation_between(tip.rotation, goal.rotation);
        twist[3] = angular.x;
        twist[4] = angular.y;
        twist[5] = angular.z;
    }
    double squared = 0.0;
    for (const double part : twist) { squared += part * part; }
    return std::sqrt(squared);
}

void tip_twists(Dynamics& dynamics, Matrix q, Matrix v, MatrixResult twists) {
    const size_t n = q.columns;
    std::vector<double> jacobian(6 * n);
    const MatrixResult J = {jacobian.data(), 6, n};
    for (size_t k = 0; k < q.rows; ++k) {
        dynamics.place(q.row(k));
        dynamics.locate();
        dynamics.tip_jacobian(J);
        for (size_t r = 0; r < 6; ++r) {
            double total = 0.0;
            for (size_t i = 0; i < n; ++i) { total += J(r, i) * v(k, i); }
            twists(k, r) = total;
        }
    }
}

}  // namespace armctl
