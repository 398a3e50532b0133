"""Kinematics and dynamics agree with MuJoCo on every installed arm and on synthetic ones, at random states."""

import copy
import dataclasses
import pickle
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest
from pinocchio_step import PinocchioStep
from synthetic import TIED, limb, mjcf, motors, ties

import armctl
from armctl import Arm, Report, _core
from armctl.model.arm.core_model import quaternions
from armctl.model.arm.dynamics import Dynamics
from armctl.model.arm.parity import check_parity

DISABLE = mujoco.mjtDisableBit


def states(arm: Arm, count: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    for q in arm.limits.random(arm.limits.clamp(arm.home), count, rng):
        scale = 10.0 ** rng.uniform(-3, 0.5)  # dry friction sticks at small speeds and slips at large ones
        yield q, scale * rng.normal(size=arm.n), scale * rng.normal(size=arm.n)


def mujoco_inverse(arm: Arm, q, v, a, *, friction: bool):
    """The torque by MuJoCo's own inverse of its discrete step, without contacts and joint limits."""
    model = copy.copy(arm.model)
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
    off = [DISABLE.mjDSBL_CONTACT, DISABLE.mjDSBL_LIMIT, DISABLE.mjDSBL_EQUALITY]
    for flag in off if friction else [*off, DISABLE.mjDSBL_FRICTIONLOSS]:
        model.opt.disableflags |= int(flag)
    data = mujoco.MjData(model)
    data.qpos[:] = arm.qpos(q)
    data.qvel[arm.dof_adr] = v
    data.qacc[arm.dof_adr] = a
    mujoco.mj_inverse(model, data)
    return data.qfrc_inverse[arm.dof_adr]


def test_kinematics_mass_matrix_and_bias_are_mujocos(arm: Arm):
    assert check_parity(arm, samples=50, seed=7) <= 1e-9


def test_inverse_dynamics_is_mujocos_discrete_inverse(arm: Arm):
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    for q, v, a in states(arm, 30):
        expected = mujoco_inverse(arm, q, v, a, friction=False)
        assert np.allclose(dynamics.discrete_inverse_dynamics(q, v, a, arm.dt), expected, rtol=1e-11, atol=1e-11)


def test_dry_friction_is_mujocos(arm: Arm):
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    for q, v, a in states(arm, 30, seed=1):
        expected = mujoco_inverse(arm, q, v, a, friction=True)
        friction = dynamics.friction(v, dynamics.explicit_acceleration(q, v, a, arm.dt))
        ours = dynamics.discrete_inverse_dynamics(q, v, a, arm.dt) + friction
        assert np.allclose(ours, expected, rtol=1e-9, atol=0.01 * dynamics.friction_loss.max() + 1e-9)


def test_the_equations_of_motion_add_up(arm: Arm):
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    for q, v, a in states(arm, 10, seed=2):
        M = dynamics.mass_matrix(q)
        assert np.array_equal(M, M.T)
        assert np.linalg.eigvalsh(M).min() > 0
        springs = dynamics.gravity(q) - dynamics.bias(q, np.zeros(arm.n))
        tau = M @ a + dynamics.bias(q, v) + dynamics.damping * v + springs
        assert np.allclose(dynamics.inverse_dynamics(q, v, a), tau, atol=1e-9)


def test_the_jacobian_is_the_derivative_of_the_tip(arm: Arm):
    h = 1e-6
    for q, v, _ in states(arm, 10, seed=3):
        before = arm.fk(q - h * v)
        after = arm.fk(q + h * v)
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


def test_the_bits_of_a_tip_do_not_depend_on_how_many_are_computed_at_once(arm: Arm):
    q = np.array([q for q, _, _ in states(arm, 50, seed=5)])
    positions, rotations = arm.fk_many(q)
    for rows in (slice(49, 50), slice(29, 50), slice(1, 50, 2)):
        some = arm.fk_many(q[rows])
        assert np.array_equal(some[0], positions[rows])
        assert np.array_equal(some[1], rotations[rows])


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
            dynamics.discrete_inverse_dynamics(q, v, a, arm.dt),
            mujoco_inverse(arm, q, v, a, friction=False),
            rtol=1e-11,
            atol=1e-11,
        )


