// The model of an arm: a tree of links whose joints each turn about, or slide along, their own z axis.
#pragma once
#include <memory>

#include "arguments.hpp"
#include "errors.hpp"
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

// What acts on one of the arm's n.
struct Drive {
    double armature = 0.0;
    Polynomial damping;
    DryFriction friction;
};

// Immutable after its construction: threads share it.
struct ArmModel {
    // Of each of the m joints: `rotations` (m, 3, 3) and `translations` (m, 3) in the parent's frame at position zero, `slides`,
    // `parents` (-1 for the base), `masses`, `centers` (m, 3) of mass, `inertias` (m, 6) xx yy zz xy xz yz about the center of mass,
    // `lifted_masses` and `lifted_moments` (m, 3) of what gravity compensation lifts, `stiffness` (m, 3) and `spring_rest` of a
    // spring. Joint positions are `ratio` (m, n) q + `offsets`. Of each of the n that the motors drive: `armature`, `damping` (n,
    // 3), `friction_loss`, `friction_gain`, `friction_rate`. Of the arm: `chain_length`, the joints from the base to the tip, which
    // come first; `gravity`, `tip_rotation` and `tip_translation` in the last joint's frame, `implicit_damping` and
    // `implicit_coriolis` of a step. Units are SI.
    explicit ArmModel(const Arguments& given)
        : ratio(given.length("masses"), given.length("armature")),
          chain_length(checked_index(given.integer("chain_length") - 1, ratio.rows(), "chain_length") + 1),
          gravity(vec3(given.vector(3, "gravity"))),
          T_last_tip{Rotation::from_rows(given.shaped({3, 3}, "tip_rotation")), vec3(given.vector(3, "tip_translation"))} {
        const size_t m = ratio.rows();
        const size_t n = ratio.columns();
        for (size_t j = 0; j < m; ++j) {
            const Vector inertia = given.matrix(m, 6, "inertias").row(j);
            joints.push_back({
                .rotation = Rotation::from_rows(given.shaped({m, 3, 3}, "rotations").subspan(9 * j, 9)),
                .translation = vec3(given.matrix(m, 3, "translations").row(j)),
                .slides = given.integers(m, "slides")[j] != 0,
                .parent = static_cast<int>(checked_index(given.integers(m, "parents")[j] + 1, j + 1, "parents")) - 1,
                .mass = given.vector(m, "masses")[j],
                .center = vec3(given.matrix(m, 3, "centers").row(j)),
                .inertia = {inertia[0], inertia[1], inertia[2], inertia[3], inertia[4], inertia[5]},
                .lifted_mass = given.vector(m, "lifted_masses")[j],
                .lifted_moment = vec3(given.matrix(m, 3, "lifted_moments").row(j)),
                .stiffness = polynomial(given.matrix(m, 3, "stiffness").row(j)),
                .spring_rest = given.vector(m, "spring_rest")[j],
                .offset = given.vector(m, "offsets")[j],
            });
        }
        for (size_t i = 0; i < n; ++i) {
            drives.push_back({
                .armature = given.vector(n, "armature")[i],
                .damping = polynomial(given.matrix(n, 3, "damping").row(i)),
                .friction = {given.vector(n, "friction_loss")[i], given.vector(n, "friction_gain")[i], given.vector(n, "friction_rate")[i]},
            });
        }
        ratio.set(given.matrix(m, n, "ratio"));
        is_plain = m == n;
        has_lift = std::ranges::any_of(joints, [](const Joint& j) { return j.lifted_mass != 0.0 || norm(j.lifted_moment) != 0.0; });
        has_springs = std::ranges::any_of(joints, [](const Joint& joint) { return !joint.stiffness.is_zero(); });
        has_friction = std::ranges::any_of(drives, [](const Drive& drive) { return drive.friction.loss != 0.0; });
        const bool is_all_linear = std::ranges::all_of(drives, [](const Drive& drive) { return drive.damping.is_linear(); });
        has_implicit_damping = given.flag("implicit_damping");
        // As in Pinocchio, Coriolis forces have no derivative where one joint follows another.
        has_implicit_coriolis = given.flag("implicit_coriolis") && is_plain;
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

    size_t n() const { return drives.size(); }
    // Linear damping that is evaluated at the end of the period, times the period: it acts as an additional inertia, kg m^2. So it
    // is in estimates of continuous motion, too: evaluated in the middle, large damping would let the velocity alternate.
    double step_inertia(size_t i) const { return (2.0 * half_step + (has_implicit_damping ? step : 0.0)) * drives[i].damping.linear; }

    std::vector<Joint> joints;
    std::vector<Drive> drives;
    DenseMatrix ratio;  // (m, n)
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

    double step = 0.0;       // s, of implicit forces; 0 for continuous time
    double half_step = 0.0;  // s, from the start of the period to the instant at which a continuous model is evaluated

private:
    static Polynomial polynomial(Vector terms) { return {terms[0], terms[1], terms[2]}; }
};

using Model = std::shared_ptr<const ArmModel>;

}  // namespace armctl
