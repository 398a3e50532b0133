"""The main job, end to end: a target in, an arm at the target, a log and a verdict that can be trusted."""

import gc
import warnings
import weakref

import mujoco
import numpy as np
import pytest
from arms import arm_of, some_of

import armctl
from armctl import PD, Arm, ComputedTorque, InputError, Plant, Pose, Report, Simulation, SimulationError
from armctl.lab.comparison import out_and_back
from armctl.model.collision.checkers import collision_checker
from armctl.run.sim.plant import held_dofs

NAMED = ["robot_arm_3dof", "panda", "ur5e", "iiwa14", "xarm7", "gen3", "so_arm100"]


def tip_by_mujoco(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Where MuJoCo's own kinematics puts the tip."""
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(arm.model, data)
    R = data.xmat[arm.tip_body].reshape(3, 3)
    return data.xpos[arm.tip_body] + R @ arm.T_body_tip.position


@pytest.mark.parametrize("name", some_of(NAMED))
def test_the_tip_reaches_the_green_target(name: str):
    arm = arm_of(name)
    sim = Simulation(arm)
    result = sim.move_to(sim.target)
    assert result.ok, result
    assert result.position_error <= 1e-4
    assert np.linalg.norm(tip_by_mujoco(arm, sim.state.q) - sim.target) <= 1e-4
    assert result.log is not None
    report = Report.from_log(result.log)
    assert report.ok
    assert report.final_tip_error_m <= 1e-4


@pytest.mark.parametrize("name", some_of(NAMED))
def test_computed_torque_tracks_and_pd_is_visibly_worse(name: str):
    arm = arm_of(name)
    motion, plant = out_and_back(arm), Plant(timestep=1e-3)
    exact, pd = armctl.compare(arm, [ComputedTorque(arm), PD(arm)], motion, [plant])
    assert exact.joint_rms_rad <= 1e-9
    assert exact.joint_max_rad <= 1e-9
    assert exact.saturated_fraction == 0
    assert pd.joint_rms_rad > 1e-3


def test_a_full_pose_is_reached(arm: Arm):
    """A pose near home, to which the arm moves without contact."""
    contacts = collision_checker(arm)
    low = np.maximum(arm.limits.q_min, arm.home - 0.4)
    high = np.minimum(arm.limits.q_max, arm.home + 0.4)
    goals = np.random.default_rng(3).uniform(low, high, (200, arm.n))
    share = np.linspace(0.0, 1.0, 40)[:, None]
    goal = next(goal for goal in goals if not contacts.along(arm.home + share * (goal - arm.home)))
    sim = Simulation(arm)
    target = arm.fk(goal)
    result = sim.move_to(target)
    assert result.ok, result
    position_error, orientation_error = sim.tip.distance(target)
    assert position_error <= 1e-4
    assert orientation_error <= 1e-3


def test_moves_follow_on_each_other(bundled: Arm):
    sim = Simulation(bundled)
    for target in ([0.3, 0.2, 0.3], [0.4, -0.1, 0.3], [0.3, 0.2, 0.3]):
        assert sim.move_to(target).ok
        assert np.linalg.norm(sim.tip.position - target) <= 1e-4
        assert np.allclose(sim.target, target)


@pytest.mark.parametrize("distance", [1.0, 5.0, 1e6])
def test_out_of_reach_is_a_result_that_says_by_how_much(bundled: Arm, distance: float):
    sim = Simulation(bundled)
    before = sim.state.q
    result = sim.move_to([distance, 0.0, 0.35])
    assert not result
    assert result.log is None
    assert "out of reach by" in result.reason
    reach = 0.3 + 0.25
    value, unit = result.reason.split()[4:6]
    scale = {"mm": 1e3, "m": 1.0}[unit.rstrip(";")]
    assert float(value) == pytest.approx(scale * (distance - reach), rel=1.2e-3)
    assert np.array_equal(sim.state.q, before)


def test_a_controller_that_sags_does_not_reach_and_says_so(bundled: Arm):
    result = Simulation(bundled, PD(bundled, bandwidth=2.0)).move_to([0.4, 0.1, 0.3])
    assert not result.ok
    assert "mm" in result.reason
    assert result.log is not None
    assert not Report.from_log(result.log).ok


class Runaway:
    """Positive feedback: it drives the arm away from where it should be."""

    name = "runaway"

    def torque(self, state, setpoint):
        return 1e9 * (state.q - setpoint.q + 1e-6) + 1e9 * state.v


def light_arm(tmp_path) -> Arm:
    """An arm with so little inertia that its own motor can throw it out of any bounds."""
    path = tmp_path / "light.xml"
    path.write_text(
        """<mujoco><option timestep="0.01"/><worldbody><body><joint name="j"/>
        <geom type="sphere" size="0.01" mass="1e-6" pos="0.1 0 0"/></body></worldbody>
        <actuator><motor joint="j" ctrlrange="-100 100"/></actuator></mujoco>"""
    )
    return armctl.load(path)


def test_a_run_that_diverges_ends_in_a_verdict_with_its_log(tmp_path):
    arm = light_arm(tmp_path)
    sim = Simulation(arm, Runaway())
    log = sim.run(armctl.move_j(arm, arm.home, arm.home + 1.0))
    assert "diverged" in log.failure
    assert np.isfinite(log.q).all()
    assert np.isfinite(log.tau).all()
    report = Report.from_log(log)
    assert not report.ok
    assert str(report).startswith("failed: diverged")
    again = sim.move_to([0.1, 0.0, 0.0])
    assert not again.ok
    assert "reset()" in again.reason
    with pytest.raises(SimulationError, match="reset"):
        sim.run(armctl.move_j(arm, arm.home, arm.home + 1.0))
    sim.reset()
    assert np.array_equal(sim.state.q, arm.home)


class Failing:
    def __init__(self, after: float, value=None):
        self.after, self.value = after, value

    def torque(self, state, setpoint):
        if state.t > self.after:
            if self.value is None:
                raise ZeroDivisionError("division by zero")
            return self.value
        return np.zeros(len(state.q))


def test_a_controller_that_fails_loses_no_tick(bundled: Arm):
    motion = armctl.move_j(bundled, bundled.home, [0.5, 0.5, -1.0])
    with pytest.raises(SimulationError, match=r"Failing failed at 0\.1\d* s: division by zero") as caught:
        armctl.simulate(bundled, Failing(0.101), motion)
    assert caught.value.log is not None
    assert len(caught.value.log) == 51
    assert np.isfinite(caught.value.log.q).all()


@pytest.mark.parametrize("value", [np.array([0.0, np.nan, 0.0]), np.full(3, np.inf)])
def test_a_torque_that_is_no_number_ends_the_run(bundled: Arm, value):
    log = armctl.simulate(bundled, Failing(0.1, value), armctl.move_j(bundled, bundled.home, [0.5, 0.5, -1.0]))
    assert "no finite torque" in log.failure
    assert np.isfinite(log.q).all()


@pytest.mark.parametrize("value", [np.zeros(2), np.zeros(1), np.zeros((3, 2)), 0.0, "torque", None])
def test_a_torque_of_the_wrong_shape_is_an_error_with_a_log(bundled: Arm, value):
    class Wrong:
        def torque(self, state, setpoint):
            return value

    with pytest.raises(SimulationError, match="Wrong failed at"):
        armctl.simulate(bundled, Wrong(), armctl.move_j(bundled, bundled.home, [0.5, 0.5, -1.0]))


@pytest.mark.parametrize(
    ("unlocks", "message"), [(False, "assignment destination is read-only"), (True, "cannot set WRITEABLE flag")]
)
@pytest.mark.parametrize("name", ["q", "v"])
@pytest.mark.parametrize("which", [0, 1])
def test_a_controller_cannot_change_the_state_or_its_references(
    bundled: Arm, which: int, name: str, unlocks: bool, message: str
):
    class Careless(ComputedTorque):
        def torque(self, state, setpoint):
            tau = super().torque(state, setpoint)
            given = getattr((state, setpoint)[which], name)
            if unlocks:
                given.flags.writeable = True
            given[:] = 99.0
            return tau

    sim = Simulation(bundled, Careless(bundled))
    with pytest.raises(SimulationError, match=rf"failed at 0\.000 s: {message}"):
        sim.run(armctl.move_j(bundled, bundled.home, [0.5, 0.5, -1.0]))
    assert np.array_equal(sim.state.q, bundled.home)
    sim.controller = "computed-torque"
    assert sim.move_j([0.5, 0.5, -1.0])


def test_a_controller_that_keeps_what_it_is_given_keeps_the_truth(bundled: Arm):
    class Keeping(ComputedTorque):
        def torque(self, state, setpoint):
            kept.append((state, setpoint))
            return super().torque(state, setpoint)

    kept = []
    log = armctl.simulate(bundled, Keeping(bundled), armctl.move_j(bundled, bundled.home, [0.5, 0.5, -1.0]))
    assert np.array_equal([state.q for state, _ in kept], log.q)
    assert np.array_equal([state.v for state, _ in kept], log.v)
    assert np.array_equal([setpoint.q for _, setpoint in kept], log.q_ref)


def test_torque_is_clipped_at_the_limits_and_the_log_shows_both(bundled: Arm):
    class Strong:
        def torque(self, state, setpoint):
            return np.array([1e4, -1e4, 1.0])

    log = armctl.simulate(bundled, Strong(), armctl.move_j(bundled, bundled.home, [0.5, 0.5, -1.0]))
    assert np.allclose(log.tau[:, 0], 250)
    assert np.allclose(log.tau[:, 1], -250)
    assert np.allclose(log.tau[:, 2], 1.0)
    assert np.allclose(log.tau_cmd[:, 0], 1e4)
    assert Report.from_log(log).saturated_fraction == 1.0
    assert Report.from_log(log).peak_torque_ratio == pytest.approx(1.0)


def test_same_input_same_bits(arm: Arm):
    motion = out_and_back(arm)
    first, second = (armctl.simulate(arm, ComputedTorque(arm), motion) for _ in range(2))
    for name in ("q", "v", "tau", "tau_cmd", "tip", "tip_quat", "q_ref"):
        assert np.array_equal(getattr(first, name), getattr(second, name))


def test_fingers_hold_still_while_the_arm_moves(arm: Arm):
    joints = arm.model.dof_jntid[held_dofs(arm)]
    sim = Simulation(arm)
    before = sim.data.qpos[arm.model.jnt_qposadr[joints]].copy()
    sim.run(out_and_back(arm))
    assert np.allclose(sim.data.qpos[arm.model.jnt_qposadr[joints]], before, rtol=0.0, atol=1e-6)


def test_the_log_is_the_simulation(bundled: Arm):
    motion = armctl.move_j(bundled, bundled.home, [0.5, 0.5, -1.0])
    log = armctl.simulate(bundled, "pd", motion)
    assert np.array_equal(log.q[0], bundled.home)
    assert np.allclose(np.diff(log.q, axis=0) / log.dt, log.v[1:], atol=1e-9)  # MuJoCo's step is semi-implicit
    assert np.array_equal(log.tip, bundled.fk_many(log.q)[0])
    assert np.array_equal(log.tip_ref, bundled.fk_many(log.q_ref)[0])
    assert np.allclose(log.q_ref, motion.sample(log.t).q)
    with pytest.raises(ValueError, match="read-only"):
        log.q[0, 0] = 1.0


def test_open_loop_holds_the_controls(bundled: Arm):
    sim = Simulation(bundled)
    log = sim.apply_ctrl([0.5, -0.3, -0.2], 0.5)
    assert np.allclose(log.tau, [25.0, -15.0, -6.0])
    assert len(log) == 251
    assert log.is_open_loop
    model, data = bundled.model, mujoco.MjData(bundled.model)
    data.qpos[:] = bundled.home_qpos
    for k in range(251):
        assert np.allclose(data.qpos[:3], log.q[k], atol=1e-12)
        data.ctrl[:] = [0.5, -0.3, -0.2]
        mujoco.mj_step(model, data)
    with pytest.raises(InputError, match="nothing to report"):
        Report.from_log(log)


def test_a_payload_is_felt(arm: Arm):
    """A plant with a point mass at the tip needs just the torque that statics says."""
    plant, sim = Plant(payload=0.1, payload_center=[0.01, -0.02, 0.03]), Simulation(arm)
    data, loaded = mujoco.MjData(sim.model), plant.model(arm)
    for model in (sim.model, loaded):
        data = mujoco.MjData(model)
        data.qpos[:] = arm.qpos(arm.home)
        mujoco.mj_forward(model, data)
        if model is sim.model:
            bare = data.qfrc_bias[arm.dof_adr].copy()
    extra = data.qfrc_bias[arm.dof_adr] - bare
    T = arm.fk(arm.home)
    lever = T.rotation @ [0.01, -0.02, 0.03]
    J = arm.jacobian(arm.home)
    point_jacobian = J[:3] + np.cross(J[3:], lever, axis=0)
    assert np.allclose(extra, -point_jacobian.T @ (0.1 * arm.model.opt.gravity), atol=1e-10)


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda sim: sim.move_to([0.3, 0.2]), "target: expected 3 numbers, got 2"),
        (lambda sim: sim.move_to([0.3, np.nan, 0.1]), r"target: element \[1\] is nan"),
        (lambda sim: sim.move_to([0.3, 0.2, 0.3], keep="z", avoid=False), "keep: the tip keeps an axis or a region only"),
        (lambda sim: sim.apply_ctrl([1, 2], 1), "ctrl: expected 3 numbers, got 2"),
        (lambda sim: sim.apply_ctrl([1, 2, 9], 1), r"ctrl: elbow: 9 is outside \[-5, 5\]"),
        (lambda sim: sim.apply_ctrl([1, 2, 3], -1), "duration: expected .*got -1"),
        (lambda sim: sim.reset([1, 2]), "q: expected 3 numbers, got 2"),
        (lambda sim: Simulation(sim.arm, "pdd"), "unknown controller 'pdd'; did you mean 'pd'?"),
        (lambda sim: Simulation(sim.arm, 3), "controller: 3 has no method torque"),
        (lambda sim: Plant(payload=-1), "payload: expected .*got -1"),
        (lambda sim: Plant(timestep=0), "timestep: expected .*got 0"),
        (lambda sim: Plant(mass_scale=np.nan), "mass_scale: expected a finite number, got nan"),
    ],
)
def test_a_wrong_call_is_one_sentence(bundled: Arm, call, sentence: str):
    with pytest.raises(armctl.ArmctlError, match=sentence):
        call(Simulation(bundled))


