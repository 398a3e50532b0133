// The model of an arm: a tree of links whose joints each turn about, or slide along, their own z axis.
#pragma once
#include <cstdint>
#include <vector>

#include "spans.hpp"
#include "vectors.hpp"

namespace armctl {

// One value for each of the m joints, and for each of the n that the arm's motors drive. All are copied.
struct ArmArrays {
    // Of each joint.
    Matrix rotations;                       // (m, 9) of the joint's frame in its parent's frame, at position zero, row by row
    Matrix translations;                    // (m, 3) m
    std::span<const std::int64_t> slides;   // (m,) whether it slides
    std::span<const std::int64_t> parents;  // (m,) -1 for the base
    Vector masses;                          // (m,) kg
    Matrix centers;                         // (m, 3) m, of mass
    Matrix inertias;                        // (m, 6) kg m^2, xx yy zz xy xz yz about the center of mass
    Vector lifted_masses;                   // (m,) kg, of what gravity compensation lifts
    Matrix lifted_moments;                  // (m, 3) kg m
    Matrix stiffness;                       // (m, 3) linear, quadratic and cubic stiffness of the spring
    Vector spring_rest;                     // (m,) rad
    Vector offsets;                         // (m,) rad: joint positions are ratio q + offset
    Matrix ratio;                           // (m, n)
    // Of each of the n.
    Vector armature;       // (n,) kg m^2
    Matrix damping;        // (n, 3) linear, quadratic and cubic
    Vector friction_loss;  // (n,) N m
    Vector friction_gain;  // (n,) kg m^2
    Vector friction_rate;  // (n,) 1/s
    // Of the arm.
    size_t chain_length = 0;  // joints from the base to the tip; they come first
    Vector gravity;           // (3,) m/s^2
    Vector tip_rotation;      // (9,) of the tip in the last joint's frame, row by row
    Vector tip_translation;   // (3,) m
    bool implicit_damping = false;
    bool implicit_coriolis = false;
};

// A force with a linear, a quadratic and a cubic term.
struct Polynomial {
    double linear = 0.0;
    double quadratic = 0.0;
    double cubic = 0.0;

    // Force of a damper per velocity: d0 + d1 |v| + d2 v^2.
    double damping(double v) const {
        const double speed = std::abs(v);
        return linear + speed * (quadratic + speed * cubic);
    }
    // Force of a spring: x (k0 + k1 x + k2 x^2).
    double spring(double x) const { return x * (linear + x * quadratic + x * x * cubic); }
};

struct Joint {
    Rotation rotation;  // in the parent's frame, at position zero
    Vec3 translation;
    bool slides = false;
    int parent = -1;  // -1 for the base
    double mass = 0.0;
    Vec3 center;        // of mass
    Symmetric inertia;  // about the center of mass
    double lifted_mass = 0.0;
    Vec3 lifted_moment;
    Polynomial stiffness;
    double spring_rest = 0.0;
    double offset = 0.0;
};

// Dry friction by MuJoCo's law: clip(gain (a + rate v), +-loss). Source: MuJoCo documentation, Computation, "Constraint model".
struct DryFriction {
    double loss = 0.0;
    double gain = 0.0;
    double rate = 0.0;

    double torque(double v, double a) const;
};

// What acts on one of the arm's n.
struct Drive {
    double armature = 0.0;
    Polynomial damping;
    DryFriction friction;
};

// Immutable after its construction: threads share it.
struct ArmModel {
    explicit ArmModel(const ArmArrays& arrays);

    // The model for a control period of dt. If the arm moves continuously, forces are those in the middle of the period; if
    // not, the period is one step of MuJoCo. dt = 0 is continuous time.
    ArmModel for_period(double dt, bool continuous) const;

    size_t n() const { return drives.size(); }
    double ratio(size_t joint, size_t i) const { return ratios[joint * n() + i]; }
    // Linear damping that a step evaluates at its end, times the step: it acts as an additional inertia, kg m^2.
    double step_inertia(size_t i) const { return has_implicit_damping ? step * drives[i].damping.linear : 0.0; }

    std::vector<Joint> joints;
    std::vector<Drive> drives;
    std::vector<double> ratios;  // (m, n)
    size_t chain_length = 0;
    Vec3 gravity;
    Pose T_last_tip;

    bool is_plain = false;  // no joint follows another
    bool has_lift = false;
    bool has_springs = false;
    bool has_friction = false;
    bool has_implicit_damping = false;    // a step evaluates damping at the velocity at its end
    bool has_implicit_coriolis = false;   // and Coriolis forces
    bool has_implicit_nonlinear = false;  // and any force other than linear damping
    bool has_implicit_forces = false;

    double step = 0.0;       // s, of implicit forces; 0 for continuous time
    double half_step = 0.0;  // s, from the start of the period to the instant at which a continuous model is evaluated
};

}  // namespace armctl
