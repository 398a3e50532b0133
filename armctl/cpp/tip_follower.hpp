// Joints that keep the tip on a path, step by step.
//
// The joints follow the twist of the path through the weighted pseudo-inverse of the Jacobian (Chan and Dubey, "A weighted
// least-norm solution based scheme for avoiding joint limits", IEEE Trans. Robotics and Automation 11(2), 1995) by the midpoint
// rule, and Newton's method brings the tip back onto the path at each step.
#pragma once
#include "dynamics.hpp"

namespace armctl {

// It has scratch memory: use an object in one thread at a time. No call allocates memory.
class TipFollower {
public:
    // The ranges of the joints, (n,) each; a joint without bounds has infinite ones. Where a path leaves joints free, they go
    // to the middle of their ranges at the rate `centering`. An oriented path prescribes the tip's orientation too.
    TipFollower(const Model& model, Vector q_min, Vector q_max, double centering, bool oriented)
        : dynamics_(model), centering_(centering), square_(oriented ? 6 : 3, oriented ? 6 : 3), velocity_(model->n()) {
        for (size_t i = 0; i < model->n(); ++i) {
            const bool is_bounded = std::isfinite(q_min[i]) && std::isfinite(q_max[i]) && q_max[i] > q_min[i];
            ranges_.push_back(is_bounded ? JointRange{q_min[i], q_max[i] - q_min[i]} : JointRange{0.0, 0.0});
        }
    }

    size_t n() const { return ranges_.size(); }

    // How many numbers a twist has: 6, or 3 where only the point is followed.
    size_t rows() const { return square_.rows(); }

    // The joint velocities (n,) that make a twist of the tip at q (n,).
    void slope(Vector q, Vector twist, Result v) {
        dynamics_.locate(q);
        const Result x = Result(twist_).first(rows());
        copy(twist, x);
        const Matrix J = dynamics_.tip_jacobian();
        for (size_t i = 0; i < n(); ++i) {
            for (size_t r = 0; r < rows(); ++r) { x[r] -= J(r, i) * centering_speed(i, q[i]); }
        }
        least_velocities(q, x, v);
        for (size_t i = 0; i < n(); ++i) { v[i] += centering_speed(i, q[i]); }
    }

    // Moves the joints from q (n,), where they have a slope (n,), a step along the path to a pose of the tip. `halfway` is the twist
    // half a step further, by the length of the path, linear first, world axes. Returns whether the tip arrives.
    bool step(Vector q, Vector slope_here, double length, Vector halfway, const Pose& end, Result moved) {
        const Result v = velocity_;
        for (size_t i = 0; i < n(); ++i) { moved[i] = q[i] + 0.5 * length * slope_here[i]; }
        slope(moved, halfway, v);
        for (size_t i = 0; i < n(); ++i) {
            if (!(std::abs(length * v[i]) <= max_change)) { return false; }
            moved[i] = q[i] + length * v[i];
        }
        const Result missing = Result(twist_).first(rows());
        for (int iteration = 0; iteration < max_newton_iterations; ++iteration) {
            dynamics_.locate(moved);
            if (error(end, missing) < newton_tolerance) { return true; }
            least_velocities(moved, missing, v);
            for (size_t i = 0; i < n(); ++i) { moved[i] += v[i]; }
        }
        return false;
    }

private:
    static constexpr double max_change = 0.08;  // rad (m), of any joint in one step: four times as far as a step is meant to go
    static constexpr int max_newton_iterations = 8;
    static constexpr double newton_tolerance = 1e-10;  // m and rad
    static constexpr double damping = 1e-12;           // of the pseudo-inverse
    static constexpr double min_room = 1e-3;           // of a joint at a limit; in the middle of its range it is 1

    struct JointRange {
        double low;
        double width;  // 0 for a joint without bounds

        double middle() const { return low + 0.5 * width; }

        // 1 in the middle of the range, less near its ends.
        double room(double q) const {
            if (width == 0.0) { return 1.0; }
            const double share = (q - low) / width;
            return std::max(4.0 * share * (1.0 - share), min_room);
        }
    };

    // How fast a joint goes to the middle of its range if nothing else moves it.
    double centering_speed(size_t joint, double q) const {
        const JointRange& range = ranges_[joint];
        return range.width == 0.0 ? 0.0 : centering_ * (range.middle() - q);
    }

    // The least joint velocities that make a twist, at the located joints; a joint near its limits counts for more. `twist` is
    // replaced.
    void least_velocities(Vector q, Result twist, Result v) {
        const Matrix J = dynamics_.tip_jacobian();
        for (size_t r = 0; r < rows(); ++r) {
            for (size_t c = 0; c <= r; ++c) {
                square_(r, c) = 0.0;
                for (size_t i = 0; i < n(); ++i) { square_(r, c) += ranges_[i].room(q[i]) * J(r, i) * J(c, i); }
            }
            square_(r, r) += damping;
        }
        factorize(square_);
        solve(square_, twist);
        for (size_t i = 0; i < n(); ++i) { v[i] = ranges_[i].room(q[i]) * dot(J.column(i), twist); }
    }

    // Fills the twist (3,) or (6,) that takes the tip, at the located joints, to a pose, and returns its length.
    double error(const Pose& goal, Result twist) const {
        copy(Vector(numbers(difference(dynamics_.tip(), goal))).first(rows()), twist);
        return std::sqrt(dot(twist, twist));
    }

    Dynamics dynamics_;
    std::vector<JointRange> ranges_;
    double centering_;
    Mat square_;  // of the tip's Jacobian, weighted
    std::array<double, 6> twist_{};
    Numbers velocity_;  // (n,)
};

}  // namespace armctl
