// The model of an arm: a tree of links whose joints each turn about, or slide along, their own z axis.
#pragma once
#include <memory>

#include "errors.hpp"
#include "linear_algebra.hpp"
#include "loop_closure.hpp"
#include "vectors.hpp"

namespace armctl {

// A force with a linear, a quadratic and a cubic term.
struct Polynomial {
    double linear = 0.0;
    double quadratic = 0.0;
    double cubic = 0.0;

    bool is_linear() const { return quadratic == 0.0 && cubic == 0.0; }
    bool is_zero() const { return linear == 0.0 && is_linear(); }

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

    double torque(double v, double a) const { return std::clamp(gain * (a + rate * v), -loss, loss); }
};

// What acts on a passive joint of a closed loop, which no motor drives.
struct PassiveJoint {
    double armature = 0.0;
    Polynomial damping;
    DryFriction friction;
};

// What acts on one of the arm's n.
struct Drive {
    double armature = 0.0;
    Polynomial damping;
    DryFriction friction;
};

// What an arm is, in SI units.
struct ArmDescription {
    std::vector<Joint> joints;  // m, parents before children; those from the base to the tip come first
    std::vector<Drive> drives;  // n, that the motors drive
    Mat ratio;                  // (m, n): the positions of the joints are ratio q + their offsets
    size_t chain_length = 0;    // the joints from the base to the tip
    Vec3 gravity;
    Pose T_last_tip;                 // of the tip in the last joint's frame
    bool implicit_damping = false;   // whether a step evaluates damping at the velocity at its end
    bool implicit_coriolis = false;  // and Coriolis forces
};

// Immutable after its construction: threads share it.
struct ArmModel {
    explicit ArmModel(ArmDescription given)
        : joints(std::move(given.joints)), drives(std::move(given.drives)), ratio(std::move(given.ratio)), chain_length(given.chain_length),
          gravity(given.gravity), T_last_tip(given.T_last_tip), has_implicit_damping(given.implicit_damping) {
        checked_index(static_cast<std::int64_t>(chain_length) - 1, joints.size(), "chain_length");
        for (size_t j = 0; j < joints.size(); ++j) { checked_index(joints[j].parent + 1, j + 1, "parents"); }
        if (ratio.rows() != joints.size() || ratio.columns() != drives.size()) { throw InputError("ratio: need a row for each joint"); }
        is_plain = joints.size() == drives.size();
        has_lift = std::ranges::any_of(joints, [](const Joint& j) { return j.lifted_mass != 0.0 || norm(j.lifted_moment) != 0.0; });
        has_springs = std::ranges::any_of(joints, [](const Joint& joint) { return !joint.stiffness.is_zero(); });
        has_friction = std::ranges::any_of(drives, [](const Drive& drive) { return drive.friction.loss != 0.0; });
        const bool is_all_linear = std::ranges::all_of(drives, [](const Drive& drive) { return drive.damping.is_linear(); });
        // As in Pinocchio, Coriolis forces have no derivative where one joint follows another.
        has_implicit_coriolis = given.implicit_coriolis && is_plain;
        has_implicit_nonlinear = has_implicit_coriolis || (has_implicit_damping && !is_all_linear);
    }

    // The model for a control period of dt. If the arm moves continuously, forces are those in the middle of the period; if
    // not, the period is one step of MuJoCo. dt = 0 is continuous time.
    ArmModel for_period(double dt, bool continuous) const {
        ArmModel model = *this;
        model.step = continuous ? 0.0 : dt;
        model.half_step = continuous ? 0.5 * dt : 0.0;
        return model;
    }

    // The same arm with closed loops; `passive_joints` (m,) are zero for driven ones.
    ArmModel with_loops(Closure loops, std::vector<PassiveJoint> passive_joints) const {
        if (loops->m() != joints.size() || loops->n() != drives.size()) { throw InputError("loops: they are those of another arm"); }
        require_size(passive_joints, joints.size(), "passive_joints");
        ArmModel model = *this;
        model.closure = std::move(loops);
        model.passive = std::move(passive_joints);
        model.has_friction |= std::ranges::any_of(model.passive, [](const PassiveJoint& joint) { return joint.friction.loss != 0.0; });
        return model;
    }

    size_t n() const { return drives.size(); }
    // Linear damping that is evaluated at the end of the period, times the period: it acts as an additional inertia, kg m^2. So it
    // is in estimates of continuous motion, too: evaluated in the middle, large damping would let the velocity alternate.
    double step_inertia(size_t i) const { return (2.0 * half_step + (has_implicit_damping ? step : 0.0)) * drives[i].damping.linear; }

    std::vector<Joint> joints;
    std::vector<Drive> drives;
    Mat ratio;  // (m, n)
    size_t chain_length = 0;
    Vec3 gravity;
    Pose T_last_tip;
    Closure closure;                    // of closed loops; none in a tree
    std::vector<PassiveJoint> passive;  // of closed loops, (m,)

    bool is_plain = false;  // no joint follows another
    bool has_lift = false;
    bool has_springs = false;
    bool has_friction = false;
    bool has_implicit_damping = false;    // a step evaluates damping at the velocity at its end
    bool has_implicit_coriolis = false;   // and Coriolis forces
    bool has_implicit_nonlinear = false;  // and any force other than linear damping

    double step = 0.0;       // s, of implicit forces; 0 for continuous time
    double half_step = 0.0;  // s, from the start of the period to the instant at which a continuous model is evaluated
};

using Model = std::shared_ptr<const ArmModel>;

}  // namespace armctl
