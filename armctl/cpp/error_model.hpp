// The squared error of a tip around one configuration, and the steps that decrease it.
#pragma once
#include "linear_algebra.hpp"
#include "region.hpp"

namespace armctl {

inline constexpr double ROTATION_WEIGHT = 1.0 / 3.0;  // reaches per rad: an error of 3 rad counts like an error of one reach
inline constexpr double MIN_DAMPING = 1e-12;
inline constexpr double TINIEST = 1e-300;  // a divisor that may be zero is at least this

// What the tip should reach, in reaches.
struct Goal {
    Pose pose;
    Constraint constraint;
};

// The weighted squared error, in squared reaches.
inline double squared(PoseError error, double rotation_weight) {
    return error.position * error.position + rotation_weight * rotation_weight * error.orientation * error.orientation;
}

// The bounds of a step: `bounds` or `free_bounds`.
using BoundsOf = Bounds Unknown::*;

// Half the squared error around a configuration: its gradient and its Hessian, by Gauss-Newton or with the curvature of the
// chain. It has scratch memory: one object for each thread.
class ErrorModel {
public:
    explicit ErrorModel(const Chain& chain) : n_(chain.n()), kinematics_(chain), states_(n_), best_(n_) {}

    const Chain& chain() const { return kinematics_.chain(); }
    ChainKinematics& kinematics() { return kinematics_; }
    const ChainKinematics& kinematics() const { return kinematics_; }

    // The goal of a target in m; one that is very far is moved nearer on its line.
    Goal goal(const Pose& target, Constraint constraint) const {
        const auto in_reaches = [this](double length) { return Bounds{-MAX_LENGTH, MAX_LENGTH}.clamp(length / chain().reach()); };
        const auto [x, y, z] = target.translation;
        const Vec3 away = Vec3{in_reaches(x), in_reaches(y), in_reaches(z)} - chain().base();
        const double factor = std::min(1.0, MAX_TARGET_REACHES / std::max(distance(away), TINIEST));
        return {{target.rotation, chain().base() + factor * away}, constraint};
    }

    // The model at q: error, Jacobian of the error, gradient and J^T J. Returns the errors in reaches and rad.
    //
    // The weight of the rotation is divided by 1 + `position_priority` times the position error (up to one reach).
    PoseError linearize(const Goal& goal, Vector q, double rotation_weight = ROTATION_WEIGHT, double position_priority = 0.0) {
        kinematics_.place(q);
        kinematics_.find_jacobian();
        const Pose& tip = kinematics_.tip();
        const bool is_oriented = goal.constraint != Constraint::position;
        error_.linear = goal.pose.translation - tip.translation;
        error_.angular = is_oriented ? rotation_error(goal.constraint, tip.rotation, goal.pose.rotation) : Vec3{};
        const PoseError error{norm(error_.linear), norm(error_.angular)};
        const double weight = is_oriented ? rotation_weight / (1.0 + position_priority * std::min(1.0, error.position)) : 0.0;
        error_.angular = weight * error_.angular;
        std::vector<Twist>& J = kinematics_.jacobian();
        for (size_t i = 0; i < n_; ++i) {
            if (has_free_axis(goal.constraint)) {
                // The turn about the free axis costs nothing.
                const Vec3& axis = axis_of(tip.rotation, free_axis(goal.constraint));
                J[i].angular -= dot(axis, J[i].angular) * axis;
            }
            J[i].angular = weight * J[i].angular;
            states_[i].gradient = dot(J[i], error_);
        }
        set_normal();
        return error;
    }

    // As for a goal: the error towards the nearest member of a region in reaches. What costs nothing leaves the Jacobian.
    PoseError linearize(const Region& region, Vector q, double rotation_weight = ROTATION_WEIGHT) {
        kinematics_.place(q);
        kinematics_.find_jacobian();
        const RegionError error = region_error(region, kinematics_.tip());
        error_ = {error.position, rotation_weight * error.rotation};
        std::vector<Twist>& J = kinematics_.jacobian();
        for (size_t i = 0; i < n_; ++i) {
            const Vec3 moved = region.frame.rotation.inverse_times(J[i].linear + cross(J[i].angular, error.lever));
            J[i].linear = {error.is_bounded[0] ? moved.x : 0.0, error.is_bounded[1] ? moved.y : 0.0, error.is_bounded[2] ? moved.z : 0.0};
            J[i].angular = rotation_weight * error.held(J[i].angular);
            states_[i].gradient = dot(J[i], error_);
        }
        set_normal();
        return error.size();
    }

    // Adds the chain's own curvature to J^T J: minus error . d^2 tip / dq_i dq_j, which is z_i x dp/dq_j for i <= j.
    //
    // The result is the Hessian of half the squared error, for a rotation up to the error's third order. If joints follow
    // others, nothing is added.
    void add_curvature(Constraint constraint) {
        if (chain().has_followers()) { return; }
        const std::vector<Twist>& J = kinematics_.jacobian();
        for (size_t i = 0; i < n_; ++i) {
            if (chain().joints()[i].slides) { continue; }
            const Vec3 axis = kinematics_.joints()[i].axis;
            const Vec3 bend = cross(error_.linear, axis);
            for (size_t j = i; j < n_; ++j) { normal_(j, i) -= dot(bend, J[j].linear); }
            if (constraint != Constraint::position) {
                const Vec3 turn = 0.5 * cross(error_.angular, axis);
                for (size_t j = i; j < n_; ++j) { normal_(j, i) -= dot(turn, J[j].angular); }
            }
        }
    }

