"""Coriolis matrix, energies, center of mass, bodies, wrenches and regressor, judged by MuJoCo, Pinocchio and derivatives."""

import copy
from itertools import pairwise

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from arms import MISSING, arm_of, at_hand, some_of
from synthetic import TIED, limb, mjcf, motors, ties

import armctl
from armctl import Arm

STEP = 1e-6
SPRUNG = limb("a b c d", joint='damping="0.3 0.2" stiffness="1 0.5 0.2" springref="0.2" armature="0.1"')
TORSO = limb("torso", limb("a b c", '<site name="left" pos="0.1 0 0"/>') + limb("d e", '<site name="right" pos="0 0.1 0"/>'))
TWO_TIPS = "two arms on a torso"
LIFTED = limb("a b c", joint='armature="0.2"').replace('name="B"', 'name="B" gravcomp="0.6"')
MODELS = {
    TWO_TIPS: (mjcf(TORSO, motors("torso a b c d e")), {"tips": ["left", "right"]}),
    "springs, and a follower": (mjcf(SPRUNG, ties("c b 0.1 -0.5") + motors("a b d")), {}),
    "lifted by gravity compensation": (mjcf(LIFTED, motors("a b c")), {}),
    **{name: (mjcf(bodies, rest), how) for name, (bodies, rest, how, _) in TIED.items()},
}
ROBOTS = ("robot_arm_3dof", "panda", "ur5e", "kuka_iiwa_14", "kinova_gen3", "ufactory_xarm7")
QUICK = ["robot_arm_3dof", "panda", "ur5e", *MODELS]


@pytest.fixture(scope="module", params=some_of([*ROBOTS, *MODELS], QUICK))
def any_arm(request) -> Arm:
    name = request.param
    if name in MODELS:
        text, how = MODELS[name]
        return armctl.load(mujoco.MjSpec.from_string(text), **how)
    if not at_hand(name):
        pytest.skip(f"{name}: {MISSING}")
    return arm_of(name)


def states(arm: Arm, count: int = 5, seed: int = 0):
    rng = np.random.default_rng(seed)
    for q in arm.limits.random(arm.limits.clamp(arm.home), count, rng):
        yield q, rng.normal(size=arm.n), rng.normal(size=arm.n)