@pytest.mark.parametrize("solref", ["0.03 1", "-2500 -90"])
def test_dry_friction_has_the_stiffness_of_its_constraint(tmp_path, solref: str):
    path = tmp_path / "chain.xml"
    text = CHAIN.format(gravcomp=0, integrator="implicitfast", eulerdamp="enable")
    path.write_text(text.replace('frictionloss="0.4"', f'frictionloss="0.4" solreffriction="{solref}"'))
    arm = armctl.load(path)
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    for q, v, a in states(arm, 30, seed=12):
        expected = mujoco_inverse(arm, q, v, a, friction=True)
        friction = dynamics.friction(v, dynamics.explicit_acceleration(q, v, a, arm.dt))
        ours = dynamics.discrete_inverse_dynamics(q, v, a, arm.dt) + friction
        assert np.allclose(ours, expected, rtol=1e-9, atol=0.004)


def test_the_payload_regressor_is_the_torque_of_a_body(tmp_path):
    """Of opposite centers, the torques differ by twice the part that is linear in the center."""
    path = tmp_path / "chain.xml"
    path.write_text(CHAIN.format(gravcomp=0, integrator="implicitfast", eulerdamp="enable"))
    arm = armctl.load(path)
    center = np.array([0.06, -0.04, 0.09])
    ahead, behind, at_tip = (arm.with_payload(0.7, sign * center) for sign in (1, -1, 0))
    inertia = np.array([[0.0010, 0.0001, -0.0002], [0.0001, 0.0025, 0.0], [-0.0002, 0.0, 0.0017]])
    body = arm.with_payload(0.7, center, inertia)
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    for q, v, a in states(arm, 10, seed=9):
        Y = dynamics.payload_regressor(q, v, a)
        linear = 0.5 * (ahead.inverse_dynamics(q, v, a) - behind.inverse_dynamics(q, v, a))
        assert Y[:, 1:4] @ (0.7 * center) == pytest.approx(linear, abs=1e-10)
        turning = body.inverse_dynamics(q, v, a) - ahead.inverse_dynamics(q, v, a)
        assert Y[:, 4:] @ inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]] == pytest.approx(turning, abs=1e-10)
        assert Y[:, 0] * 0.7 == pytest.approx(at_tip.inverse_dynamics(q, v, a) - arm.inverse_dynamics(q, v, a), abs=1e-10)


def test_discrete_inverse_dynamics_does_not_depend_on_earlier_calls(bundled: Arm):
    shared = Dynamics(bundled.model, bundled.pinocchio_model)
    for q, v, a in states(bundled, 5, seed=6):
        for dt in (0.001, 0.004, 0.001):
            fresh = Dynamics(bundled.model, bundled.pinocchio_model)
            assert np.array_equal(shared.discrete_inverse_dynamics(q, v, a, dt), fresh.discrete_inverse_dynamics(q, v, a, dt))
            assert np.array_equal(shared.inverse_dynamics(q, v, a), fresh.inverse_dynamics(q, v, a))
            assert np.array_equal(shared.explicit_acceleration(q, v, a, dt), fresh.explicit_acceleration(q, v, a, dt))


def test_without_a_time_step_the_discrete_inverse_is_the_continuous_one(bundled: Arm):
    dynamics = Dynamics(bundled.model, bundled.pinocchio_model)
    for q, v, a in states(bundled, 5, seed=7):
        assert np.array_equal(dynamics.discrete_inverse_dynamics(q, v, a, 0.0), dynamics.inverse_dynamics(q, v, a))


# ---- the public functions of an arm, against MuJoCo

