#include "arm_model.hpp"

#include <algorithm>
#include <string>

#include "errors.hpp"

namespace armctl {

namespace {

Polynomial polynomial(Vector terms) { return {terms[0], terms[1], terms[2]}; }

Joint joint_of(const ArmArrays& arrays, size_t j) {
    const std::int64_t parent = arrays.parents[j];
    if (parent < -1 || parent >= static_cast<std::int64_t>(j)) {
        throw InputError("parents: joint " + std::to_string(j) + " has the parent " + std::to_string(parent) +
                         "; need a joint before it, or -1 for the base");
    }
    const Vector inertia = arrays.inertias.row(j);
    return {
        .rotation = Rotation::from_rows(arrays.rotations.row(j)),
        .translation = vec3(arrays.translations.row(j)),
        .slides = arrays.slides[j] != 0,
        .parent = static_cast<int>(parent),
        .mass = arrays.masses[j],
        .center = vec3(arrays.centers.row(j)),
        .inertia = {inertia[0], inertia[1], inertia[2], inertia[3], inertia[4], inertia[5]},
        .lifted_mass = arrays.lifted_masses[j],
        .lifted_moment = vec3(arrays.lifted_moments.row(j)),
        .stiffness = polynomial(arrays.stiffness.row(j)),
        .spring_rest = arrays.spring_rest[j],
        .offset = arrays.offsets[j],
    };
}

bool is_lifted(const Joint& joint) { return joint.lifted_mass != 0.0 || norm(joint.lifted_moment) != 0.0; }

bool is_zero(const Polynomial& force) { return force.linear == 0.0 && force.quadratic == 0.0 && force.cubic == 0.0; }

bool is_linear(const Polynomial& force) { return force.quadratic == 0.0 && force.cubic == 0.0; }

}  // namespace

double DryFriction::torque(double v, double a) const { return std::clamp(gain * (a + rate * v), -loss, loss); }

ArmModel::ArmModel(const ArmArrays& arrays)
    : chain_length(arrays.chain_length), gravity(vec3(arrays.gravity)),
      T_last_tip{Rotation::from_rows(arrays.tip_rotation), vec3(arrays.tip_translation)} {
    const size_t m = arrays.masses.size();
    if (chain_length < 1 || chain_length > m) {
        throw InputError("chain_length: need 1 to " + std::to_string(m) + " joints, got " + std::to_string(chain_length));
    }
    for (size_t j = 0; j < m; ++j) { joints.push_back(joint_of(arrays, j)); }
    for (size_t i = 0; i < arrays.armature.size(); ++i) {
        drives.push_back({
            .armature = arrays.armature[i],
            .damping = polynomial(arrays.damping.row(i)),
            .friction = {arrays.friction_loss[i], arrays.friction_gain[i], arrays.friction_rate[i]},
        });
    }
    ratios.assign(arrays.ratio.data, arrays.ratio.data + m * n());
    is_plain = m == n();
    has_lift = std::any_of(joints.begin(), joints.end(), is_lifted);
    has_springs = std::any_of(joints.begin(), joints.end(), [](const Joint& joint) { return !is_zero(joint.stiffness); });
    has_friction = std::any_of(drives.begin(), drives.end(), [](const Drive& drive) { return drive.friction.loss != 0.0; });
    const bool is_damped = std::any_of(drives.begin(), drives.end(), [](const Drive& drive) { return !is_zero(drive.damping); });
    const bool is_all_linear = std::all_of(drives.begin(), drives.end(), [](const Drive& drive) { return is_linear(drive.damping); });
    has_implicit_damping = arrays.implicit_damping;
    // As in Pinocchio, Coriolis forces have no derivative where one joint follows another.
    has_implicit_coriolis = arrays.implicit_coriolis && is_plain;
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