    // Adds half of `weight` times the squared distance from a configuration.
    void add_pull(double weight, Vector from, Vector q) {
        for (size_t i = 0; i < n_; ++i) {
            states_[i].gradient += weight * (from[i] - q[i]);
            normal_(i, i) += weight;
        }
    }

    // Makes a damped step of q inside the bounds: unknowns pushed out of them are fixed there and the others solved again.
    //
    // Returns the largest move of a joint, or -1 if the damping is too small for a step that leads downhill; then none is made.
    double step(BoundsOf bounds_of, double damping, Result q) {
        const std::vector<Unknown>& unknowns = chain().unknowns();
        for (size_t i = 0; i < n_; ++i) {
            const Bounds& bounds = unknowns[i].*bounds_of;
            State& state = states_[i];
            state.at_bound = (q[i] <= bounds.low && state.gradient < 0) || (q[i] >= bounds.high && state.gradient > 0);
            state.step = 0.0;
        }
        for (int pass = 0; pass < ACTIVE_SET_PASSES; ++pass) {
            if (!solve_free(damping)) { return -1.0; }
            bool inside = true;
            for (size_t i = 0; i < n_; ++i) {
                State& state = states_[i];
                const double desired = q[i] + state.step;
                const double possible = (unknowns[i].*bounds_of).clamp(desired);
                if (!state.at_bound && possible != desired) {
                    state.at_bound = true;
                    state.step = possible - q[i];
                    inside = false;
                }
            }
            if (inside) { break; }
        }
        double longest = 0.0;
        for (const State& state : states_) { longest = std::max(longest, std::abs(state.step)); }
        const double share = std::min(1.0, MAX_STEP / std::max(longest, TINIEST));
        double moved = 0.0;
        for (size_t i = 0; i < n_; ++i) {
            const double before = q[i];
            q[i] = (unknowns[i].*bounds_of).clamp(before + share * states_[i].step);
            moved = std::max(moved, std::abs(q[i] - before));
        }
        return moved;
    }

    // The norm of the weighted error.
    double size() const { return std::sqrt(dot(error_, error_)); }

    double gradient(size_t i) const { return states_[i].gradient; }
    double hessian(size_t i, size_t j) const { return i < j ? normal_(j, i) : normal_(i, j); }

    // Remembers a configuration, and takes it back.
    void keep_best(Vector q) { copy(q, best_); }
    void take_best(Result q) const { copy(best_, q); }

private:
    static constexpr int ACTIVE_SET_PASSES = 3;
    static constexpr double MAX_STEP = 1.0;  // rad, or reaches for a slide joint
    // A target farther away is moved to this distance on its line: beyond it, the error is so large that a step's gain is lost to
    // rounding.
    static constexpr double MAX_TARGET_REACHES = 1e3;
    static constexpr double MAX_LENGTH = 1e307;  // reaches: a greater one overflows

    struct State {
        double gradient;
        double step;
        double rhs;            // right-hand side of the linear system, then of the triangular one
        double inverse_pivot;  // of its factor L D L^T
        bool at_bound;
    };

    // J^T J
    void set_normal() {
        const std::vector<Twist>& J = kinematics_.jacobian();
        for (size_t i = 0; i < n_; ++i) {
            for (size_t j = 0; j <= i; ++j) { normal_(i, j) = dot(J[i], J[j]); }
        }
    }

    // Solves (J^T J + damping I) step = gradient for the unknowns not at a bound; the others keep their step.
    //
    // Returns whether the matrix is positive definite, which J^T J always is, but not with the chain's own curvature.
    bool solve_free(double damping) {
        bool definite = true;
        const bool is_any_at_bound = std::ranges::any_of(states_, &State::at_bound);
        for (size_t i = 0; i < n_; ++i) {
            State& state = states_[i];
            double pivot = state.at_bound ? 1.0 : normal_(i, i) + damping;
            double total = state.at_bound ? state.step : state.gradient;
            for (size_t j = 0; j < n_ && is_any_at_bound && !state.at_bound; ++j) {
                if (states_[j].at_bound) { total -= hessian(i, j) * states_[j].step; }
            }
            for (size_t j = 0; j < i; ++j) {
                double value = state.at_bound || states_[j].at_bound ? 0.0 : normal_(i, j);
                for (size_t k = 0; k < j; ++k) { value -= factor_(i, k) * factor_(j, k); }
                factor_(i, j) = value;
            }
            for (size_t k = 0; k < i; ++k) {
                const double scaled = factor_(i, k) * states_[k].inverse_pivot;
                pivot -= scaled * factor_(i, k);
                total -= scaled * states_[k].rhs;
                factor_(i, k) = scaled;
            }
            definite = definite && (state.at_bound || pivot > 0.5 * damping);
            state.inverse_pivot = 1.0 / pivot;
            state.rhs = total;
        }
        for (size_t i = n_; i-- > 0;) {
            State& state = states_[i];
            state.step = state.rhs * state.inverse_pivot;
            for (size_t k = i + 1; k < n_; ++k) { state.step -= factor_(k, i) * states_[k].step; }
        }
        return definite;
    }

    size_t n_;
    ChainKinematics kinematics_;
    Twist error_;                // weighted
    std::vector<State> states_;  // (n,)
    Numbers best_;               // the configuration that is kept
    Mat normal_{n_, n_};         // the lower triangle of the Hessian
    Mat factor_{n_, n_};         // L
};

}  // namespace armctl