@pytest.mark.parametrize("move", ["move_l", "move_path"])
def test_an_option_that_a_move_does_not_have_is_a_type_error(bundled: Arm, move: str):
    sim = Simulation(bundled)
    with pytest.raises(TypeError, match=rf"^{move}\(\) got an unexpected keyword argument 'sped'$"):
        getattr(sim, move)([[0.3, 0.2, 0.3]] if move == "move_path" else [0.3, 0.2, 0.3], sped=0.5)
    assert sim.log is None


@pytest.mark.parametrize(("tolerance", "reached"), [(1e-3, True), (0.0, False)])
def test_the_tolerances_of_a_target_decide_whether_it_is_reached(bundled: Arm, tolerance: float, reached: bool):
    target = armctl.Target.read([0.3, 0.2, 0.3], tolerance=tolerance)
    result = Simulation(bundled, "pd").move_to(target)
    assert result.ok == reached
    assert ("from the target" in result.reason) != reached


def test_simulations_do_not_touch_the_arm(bundled: Arm):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        before = bundled.model.body_mass.copy()
        Simulation(bundled, plant=Plant(payload=1.0, mass_scale=2.0, timestep=1e-3))
    assert np.array_equal(bundled.model.body_mass, before)
    assert bundled.model.opt.timestep == 0.002


