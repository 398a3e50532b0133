// Joints that keep the tip on a path, step by step.
//
// The joints follow the twist of the path through the weighted pseudo-inverse of the Jacobian (Chan and Dubey, "A weighted
// least-norm solution based scheme for avoiding joint limits", IEEE Trans. Robotics and Automation 11(2), 1995) by Runge and
// Kutta's fourth-order rule, and Newton's method brings the tip back onto the path at each step.
#pragma once
#include "dynamics.hpp"

namespace armctl {

// A point of a path: where the tip is, and its twist by the length of the path, linear first, world axes.
struct PathPoint {
    Pose pose;
    Vector twist;
};

// It has scratch memory: use an object in one thread at a time. No call allocates memory.
class TipFollower {
public:
    // The ranges of the joints, (n,) each; a joint without bounds has infinite ones. Where a path leaves joints free, they go
    // to the middle of their ranges at the rate `centering`. An oriented path prescribes the tip's orientation too.
    TipFollower(const Model& model, Vector q_min, Vector q_max, double centering, bool oriented);

    size_t n() const { return ranges_.size(); }

    // How many numbers a twist has: 6, or 3 where only the point is followed.
    size_t rows() const { return square_.rows(); }

    // The joint velocities (n,) that make a twist of the tip at q (n,).
    void slope(Vector q, Vector twist, Result v);

    // Moves the joints from q (n,), where they have a slope (n,), a step along the path. `halfway` is the twist half a step
    // further. Returns whether the tip arrives.
    bool step(Vector q, Vector slope_here, double length, Vector halfway, const PathPoint& end, Result moved);

    // How far the tip at q (n,) is from a pose, m and rad.
    double distance(Vector q, const Pose& goal);

private:
    struct JointRange {
        double low;
        double width;  // 0 for a joint without bounds

        double middle() const { return low + 0.5 * width; }
        double room(double q) const;
    };

    double centering_speed(size_t joint, double q) const;
    void least_velocities(Vector q, Result twist, Result v);
    double error(const Pose& goal, Result twist) const;

    Dynamics dynamics_;
    std::vector<JointRange> ranges_;
    double centering_;
    DenseMatrix square_;  // of the tip's Jacobian, weighted
    std::array<double, 6> twist_{};
    Numbers velocity_, change_;  // (n,)
};

// The twists (T, 6) of the tip, linear first, world axes, at positions and velocities (T, n).
void tip_twists(Dynamics& dynamics, Matrix q, Matrix v, MatrixResult twists);

}  // namespace armctl
