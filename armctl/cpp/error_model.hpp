// The squared error of a tip around one configuration, and the steps that decrease it.
#pragma once
#include <vector>

#include "chain_kinematics.hpp"

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
    explicit ErrorModel(const Chain& chain);

    const Chain& chain() const { return kinematics_.chain(); }
    ChainKinematics& kinematics() { return kinematics_; }
    const ChainKinematics& kinematics() const { return kinematics_; }

    // The goal of a target in m; one that is very far is moved nearer on its line.
    Goal goal(const Pose& target, Constraint constraint) const;

    // The model at q: error, Jacobian of the error, gradient and J^T J. Returns the errors in reaches and rad.
    //
    // The weight of the rotation is divided by 1 + `position_priority` times the position error (up to one reach).
    PoseError linearize(const Goal& goal, Vector q, double rotation_weight = ROTATION_WEIGHT, double position_priority = 0.0);

    // Adds the chain's own curvature to J^T J: minus error . d^2 tip / dq_i dq_j, which is z_i x dp/dq_j for i <= j.
    //
    // The result is the Hessian of half the squared error, for a rotation up to the error's third order. If joints follow
    // others, nothing is added.
    void add_curvature(Constraint constraint);

    // Adds half of `weight` times the squared distance from a configuration.
    void add_pull(double weight, Vector from, Vector q);

    // Makes a damped step of q inside the bounds: unknowns pushed out of them are fixed there and the others solved again.
    //
    // Returns the largest move of a joint, or -1 if the damping is too small for a step that leads downhill; then none is made.
    double step(BoundsOf bounds_of, double damping, Result q);

    // The part of a desired step (n,) in the null space of J, shortened to its bounds; joints at theirs take no part.
    void null_step(Constraint constraint, Vector desired, Vector low, Vector high, Result step);

    // The norm of the weighted error.
    double size() const;
    double gradient(size_t i) const { return states_[i].gradient; }
    double hessian(size_t i, size_t j) const { return i < j ? normal_[j * n_ + i] : normal_[i * n_ + j]; }

    // Remembers a configuration, and takes it back.
    void keep_best(Vector q);
    void take_best(Result q) const;

private:
    struct State {
        double gradient;
        double step;
        double best;   // the unknown in the configuration that is kept
        double rhs;    // right-hand side of the linear system, packed: only free unknowns
        double pivot;  // inverse diagonal of its factor, packed
        bool at_bound;
    };

    Vec3 rotation_error(const Goal& goal) const;
    bool solve_free(double damping);
    double& normal(size_t i, size_t j) { return normal_[i * n_ + j]; }
    double& factor(size_t i, size_t j) { return factor_[i * n_ + j]; }

    size_t n_;
    ChainKinematics kinematics_;
    Twist error_;                 // weighted
    std::vector<State> states_;   // (n,)
    std::vector<double> normal_;  // (n, n), the lower triangle of the Hessian
    std::vector<double> factor_;  // (n, n), the packed factor L of L D L^T
};

}  // namespace armctl