def forgotten(name: str, use) -> bool:
    """Whether an arm is forgotten after its use."""
    arm = armctl.load(name)
    use(arm)
    reference = weakref.ref(arm)
    del arm
    gc.collect()
    return reference() is None


@pytest.mark.parametrize(
    "use",
    [
        lambda arm: armctl.simulate(arm, "pd", armctl.move_j(arm, arm.home, arm.home + 0.1)),
        lambda arm: armctl.simulate(arm, "pd", armctl.move_j(arm, arm.home, arm.home + 0.1), Plant(payload=0.1)),
        lambda arm: armctl.compare(arm, ["pd"], armctl.move_j(arm, arm.home, arm.home + 0.1), [Plant(), Plant(delay=1)]),
        lambda arm: Simulation(arm).move_to([0.3, 0.2, 0.3]),
    ],
    ids=["simulate", "simulate with a plant", "compare", "Simulation"],
)
def test_an_arm_is_forgotten_after_its_last_use(use):
    assert forgotten("robot_arm_3dof", use)


def test_two_plants_of_the_same_kind_are_two_results(bundled: Arm):
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.2)
    weak, strong = (Plant(coulomb_friction=friction) for friction in (0.01, 0.05))
    first, second = armctl.compare(bundled, ["pd"], motion, [weak, strong], dwell=0.25)
    assert [first.plant, second.plant] == [str(weak), str(strong)]
    assert not np.array_equal(first.log.q, second.log.q)
    equal = armctl.simulate(bundled, "pd", motion, Plant(coulomb_friction=0.01), dwell=0.25)
    assert np.array_equal(first.log.q, equal.q)


