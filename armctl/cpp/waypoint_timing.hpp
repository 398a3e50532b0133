// Times of the sections and velocities and accelerations at the waypoints that make a motion through them fast.
//
// A joint with given states at both ends of a section of given time can cover any displacement between a least and a greatest
// one. The greatest is concave in those states: its acceleration rises to its limit, falls along a line c - j t and rises
// again, and if that is too fast it cruises at its greatest speed. So a motion is possible exactly if the displacement of every
// joint in every section lies between the two, and the fastest one is found by an interior-point method: the sum of the times
// plus a logarithmic barrier. A bound involves the two ends of a section and its time only, so that a Newton step factorizes a
// band matrix, in time in proportion to the number of waypoints. The Hessian leaves out the curvature of the bounds.
//
// That optimal profiles are such ramps and plateaus is Pontryagin's principle, e.g. Bryson and Ho, "Applied Optimal Control",
// chapter 3.
#pragma once

#include <array>
#include <vector>

#include "band_matrix.hpp"
#include "spans.hpp"

namespace armctl {

struct JointBounds {
    double v_max;
    double a_max;
    double j_max;
};

struct EndState {
    double v;
    double a;
};

// The greatest displacement of a joint in a section, NaN if there is none, and its derivatives.
struct Displacement {
    double distance;
    double by_time = 0.0;
    EndState by_start = {0.0, 0.0};
    EndState by_end = {0.0, 0.0};
};

Displacement farthest_displacement(double time, EndState start, EndState end, const JointBounds& joint);

class WaypointTiming {
public:
    // Waypoints q (K, n), the limits of the n joints, and the greatest velocity and acceleration of each joint at each
    // waypoint, (K, n): 0 holds it at 0.
    WaypointTiming(Matrix q, Vector v_max, Vector a_max, Vector j_max, Matrix v_bound, Matrix a_bound);

    size_t waypoint_count() const { return waypoint_count_; }
    size_t joint_count() const { return joints_.size(); }

    // Fills the velocities and accelerations (K, n) of the fastest motion. `durations` (K - 1) of the sections are replaced;
    // before the call they are long enough for a motion that stops at every waypoint.
    void solve(Result durations, MatrixResult v, MatrixResult a) const;

    // The problem for `minimize_with_barriers`: time plus barrier.
    double cost(Vector x, double barrier) const;
    void add_derivatives(Vector x, double barrier, Result gradient, BandMatrix& hessian) const;
    bool is_last(Vector x, double barrier) const;
    size_t band_width() const { return 2 * joints_.size() + 3; }

private:
    // A joint at a waypoint: where it is, and the greatest velocity and acceleration there.
    struct JointAtWaypoint {
        double q;
        double v_max;
        double a_max;
    };

    const JointAtWaypoint& at(size_t waypoint, size_t joint) const { return waypoints_[waypoint * joints_.size() + joint]; }

    // The unknowns go from waypoint to waypoint: velocity and acceleration of each joint, then the time of the section after
    // it.
    size_t velocity_row(size_t waypoint, size_t joint) const { return waypoint * (2 * joints_.size() + 1) + 2 * joint; }
    size_t time_row(size_t section) const { return velocity_row(section, joints_.size()); }
    EndState state(Vector x, size_t waypoint, size_t joint) const;

    double total_time(Vector x) const;
    double barrier_count() const;
    Displacement slack_of_displacement(Vector x, size_t section, size_t joint, double sign) const;
    void add_waypoint(Vector x, size_t waypoint, size_t joint, double barrier, Result gradient, BandMatrix& hessian) const;
    void add_section(Vector x, size_t section, size_t joint, double sign, double barrier, Result gradient, BandMatrix& hessian) const;

    size_t waypoint_count_;
    std::vector<JointBounds> joints_;
    std::vector<JointAtWaypoint> waypoints_;
};

}  // namespace armctl
