"""A payload is a rigid body: mass, center of mass and inertia, in the model, in the plant and in a robot's setting."""

import contextlib
import types

import mujoco
import numpy as np
import pytest
from arms import arm_of
from synthetic import FAST, limb, mjcf, motors

import armctl

MASS = 0.73  # kg; of a hand, as its maker gives it
CENTER = np.array([-0.01, 0.02, 0.03])  # m
INERTIA = np.array([[0.0010, 0.0001, -0.0002], [0.0001, 0.0025, 0.0], [-0.0002, 0.0, 0.0017]])  # kg m^2
Q = np.array([0.3, -0.7, 0.9])


@pytest.fixture(params=[0.0, 0.5, 1.0], ids=["gravcomp 0", "gravcomp 0.5", "gravcomp 1"])
def arm(request) -> armctl.Arm:
    """Three joints; the tip is turned and shifted on a body that MuJoCo lifts or does not."""
    body = limb("a b c", joint='armature="0.01"').replace('name="C"', f'name="C" gravcomp="{request.param}"')
    spec = mujoco.MjSpec.from_string(mjcf(body, FAST + motors("a b c")))
    return armctl.load(spec, tip="C", tip_offset=armctl.Pose([0.05, 0.02, 0.1], rpy=[0.4, -0.8, 1.1]))


def added_inertia(arm: armctl.Arm) -> np.ndarray:
    """(3, 3) what a rigid body at the tip adds to the mass matrix: m Jc^T Jc + Jw^T R I R^T Jw, with MuJoCo's Jacobians."""
    model = arm.model
    data = mujoco.MjData(model)
    data.qpos[:] = arm.qpos(Q)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    tip = arm.fk(Q)
    linear = np.zeros((3, model.nv))
    angular = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, linear, angular, tip.position + tip.rotation @ CENTER, arm.tip_body)
    linear = linear[:, arm.dof_adr]
    angular = angular[:, arm.dof_adr]
    world = tip.rotation @ INERTIA @ tip.rotation.T
    return MASS * linear.T @ linear + angular.T @ world @ angular


def test_the_model_and_the_plant_carry_the_inertia_of_a_payload(arm: armctl.Arm):
    loaded = arm.with_payload(MASS, CENTER, INERTIA)
    plant = armctl.Plant(payload=MASS, payload_center=CENTER, payload_inertia=INERTIA)
    expected = arm.mass_matrix(Q) + added_inertia(arm)
    assert loaded.mass_matrix(Q) == pytest.approx(expected, rel=1e-9, abs=1e-12)
    model = plant.model(arm)
    data = mujoco.MjData(model)
    data.qpos[:] = arm.qpos(Q)
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    assert full[np.ix_(arm.dof_adr, arm.dof_adr)] == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert loaded.gravity(Q) == pytest.approx(arm.with_payload(MASS, CENTER).gravity(Q), abs=1e-12)


def test_the_makers_hand_gives_the_last_joint_of_fr3_its_inertia():
    """By the parallel axis theorem: link 7's own, plus the hand's moment about the joint's axis, which is the tip's z."""
    arm = arm_of("fr3")
    center = np.array([-0.01, 0.0, 0.03])  # 0.73 kg and these moments are in libfranka's documents
    moments = np.array([0.001, 0.0025, 0.0017])
    armature = arm.model.dof_armature[arm.dof_adr[6]]
    q = arm.home
    bare = arm.mass_matrix(q)[6, 6] - armature
    held = arm.with_payload(0.73, center, moments).mass_matrix(q)[6, 6] - armature
    assert held == pytest.approx(bare + moments[2] + 0.73 * (center[0] ** 2 + center[1] ** 2), rel=1e-6)
    assert held == pytest.approx(0.00189, rel=0.02)


def test_moments_along_the_axes_are_a_diagonal_matrix(arm: armctl.Arm):
    moments = [0.001, 0.0025, 0.0017]
    by_moments = arm.with_payload(MASS, CENTER, moments).mass_matrix(Q)
    assert by_moments.tolist() == arm.with_payload(MASS, CENTER, np.diag(moments)).mass_matrix(Q).tolist()