GEARS = """<actuator><motor joint="a" gear="-50" ctrlrange="-1 1"/><motor joint="b" gear="2" ctrlrange="-9 9"/>
<motor joint="c" gear="0.1" ctrlrange="-99 99"/></actuator>"""
SYNTHETIC = {
    "geared": (mjcf(limb("a b c", joint='armature="0.2" damping="0.3"'), GEARS), {}),
    "everything a joint can have": (CHAIN.format(integrator="implicit", eulerdamp="enable", gravcomp=0.7), {}),
    "explicit Euler": (CHAIN.format(integrator="Euler", eulerdamp="disable", gravcomp=0), {}),
    "a follower with springs and damping of higher powers": (
        mjcf(limb("a b c d", joint='damping="0.3 0.2 0.1" stiffness="1 0.5 0.2"'), ties("c b 0.1 -0.5") + motors("a b d")),
        {},
    ),
    "springs and damping disabled": (
        CHAIN.format(integrator="implicitfast", eulerdamp="enable", gravcomp=0).replace(
            'eulerdamp="enable"', 'spring="disable" damper="disable"'
        ),
        {},
    ),
    **{name: (mjcf(bodies, rest), how) for name, (bodies, rest, how, _) in TIED.items()},
}


@pytest.fixture(params=SYNTHETIC)
def synthetic(request: pytest.FixtureRequest, tmp_path) -> Arm:
    text, how = SYNTHETIC[request.param]
    path = tmp_path / "arm.xml"
    path.write_text(text.strip())
    return armctl.load(path, **how)


def continuous_mujoco(arm: Arm, q, v) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """MuJoCo at a state of the arm, without constraint forces."""
    model = copy.copy(arm.model)
    model.opt.disableflags |= int(DISABLE.mjDSBL_CONSTRAINT)
    data = mujoco.MjData(model)
    data.qpos[:] = arm.qpos(q)
    data.qvel[:] = arm.qvel(v)
    mujoco.mj_forward(model, data)
    return model, data


def test_mass_matrix_coriolis_and_gravity_are_mujocos(synthetic: Arm):
    full = np.zeros((synthetic.model.nv, synthetic.model.nv))
    zero = np.zeros(synthetic.n)
    for q, v, _ in states(synthetic, 10, seed=8):
        model, moving = continuous_mujoco(synthetic, q, v)
        mujoco.mj_fullM(model, moving, full)
        joint_map = synthetic.joint_map
        assert synthetic.mass_matrix(q) == pytest.approx(joint_map.reduced_matrix(full), abs=1e-9)
        bias = joint_map.reduced(moving.qfrc_bias)
        _, resting = continuous_mujoco(synthetic, q, zero)
        assert synthetic.coriolis(q, v) @ v == pytest.approx(bias - joint_map.reduced(resting.qfrc_bias), abs=1e-9)
        holding = joint_map.reduced(resting.qfrc_bias - resting.qfrc_passive)
        assert synthetic.gravity(q) == pytest.approx(holding, abs=1e-9)


def test_inverse_dynamics_is_mujocos(synthetic: Arm):
    for q, v, a in states(synthetic, 10, seed=9):
        model, data = continuous_mujoco(synthetic, q, v)
        data.qacc[:] = synthetic.qvel(a)  # tied joints accelerate in the ratio of their velocities
        mujoco.mj_inverse(model, data)
        expected = synthetic.joint_map.reduced(data.qfrc_inverse)
        assert synthetic.inverse_dynamics(q, v, a) == pytest.approx(expected, abs=1e-9, rel=1e-11)