def moving(arm: Arm, q, v) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """MuJoCo at a state, with energies and without constraints."""
    model = copy.copy(arm.model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data = mujoco.MjData(model)
    data.qpos[:] = arm.qpos(q)
    data.qvel[:] = arm.qvel(v)
    mujoco.mj_forward(model, data)
    return model, data


def reduced(arm: Arm, J: np.ndarray) -> np.ndarray:
    return J[:, arm.joint_map.dof_adr] @ arm.joint_map.ratio


def slope(function, q: np.ndarray, v: np.ndarray):
    """The time derivative of a function of q, at the velocity v."""
    return (function(q + STEP * v) - function(q - STEP * v)) / (2 * STEP)


def test_the_coriolis_matrix_gives_mujocos_torque_and_its_difference_from_the_mass_matrix_is_skew_symmetric(any_arm):
    for q, v, _ in states(any_arm):
        C = any_arm.coriolis(q, v)
        _, fast = moving(any_arm, q, v)
        _, slow = moving(any_arm, q, 0 * v)
        expected = any_arm.joint_map.reduced(fast.qfrc_bias - slow.qfrc_bias)
        assert C @ v == pytest.approx(expected, abs=1e-10)
        skew = slope(any_arm.mass_matrix, q, v) - 2 * C
        assert skew + skew.T == pytest.approx(np.zeros_like(C), abs=1e-7)


def test_the_coriolis_matrix_is_linear_in_the_velocity(any_arm):
    for q, v, w in states(any_arm, 3):
        together = any_arm.coriolis(q, v + 2.0 * w)
        assert together == pytest.approx(any_arm.coriolis(q, v) + 2.0 * any_arm.coriolis(q, w), abs=1e-11)
        assert any_arm.coriolis(q, v) @ w == pytest.approx(any_arm.coriolis(q, w) @ v, abs=1e-11)


def test_the_energies_are_mujocos_and_gravity_is_the_derivative_of_the_potential_one(any_arm):
    is_lifted = any_arm.model.body_gravcomp.any()
    found = []
    for q, v, _ in states(any_arm):
        _, data = moving(any_arm, q, v)
        assert any_arm.kinetic_energy(q, v) == pytest.approx(data.energy[1], rel=1e-10, abs=1e-12)
        assert any_arm.gravity(q) @ v == pytest.approx(slope(any_arm.potential_energy, q, v), abs=1e-6)
        found.append((any_arm.potential_energy(q), data.energy[0]))
    if not is_lifted:  # MuJoCo takes compensation for a force, and counts bodies that stand still
        for before, after in pairwise(found):
            assert after[0] - before[0] == pytest.approx(after[1] - before[1], abs=1e-9)


def test_energy_is_kept_without_damping_and_torque(any_arm):
    for q, v, _ in states(any_arm, 3):
        damping = any_arm.inverse_dynamics(q, v, 0 * v) - any_arm.coriolis(q, v) @ v - any_arm.gravity(q)
        a = any_arm.forward_dynamics(q, v, damping)
        power = any_arm.gravity(q) @ v + v @ any_arm.mass_matrix(q) @ a + 0.5 * v @ slope(any_arm.mass_matrix, q, v) @ v
        assert power == pytest.approx(0.0, abs=1e-6 * (1 + np.abs(v) @ np.abs(any_arm.mass_matrix(q)) @ np.abs(a)))


def test_the_center_of_mass_is_that_of_mujocos_bodies_that_move(any_arm):
    model = any_arm.model
    carriers = set(model.jnt_bodyid[list(any_arm.joint_map.joints)].tolist())
    moved = []
    for body in range(1, model.nbody):
        if body in carriers or model.body_parentid[body] in moved:
            moved.append(body)
    mass = model.body_mass[moved]
    for q, _, _ in states(any_arm):
        model, data = moving(any_arm, q, 0 * q)
        J = np.zeros((len(moved), 3, model.nv))
        for k, body in enumerate(moved):
            mujoco.mj_jac(model, data, J[k], None, data.xipos[body], body)
        assert any_arm.center_of_mass(q) == pytest.approx(mass @ data.xipos[moved] / mass.sum(), abs=1e-12)
        expected = reduced(any_arm, np.tensordot(mass, J, 1) / mass.sum())
        assert any_arm.center_of_mass_jacobian(q) == pytest.approx(expected, abs=1e-12)


def test_every_body_is_where_mujoco_puts_it_and_moves_as_it_says(any_arm):
    names = [any_arm.model.body(b).name for b in range(any_arm.model.nbody)]
    for q, v, _ in states(any_arm, 2):
        model, data = moving(any_arm, q, v)
        jacp, jacr = np.zeros((2, 3, model.nv))
        for body, name in enumerate(names):
            if not name:
                continue
            pose = any_arm.fk(q, body=name)
            assert pose.position == pytest.approx(data.xpos[body], abs=1e-10)
            assert pose.rotation == pytest.approx(data.xmat[body].reshape(3, 3), abs=1e-10)
            mujoco.mj_jacBody(model, data, jacp, jacr, body)
            J = any_arm.jacobian(q, body=name)
            assert pytest.approx(reduced(any_arm, np.vstack([jacp, jacr])), abs=1e-10) == J
            mujoco.mj_jacDot(model, data, jacp, jacr, data.xpos[body], body)
            derivative = any_arm.jacobian_derivative(q, v, body=name)
            assert derivative == pytest.approx(reduced(any_arm, np.vstack([jacp, jacr])), abs=1e-9)


def test_the_derivative_of_the_jacobian_of_every_tip_is_that_of_differences(any_arm):
    for q, v, _ in states(any_arm, 3):
        for tip in any_arm.tips:
            expected = slope(lambda q, tip=tip: any_arm.jacobian(q, tip), q, v)
            assert any_arm.jacobian_derivative(q, v, tip) == pytest.approx(expected, abs=1e-8)
        assert np.array_equal(any_arm.jacobian_derivative(q, v), any_arm.jacobian_derivative(q, v, any_arm.tips[0]))


def test_the_layers_of_the_kinematic_hessian_are_derivatives_of_the_jacobian(any_arm: Arm):
    q = any_arm.limits.clamp(any_arm.home + 0.1)
    for unit in np.eye(any_arm.n):
        change = any_arm.jacobian(q + STEP * unit) - any_arm.jacobian(q - STEP * unit)
        assert any_arm.jacobian_derivative(q, unit) == pytest.approx(change / (2 * STEP), abs=1e-8)


def test_a_wrench_on_a_tip_is_the_force_that_mujoco_applies_there(any_arm):
    rng = np.random.default_rng(1)
    for q, v, tau in states(any_arm, 3):
        for frame in any_arm.tip_frames:
            wrench = rng.normal(size=6)
            model, data = moving(any_arm, q, v)
            force = np.zeros(model.nv)
            point = any_arm.fk(q, frame.name).position
            mujoco.mj_applyFT(model, data, wrench[:3], wrench[3:], point, frame.body, force)
            a = any_arm.forward_dynamics(q, v, tau, wrench, tip=frame.name)
            pushed = any_arm.forward_dynamics(q, v, tau + any_arm.joint_map.reduced(force))
            assert a == pytest.approx(pushed, rel=1e-9, abs=1e-9)
            assert any_arm.inverse_dynamics(q, v, a, wrench, tip=frame.name) == pytest.approx(tau, abs=1e-9)
        assert np.array_equal(
            any_arm.inverse_dynamics(q, v, v, wrench), any_arm.inverse_dynamics(q, v, v, wrench, tip=any_arm.tips[0])
        )


def test_the_regressor_times_the_parameters_is_the_torque_of_the_links(any_arm):
    armature = any_arm.joint_map.ratio.T**2 @ any_arm.model.dof_armature[any_arm.joint_map.dof_adr]
    for q, v, a in states(any_arm):
        _, data = moving(any_arm, q, v)
        links = any_arm.regressor(q, v, a) @ any_arm.inertial_parameters
        others = armature * a - any_arm.joint_map.reduced(data.qfrc_passive)
        assert links + others == pytest.approx(any_arm.inverse_dynamics(q, v, a), abs=1e-9)


def test_the_regressor_is_the_derivative_of_the_torque_by_the_parameters():
    """A changed link changes the torque by the column of each parameter: judged by Pinocchio's inverse dynamics."""
    arm = arm_of("robot_arm_3dof")
    rng = np.random.default_rng(0)
    for q, v, a in states(arm):
        Y = arm.regressor(q, v, a)
        for joint in range(arm.n):
            model = arm.pinocchio_model.pin_model.copy()
            before = pin.rnea(model, model.createData(), q, v, a)
            changes = 0.01 * rng.normal(size=10) + [1, 0, 0, 0, 0.5, 0, 0.5, 0, 0, 0.5]
            body = model.inertias[joint + 1].toDynamicParameters() + changes
            model.inertias[joint + 1] = pin.Inertia.FromDynamicParameters(body)
            after = pin.rnea(model, model.createData(), q, v, a)
            assert after - before == pytest.approx(Y[:, 10 * joint : 10 * joint + 10] @ changes, abs=1e-9)


def test_manipulability_is_yoshikawas():
    arm = armctl.load(mujoco.MjSpec.from_string(mjcf(limb("a b c d e f g"), motors("a b c d e f g"))))
    for q, _, _ in states(arm):
        J = arm.jacobian(q)
        for axes, rows in (("all", J), ("translation", J[:3]), ("rotation", J[3:])):
            assert arm.manipulability(q, axes=axes) == pytest.approx(np.sqrt(np.linalg.det(rows @ rows.T)), rel=1e-9)
    small = arm_of("robot_arm_3dof")
    assert small.manipulability(small.home) == 0.0
    assert small.manipulability(small.home + 0.2, axes="translation") > 0.0


def test_each_tip_has_a_manipulability():
    text, how = MODELS[TWO_TIPS]
    arm = armctl.load(mujoco.MjSpec.from_string(text), **how)
    q = arm.home + 0.3
    found = [arm.manipulability(q, tip, axes="translation") for tip in arm.tips]
    expected = [np.sqrt(np.linalg.det(J @ J.T)) for J in (arm.jacobian(q, tip)[:3] for tip in arm.tips)]
    assert found == pytest.approx(expected)
    assert found[0] != pytest.approx(found[1])


@pytest.mark.parametrize(
    ("call", "error", "sentence"),
    [
        (lambda arm: arm.fk(arm.home, body="nothing"), armctl.UnknownNameError, "body"),
        (lambda arm: arm.jacobian(arm.home, arm.tip, body="base"), armctl.InputError, "a tip or a body"),
        (lambda arm: arm.jacobian_derivative(arm.home, [0.0]), armctl.InputError, "v: expected 3 numbers"),
        (lambda arm: arm.jacobian_derivative(arm.home, arm.home, "nothing"), armctl.UnknownNameError, "tip"),
        (lambda arm: arm.inverse_dynamics(arm.home, arm.home, arm.home, [1.0]), armctl.InputError, "wrench: expected 6"),
        (lambda arm: arm.forward_dynamics(arm.home, arm.home, arm.home, tip=arm.tip), armctl.InputError, "without a wrench"),
        (lambda arm: arm.manipulability(arm.home, axes="x"), armctl.InputError, "axes: expected one of"),
        (lambda arm: arm.potential_energy([0.0]), armctl.InputError, "q: expected 3 numbers"),
    ],
)
def test_a_wrong_call_is_refused_in_one_sentence(call, error, sentence):
    with pytest.raises(error, match=sentence):
        call(arm_of("robot_arm_3dof"))
