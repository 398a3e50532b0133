"""Edits of models: a payload moves them as a welded body of that mass does, and a target stays where it is put."""

import mujoco
import numpy as np
import pytest
from synthetic import limb

from armctl.core.pose import Pose
from armctl.model.mjmodel import edit, target_marker

MASS = 1.5
CENTER = np.array([0.02, -0.03, 0.05])
MOMENTS = np.diag([0.004, 0.005, 0.006])
TIP = Pose([0.1, 0.02, 0.1], rpy=[0.3, -0.2, 0.5])


def spec_of(bodies: str) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(f'<mujoco><compiler angle="radian"/><worldbody>{bodies}</worldbody></mujoco>')


def dynamics(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Mass matrix, and the torques of gravity and speeds, somewhere."""
    data = mujoco.MjData(model)
    data.qpos[:] = np.linspace(0.3, -0.5, model.nq)
    data.qvel[:] = np.linspace(-0.4, 0.7, model.nv)
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    return M, data.qfrc_bias - data.qfrc_passive


@pytest.mark.parametrize("lifted", [False, True])
def test_a_payload_moves_an_arm_as_a_welded_body_of_its_mass_does(lifted):
    bodies = limb("a b c")
    if lifted:
        bodies = bodies.replace('<body name="C"', '<body gravcomp="1" name="C"')
    spec = spec_of(bodies)
    if lifted:
        model = spec.compile()
        body = model.body("C").id
        assert edit.payload_body(model, body) is None
        edit.add_payload_bodies(spec, model, {body: spec.body("C")})
    model = spec.compile()
    body = model.body("C").id
    assert (edit.payload_body(model, body) == body) is not lifted
    edit.add_payload(model, body, TIP, MASS, CENTER, MOMENTS)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    welded = spec_of(bodies)
    held = welded.body("C").add_body(name="held", pos=TIP.position, quat=TIP.quat)
    held.explicitinertial = True
    held.mass = MASS
    held.ipos = CENTER
    held.inertia = np.diag(MOMENTS)
    expected = welded.compile()
    for found, true in zip(dynamics(model), dynamics(expected), strict=True):
        assert found == pytest.approx(true, abs=1e-9)


def test_the_options_of_another_specification_are_taken_over():
    source = spec_of("")
    source.option.timestep = 0.0005
    source.option.gravity = [0.0, 0.1, -3.0]
    source.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    target = spec_of(limb("a"))
    edit.copy_options(source, target)
    model = target.compile()
    assert model.opt.timestep == 0.0005
    assert model.opt.gravity == pytest.approx([0.0, 0.1, -3.0])
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def test_a_target_is_added_once_starts_where_it_is_put_and_can_be_moved():
    spec = spec_of(limb("a"))
    assert target_marker.add_target(spec)
    assert not target_marker.add_target(spec)
    spec.add_key(name="home", qpos=[0.2])
    model = spec.compile()
    assert target_marker.is_movable(model)
    target_marker.set_target_start(model, np.array([0.3, 0.1, 0.2]))
    target_marker.set_target_start(model, np.array([9.0, 9.0, 9.0]))  # it is no longer at the origin
    assert model.key_mpos[0] == pytest.approx([0.3, 0.1, 0.2])
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert target_marker.target_pose(model, data).position == pytest.approx([0.3, 0.1, 0.2])
    target_marker.set_target(model, data, np.array([0.1, 0.2, 0.3]), np.array([0.0, 1.0, 0.0, 0.0]))
    assert target_marker.read_target(model, data).position == pytest.approx([0.1, 0.2, 0.3])
    assert target_marker.read_target(model, data).quat == pytest.approx([0.0, 1.0, 0.0, 0.0])
    assert target_marker.target_pose(model, data).position == pytest.approx([0.3, 0.1, 0.2])


def test_a_target_on_a_link_is_read_and_not_moved():
    model = spec_of(limb("a", '<body name="target" pos="0 0 0.1"/>')).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    before = target_marker.read_target(model, data).position
    assert not target_marker.is_movable(model)
    target_marker.set_target(model, data, np.zeros(3))
    target_marker.set_target_start(model, np.ones(3))
    mujoco.mj_forward(model, data)
    assert target_marker.read_target(model, data).position == pytest.approx(before)