def test_forward_dynamics_is_mujocos(synthetic: Arm):
    for q, v, a in states(synthetic, 10, seed=10):
        tau = 5.0 * a
        model, data = continuous_mujoco(synthetic, q, v)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        joint_map = synthetic.joint_map
        force = tau + joint_map.reduced(data.qfrc_passive - data.qfrc_bias)
        expected = np.linalg.solve(joint_map.reduced_matrix(full), force)
        assert synthetic.forward_dynamics(q, v, tau) == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_forward_dynamics_of_an_arm_without_tied_joints_is_mujocos_acceleration(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(SYNTHETIC["everything a joint can have"][0].strip())
    arm = armctl.load(path)
    for q, v, a in states(arm, 10, seed=11):
        model, data = continuous_mujoco(arm, q, v)
        data.qfrc_applied[arm.dof_adr] = 5.0 * a
        mujoco.mj_forward(model, data)
        assert arm.forward_dynamics(q, v, 5.0 * a) == pytest.approx(data.qacc[arm.dof_adr], rel=1e-9, abs=1e-9)


def test_forward_dynamics_inverts_inverse_dynamics(synthetic: Arm):
    for q, v, a in states(synthetic, 10, seed=12):
        tau = synthetic.inverse_dynamics(q, v, a)
        assert synthetic.forward_dynamics(q, v, tau) == pytest.approx(a, rel=1e-9, abs=1e-9)


def test_inverse_dynamics_is_the_sum_of_its_documented_parts(synthetic: Arm):
    zero = np.zeros(synthetic.n)
    for q, v, a in states(synthetic, 10, seed=13):
        _, data = continuous_mujoco(synthetic, q, v)
        damping = -synthetic.joint_map.reduced(data.qfrc_damper)
        parts = synthetic.mass_matrix(q) @ a + synthetic.coriolis(q, v) @ v + synthetic.gravity(q) + damping
        assert synthetic.inverse_dynamics(q, v, a) == pytest.approx(parts, abs=1e-9)
        assert synthetic.inverse_dynamics(q, zero, zero) == pytest.approx(synthetic.gravity(q), abs=1e-12)


def test_an_arm_gives_the_same_dynamics_in_all_threads_and_after_pickling(bundled: Arm):
    q = bundled.home + 0.1
    expected = bundled.inverse_dynamics(q, q, q)
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda _: bundled.inverse_dynamics(q, q, q), range(200)))
    assert all(np.array_equal(tau, expected) for tau in results)
    assert np.array_equal(pickle.loads(pickle.dumps(bundled)).inverse_dynamics(q, q, q), expected)


# ---- the compiled equations of motion, against Pinocchio


class Compiled:
    """The compiled dynamics of an arm for one control period."""

    def __init__(self, arm: Arm, dt: float, continuous: bool):
        self.n = arm.n
        self.model = arm.core_model.for_period(dt, continuous)
        self.feedforward = _core.PDFeedforward(self.model, stiffness=np.zeros(arm.n), damping=np.zeros(arm.n))

    def inverse_dynamics(self, q, v, a):
        tau = np.zeros(self.n)
        _core.inverse_dynamics(self.model, q[None], v[None], a[None], tau[None])
        return tau

    def friction(self, q, v, a):
        tau = np.zeros(self.n)
        self.feedforward.torque(q, v, np.array([q, v, a, v, a]), np.zeros(0), tau)
        return tau - self.inverse_dynamics(q, v, a)

    def gravity(self, q):
        tau = np.zeros(self.n)
        _core.gravity(self.model, q[None], tau[None])
        return tau


def check_compiled(arm: Arm) -> None:
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    step = PinocchioStep(arm, 0.003)
    for q, v, a in states(arm, 5, seed=14):
        discrete = Compiled(arm, 0.003, False)
        continuous = Compiled(arm, 0.003, True)
        friction = dynamics.friction(v + 0.0015 * a, a)
        expected = {
            "discrete step": (discrete.inverse_dynamics(q, v, a), step.inverse_dynamics(q, v, a)),
            "middle of the period": (
                continuous.inverse_dynamics(q, v, a),
                dynamics.inverse_dynamics(q + 0.0015 * v, v + 0.0015 * a, a),
            ),
            "no period": (Compiled(arm, 0.0, False).inverse_dynamics(q, v, a), dynamics.inverse_dynamics(q, v, a)),
            "gravity": (discrete.gravity(q), dynamics.gravity(q)),
            "friction of a step": (discrete.friction(q, v, a), step.friction(q, v, a)),
            "friction of a continuous arm": (continuous.friction(q, v, a), friction),
        }
        for what, (compiled, reference) in expected.items():
            assert compiled == pytest.approx(reference, rel=1e-10, abs=1e-10 * max(1.0, np.abs(reference).max())), what


def test_compiled_dynamics_are_pinocchios(arm: Arm):
    check_compiled(arm)


