"""The Pinocchio model and the inverse dynamics are MuJoCo's, on every arm at hand, at random states."""

import copy

import mujoco
import numpy as np
import pytest

import armctl
from armctl import Arm, Report
from armctl.robot.dynamics import Dynamics
from armctl.robot.parity import check_parity

DISABLE = mujoco.mjtDisableBit


def states(arm: Arm, count: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    low, high = np.maximum(arm.limits.q_min, -np.pi), np.minimum(arm.limits.q_max, np.pi)
    for _ in range(count):
        scale = 10.0 ** rng.uniform(-3, 0.5)  # dry friction sticks at small speeds and slips at large ones
        yield rng.uniform(low, high), scale * rng.normal(size=arm.n), scale * rng.normal(size=arm.n)


def mujoco_inverse(arm: Arm, q, v, a, *, friction: bool):
    """The torque by MuJoCo's own inverse of its discrete step, without contacts and joint limits."""
    model = copy.copy(arm.model)
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
    off = [DISABLE.mjDSBL_CONTACT, DISABLE.mjDSBL_LIMIT, DISABLE.mjDSBL_EQUALITY]
    for flag in off if friction else [*off, DISABLE.mjDSBL_FRICTIONLOSS]:
        model.opt.disableflags |= int(flag)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[arm.dof_adr], data.qacc[arm.dof_adr] = arm.qpos(q), v, a
    mujoco.mj_inverse(model, data)
    return data.qfrc_inverse[arm.dof_adr]


def test_kinematics_mass_matrix_and_bias_are_mujocos(arm: Arm):
    assert check_parity(arm, samples=50, seed=7) <= 1e-9


def test_inverse_dynamics_is_mujocos_discrete_inverse(arm: Arm):
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    for q, v, a in states(arm, 30):
        expected = mujoco_inverse(arm, q, v, a, friction=False)
        assert np.allclose(dynamics.inverse(q, v, a, arm.dt), expected, rtol=1e-11, atol=1e-11)


def test_dry_friction_is_mujocos(arm: Arm):
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    for q, v, a in states(arm, 30, seed=1):
        expected = mujoco_inverse(arm, q, v, a, friction=True)
        ours = dynamics.inverse(q, v, a, arm.dt) + dynamics.friction(q, v, a, arm.dt)
        assert np.allclose(ours, expected, rtol=1e-9, atol=0.01 * dynamics.friction_loss.max() + 1e-9)


def test_the_equations_of_motion_add_up(arm: Arm):
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    for q, v, a in states(arm, 10, seed=2):
        M = dynamics.mass_matrix(q)
        assert np.array_equal(M, M.T)
        assert np.linalg.eigvalsh(M).min() > 0
        springs = dynamics.gravity(q) - dynamics.bias(q, np.zeros(arm.n))
        assert np.allclose(dynamics.inverse(q, v, a), M @ a + dynamics.bias(q, v) + dynamics.damping * v + springs, atol=1e-9)


def test_the_jacobian_is_the_derivative_of_the_tip(arm: Arm):
    h = 1e-6
    for q, v, _ in states(arm, 10, seed=3):
        before, after = arm.fk(q - h * v), arm.fk(q + h * v)
        twist = arm.jacobian(q) @ v
        turn = after.rotation @ before.rotation.T
        spin = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / (4 * h)
        scale = max(1.0, float(np.abs(twist).max()))
        assert np.allclose(twist[:3], (after.position - before.position) / (2 * h), atol=1e-7 * scale)
        assert np.allclose(twist[3:], spin, atol=1e-7 * scale)


def test_many_tips_at_once_are_each_tip(arm: Arm):
    q = np.array([q for q, _, _ in states(arm, 20, seed=4)])
    positions, rotations = arm.fk_many(q)
    for k in range(len(q)):
        T = arm.fk(q[k])
        assert np.allclose(positions[k], T.position, atol=1e-13)
        assert np.allclose(rotations[k], T.rotation, atol=1e-13)


CHAIN = """
<mujoco><option integrator="{integrator}"><flag eulerdamp="{eulerdamp}"/></option>
<worldbody><body pos="0.1 0 0.2" euler="10 20 30" gravcomp="{gravcomp}">
  <joint name="a" axis="0.3 1 0.2" ref="15" damping="0.3 0.1 0.05" stiffness="2 1 0.5" springref="20" range="-90 90"/>
  <joint name="b" type="slide" axis="1 0 1" pos="0.02 0 0" ref="0.1" armature="0.2" range="-0.5 0.5"/>
  <inertial pos="0.1 0.02 0.3" mass="1.5" fullinertia="0.05 0.04 0.03 0.002 0.003 0.001"/>
  <body pos="0 0.1 0.3" quat="0.5 0.5 -0.5 0.5" gravcomp="{gravcomp}">
    <joint name="c" axis="0 0 1" pos="0 0.1 0" frictionloss="0.4" damping="0.2" range="-170 170"/>
    <geom type="box" size="0.05 0.1 0.2" mass="0.8"/>
    <site name="tip" pos="0 0 0.3" euler="0 45 0"/>
  </body>
</body></worldbody>
<actuator><motor joint="a" gear="-3" armature="0.01" damping="0.02" ctrlrange="-9 9"/>
<position joint="b" kp="100" forcerange="-40 40"/><velocity joint="c" kv="3" forcerange="-20 20"/></actuator></mujoco>
"""


@pytest.mark.parametrize("gravcomp", [0, 0.7])
@pytest.mark.parametrize(
    ("integrator", "eulerdamp"), [("implicitfast", "enable"), ("Euler", "enable"), ("Euler", "disable"), ("implicit", "enable")]
)
def test_everything_a_joint_can_have_is_in_the_dynamics(tmp_path, gravcomp: float, integrator: str, eulerdamp: str):
    """Two joints on one body, reference angles, springs and damping with higher powers, gears, gravity compensation."""
    path = tmp_path / "chain.xml"
    path.write_text(CHAIN.format(gravcomp=gravcomp, integrator=integrator, eulerdamp=eulerdamp))
    arm = armctl.load(path)
    assert arm.joint_names == ("a", "b", "c")
    assert check_parity(arm, samples=20, seed=1) <= 1e-12
    motion = armctl.move_j(arm, arm.home, arm.home + np.array([0.5, 0.2, -0.6]))
    assert Report.from_log(armctl.simulate(arm, "computed-torque", motion)).joint_max_rad <= 1e-9
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    for q, v, a in states(arm, 30, seed=5):
        if eulerdamp == "disable":
            break  # mj_inverse takes damping at the end of the step all the same; the simulation above is the judge
        assert np.allclose(
            dynamics.inverse(q, v, a, arm.dt), mujoco_inverse(arm, q, v, a, friction=False), rtol=1e-11, atol=1e-11
        )
