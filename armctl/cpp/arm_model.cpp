#include "arm_model.hpp"

#include <string>

#include "errors.hpp"

namespace armctl {

namespace {

Polynomial polynomial(Vector terms) { return {terms[0], terms[1], terms[2]}; }

int checked_parent(std::int64_t parent, size_t j) {
    if (parent < -1 || parent >= static_cast<std::int64_t>(j)) {
        throw InputError("parents: joint " + std::to_string(j) + " has the parent " + std::to_string(parent) +
                         "; need a joint before it, or -1 for the base");
    }
    return static_cast<int>(parent);
}

}  // namespace

ArmModel::ArmModel(const Arguments& given)
    : chain_length(given.count("chain_length")), gravity(vec3(given.vector(3, "gravity"))),
      T_last_tip{Rotation::from_rows(given.shaped({3, 3}, "tip_rotation")), vec3(given.vector(3, "tip_translation"))} {
    const size_t m = given.length("masses");
    const size_t n = given.length("armature");
    if (chain_length < 1 || chain_length > m) {
        throw InputError("chain_length: need 1 to " + std::to_string(m) + " joints, got " + std::to_string(chain_length));
    }
    for (size_t j = 0; j < m; ++j) {
        const Vector inertia = given.matrix(m, 6, "inertias").row(j);
        joints.push_back({
            .rotation = Rotation::from_rows(given.shaped({m, 3, 3}, "rotations").subspan(9 * j, 9)),
            .translation = vec3(given.matrix(m, 3, "translations").row(j)),
            .slides = given.integers(m, "slides")[j] != 0,
            .parent = checked_parent(given.integers(m, "parents")[j], j),
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
    const Vector ratio = given.shaped({m, n}, "ratio");
    ratios.assign(ratio.begin(), ratio.end());
    is_plain = m == n;
    has_lift = std::ranges::any_of(joints, [](const Joint& j) { return j.lifted_mass != 0.0 || norm(j.lifted_moment) != 0.0; });
    has_springs = std::ranges::any_of(joints, [](const Joint& joint) { return !joint.stiffness.is_zero(); });
    has_friction = std::ranges::any_of(drives, [](const Drive& drive) { return drive.friction.loss != 0.0; });
    const bool is_damped = std::ranges::any_of(drives, [](const Drive& drive) { return !drive.damping.is_zero(); });
    const bool is_all_linear = std::ranges::all_of(drives, [](const Drive& drive) { return drive.damping.is_linear(); });
    has_implicit_damping = given.flag("implicit_damping");
    // As in Pinocchio, Coriolis forces have no derivative where one joint follows another.
    has_implicit_coriolis = given.flag("implicit_coriolis") && is_plain;
    has_implicit_nonlinear = has_implicit_coriolis || (has_implicit_damping && !is_all_linear);
    has_implicit_forces = has_implicit_nonlinear || (has_implicit_damping && is_damped);
}

ArmModel ArmModel::for_period(double dt, bool continuous) const {
    ArmModel model = *this;
    model.step = continuous ? 0.0 : dt;
    model.half_step = continuous ? 0.5 * dt : 0.0;
    return model;
}

}  // namespace armctl
