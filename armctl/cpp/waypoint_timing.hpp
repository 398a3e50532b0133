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

#include "arguments.hpp"

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

// Waypoints q (K, n), the limits of the n joints, and the greatest velocity and acceleration of each joint at each waypoint,
// (K, n): 0 holds it at 0.
struct Waypoints {
    explicit Waypoints(const Arguments& a) : arguments(a) {}

    const Arguments& arguments;
    size_t K = arguments.length("q");
    size_t n = arguments.length("v_max");
    Matrix q = arguments.matrix(K, n, "q");
    Vector v_max = arguments.vector(n, "v_max");
    Vector a_max = arguments.vector(n, "a_max");
    Vector j_max = arguments.vector(n, "j_max");
    Matrix v_bound = arguments.matrix(K, n, "v_bound");
    Matrix a_bound = arguments.matrix(K, n, "a_bound");
};

// Replaces a motion by the fastest one. It goes from waypoint to waypoint: velocity and acceleration of each joint, then the
// time of the section behind it, which must be long enough to stop at every waypoint.
void make_fastest(const Waypoints& waypoints, Result motion);

}  // namespace armctl