def test_compiled_dynamics_of_tied_joints_springs_and_implicit_integrators_are_pinocchios(synthetic: Arm):
    check_compiled(synthetic)


def test_compiled_tips_are_pinocchios_also_behind_half_turns(arm: Arm):
    q = np.concatenate([[arm.home, np.zeros(arm.n)], np.random.default_rng(15).uniform(-4, 4, (200, arm.n))])
    positions, rotations = arm.fk_many(q)
    quats = quaternions(rotations)
    poses = [arm.fk(each) for each in q]
    expected_positions = np.array([pose.position for pose in poses])
    assert np.abs(positions - expected_positions).max() <= 1e-13 * max(1.0, np.abs(expected_positions).max())
    assert np.abs(rotations - np.array([pose.rotation for pose in poses])).max() <= 1e-13
    expected = np.array([pose.quat for pose in poses])
    assert np.abs(np.abs((quats * expected).sum(axis=1)) - 1).max() <= 1e-14  # q and -q at a half turn are the same
    assert (quats[:, 0] >= 0).all()


def test_a_wrong_compiled_model_is_found_before_its_first_use(bundled: Arm):
    model = dataclasses.replace(bundled.pinocchio_model, T_last_tip=bundled.pinocchio_model.T_last_tip + 0.01)
    with pytest.raises(armctl.ModelError, match="the core's tip"):
        _ = dataclasses.replace(bundled, pinocchio_model=model).core_model


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda arm: arm.mass_matrix([0.0]), "q: expected 3 numbers, got 1"),
        (lambda arm: arm.gravity("home"), "q: 'home' is not an array of numbers"),
        (lambda arm: arm.coriolis(arm.home, [0.0, np.nan, 0.0]), "v: element .1. is nan"),
        (lambda arm: arm.inverse_dynamics(arm.home, arm.home, 1.0), "a: expected .*got a single number"),
        (lambda arm: arm.forward_dynamics(arm.home, arm.home, [1.0]), "tau: expected 3 numbers, got 1"),
    ],
)
def test_wrong_arguments_of_the_dynamics_are_rejected_in_one_sentence(bundled: Arm, call, sentence):
    with pytest.raises(armctl.InputError, match=sentence):
        call(bundled)


@pytest.mark.parametrize("tip", ["C", "flange", "tip"])
def test_a_payload_weighs_at_its_point_also_where_a_plate_carries_it_behind_bodies_that_mujoco_lifts(load, tip: str):
    inside = '<geom size="0.02" mass="0.1"/><site name="tip" pos="0 0.1 0"/>'
    plate = f'<body name="plate" pos="0.01 0.04 0.03" euler="0.3 0.8 -0.4">{inside}</body>'
    flange = f'<body gravcomp="1" name="flange" pos="0.05 -0.02 0.1" quat="0.6 0.2 -0.5 0.4">{plate}</body>'
    bodies = limb("a b c", flange).replace('<body name="C"', '<body gravcomp="1" name="C"')
    arm = load(bodies, motors("a b c"), tip=tip)
    center = np.array([0.03, -0.05, 0.08])
    heavy = arm.with_payload(0.7, center)
    for q in arm.limits.random(arm.home, 5, np.random.default_rng(0)):
        J = arm.jacobian(q)
        at_center = J[:3] - np.cross(arm.fk(q).rotation @ center, J[3:], axisb=0).T
        assert heavy.gravity(q) - arm.gravity(q) == pytest.approx(0.7 * 9.81 * at_center[2], abs=1e-12)
        assert heavy.mass_matrix(q) - arm.mass_matrix(q) == pytest.approx(0.7 * at_center.T @ at_center, abs=1e-12)


def test_forward_kinematics_of_positions_in_degrees_asks_for_the_unit(bundled: Arm):
    with pytest.warns(armctl.ArmctlWarning, match=r"^q: shoulder_pitch: -45 rad is outside .* rad; degrees\? np.radians"):
        bundled.fk([1.0, -45.0, -90.0])
    bundled.fk(bundled.limits.q_max + 1.0)  # is allowed, without a warning