def test_a_target_that_only_the_orientation_forbids_says_so(bundled: Arm):
    result = Simulation(bundled).move_to(Pose([0.4, 0.0, 0.3], rpy=[1.0, 0.0, 0.0]))
    assert not result.ok
    assert "not with this orientation" in result.reason


@pytest.mark.parametrize("speed", [0.5, 0.1])
def test_speed_is_the_same_motion_slowed(bundled: Arm, speed: float):
    moves = {
        "move_to": lambda sim, **how: sim.move_to([0.4, -0.1, 0.3], **how),
        "move_j": lambda sim, **how: sim.move_j([0.5, 0.5, -1.0], **how),
        "move_l": lambda sim, **how: sim.move_l(sim.tip.position + np.array([0.0, 0.05, 0.0]), **how),
    }
    for name, move in moves.items():
        full = move(Simulation(bundled))
        slow = move(Simulation(bundled), speed=speed)
        assert full.ok, name
        assert slow.ok, name
        assert slow.log.motion_duration == pytest.approx(full.log.motion_duration / speed, rel=2e-2), name


def test_a_report_after_follow_measures_against_the_target(bundled: Arm):
    near, far = (Simulation(bundled).follow(lambda t, x=x: [x, 0.1, 0.3], duration=2.0) for x in (0.4, 0.9))
    assert np.allclose(near.target[:3], [0.4, 0.1, 0.3])
    assert armctl.Report.from_log(near).ok
    report = armctl.Report.from_log(far)
    assert not report.ok
    assert report.final_tip_error_m == pytest.approx(np.linalg.norm(far.tip[-1] - [0.9, 0.1, 0.3]))
    assert report.final_tip_error_m > 0.3


def test_the_tick_of_a_simulation_is_that_of_its_plant():
    arm = arm_of("robot_arm_3dof")
    target = arm.fk(arm.home + 0.1).position
    fast = Simulation(arm, "pd", Plant(payload=0.1), dt=0.001)
    same = Simulation(arm, "pd", Plant(payload=0.1, timestep=0.001))
    logs = [sim.move_to(target).log for sim in (fast, same)]
    assert logs[0] is not None
    assert logs[1] is not None
    assert logs[0].dt == 0.001
    assert (logs[0].q == logs[1].q).all()
    with pytest.raises(InputError, match=r"dt: 0\.002 s, but the plant has timestep=0\.001 s; give one of them"):
        Simulation(arm, plant=Plant(timestep=0.001), dt=0.002)
    with pytest.raises(InputError, match="timestep: expected"):
        Simulation(arm, dt=1.0)