def test_a_controller_that_knows_the_payload_tracks_exactly(arm: armctl.Arm):
    loaded = arm.with_payload(MASS, CENTER, INERTIA)
    motion = armctl.move_j(loaded, [0.0, 0.0, 0.0], Q)
    log = armctl.simulate(loaded, "computed-torque", motion)
    assert np.abs(log.q - log.q_ref).max() < 1e-10
    point = arm.with_payload(MASS, CENTER)
    rigid = armctl.Plant(payload=1e-9, payload_inertia=[0.05, 0.05, 0.05])
    log = armctl.simulate(point, "computed-torque", motion, plant=rigid)
    assert np.abs(log.q - log.q_ref).max() > 1e-5


@pytest.mark.parametrize(
    ("inertia", "said"),
    [
        ([0.066, 0.086, 0.0125], "no body has the principal moments"),
        ([-0.01, 0.01, 0.01], "no body has the principal moments"),
        ([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], "not symmetric"),
        (np.eye(2), "expected three moments or a \\(3, 3\\) matrix"),
        ([1.0, 2.0], "expected 3 numbers, got 2"),
        ([np.nan, 1.0, 1.0], "expected a finite number"),
    ],
)
def test_an_inertia_that_no_body_has_is_refused(arm: armctl.Arm, inertia, said: str):
    with pytest.raises(armctl.InputError, match=f"^inertia: .*{said}"):
        arm.with_payload(MASS, CENTER, inertia)
    with pytest.raises(armctl.InputError, match=f"^payload_inertia: .*{said}"):
        armctl.Plant(payload=MASS, payload_inertia=inertia)


def test_an_inertia_without_a_mass_is_refused(arm: armctl.Arm):
    with pytest.raises(armctl.InputError, match="inertia: given for a payload without mass"):
        arm.with_payload(0.0, CENTER, INERTIA)


@pytest.mark.parametrize(
    "inertia", [[0.001, 0.0025, 0.0017], np.diag([0.001, 0.0025, 0.0017]), [0.001, 0, 0, 0, 0.0025, 0, 0, 0, 0.0017]]
)
def test_the_inertia_of_a_load_is_given_as_everywhere(inertia, monkeypatch):
    loads = []
    client = types.SimpleNamespace(
        RealtimeConfig=types.SimpleNamespace(kIgnore=0, kEnforce=1),
        Robot=lambda *_: types.SimpleNamespace(
            set_collision_behavior=lambda *_: None, set_load=lambda *load: loads.append(load)
        ),
    )
    monkeypatch.setattr("armctl.run.links.franka._calling", lambda _: contextlib.nullcontext(client))
    armctl.links.Franka("127.0.0.1", payload=0.73, payload_center=[-0.01, 0, 0.03], payload_inertia=inertia).open()
    assert loads == [(0.73, [-0.01, 0, 0.03], [0.001, 0, 0, 0, 0.0025, 0, 0, 0, 0.0017])]


def test_a_load_that_no_body_has_is_refused():
    with pytest.raises(armctl.InputError, match="payload_inertia"):
        armctl.links.Franka("127.0.0.1", payload=1.0, payload_inertia=[0.1, 0.1, 0.9])


@pytest.mark.parametrize("lifted", [0.0, 1.0])
def test_a_payload_at_a_further_tip_loads_the_joints_to_that_tip(lifted):
    left = limb("a b").replace('name="B"', f'name="B" gravcomp="{lifted}"')
    right = limb("c d").replace('name="D"', f'name="D" gravcomp="{lifted}"')
    spec = mujoco.MjSpec.from_string(mjcf(left + right, FAST + motors("a b c d")))
    arm = armctl.load(spec, tips=["B", "D"])
    q = np.array([0.3, -0.7, 0.9, 0.4])
    for tip in arm.tips:
        loaded = arm.with_payload(MASS, tip=tip)
        linear = arm.jacobian(q, tip)[:3]
        weight = MASS * -arm.model.opt.gravity
        assert loaded.gravity(q) - arm.gravity(q) == pytest.approx(linear.T @ weight, abs=1e-9)
        added = loaded.mass_matrix(q) - arm.mass_matrix(q)
        assert added == pytest.approx(MASS * linear.T @ linear, abs=1e-9)
    assert np.array_equal(arm.with_payload(MASS).gravity(q), arm.with_payload(MASS, tip=arm.tip).gravity(q))
    with pytest.raises(armctl.UnknownNameError, match="tip"):
        arm.with_payload(MASS, tip="hand")
