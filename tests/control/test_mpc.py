"""Model predictive control: the plan of a horizon within limits."""

from dataclasses import replace

import daqp
import numpy as np
import pytest
from arms import some_of
from synthetic import BENT, serial_arm

import armctl
from armctl._core import UNBOUNDED, solve_program


@pytest.fixture
def arm(tmp_path):
    return serial_arm(tmp_path, BENT["redundant"])


class Clipped:
    """Computed torque, clipped."""

    def __init__(self, arm):
        self.law = armctl.ComputedTorque(arm)
        self.tau_max = arm.limits.tau_max

    def torque(self, state, setpoint):
        return np.clip(self.law.torque(state, setpoint), -self.tau_max, self.tau_max)


def weakened(arm, motion, share):
    """The arm with motors that give a share of the torque that a motion needs beyond keeping its speed."""
    setpoints = motion.sample(np.arange(0.0, motion.duration, 0.002))
    steady = np.max([np.abs(arm.inverse_dynamics(q, v, 0 * v)) for q, v in zip(setpoints.q, setpoints.v, strict=True)], axis=0)
    needed = np.max([np.abs(arm.inverse_dynamics(q, v, a)) for q, v, a in zip(*setpoints[:3], strict=True)], axis=0)
    return arm.with_limits(replace(arm.limits, tau_max=steady + share * (needed - steady)))


def run(arm, law, motion):
    return armctl.simulate(arm, law, motion, armctl.Plant(timestep=0.001), dwell=0.5)


def tip_rms(log):
    return np.sqrt(np.mean(np.sum((log.tip - log.tip_ref) ** 2, axis=1)))


def random_motion(arm, seed):
    return armctl.move_j(arm, *arm.limits.random(arm.home, 2, np.random.default_rng(seed)))


def test_before_the_first_tick_nothing_is_counted(arm):
    assert armctl.MPC(arm).counts == (0, 0, 0, 0)


def test_without_limits_it_is_computed_torque_with_the_same_feedback(arm):
    strong = arm.with_limits(replace(arm.limits, tau_max=np.full(arm.n, 1e6), v_max=np.full(arm.n, 1e3)))
    state = armctl.State(arm.home + 0.01, np.full(arm.n, 0.1), 0.0, 0.001)
    setpoint = armctl.Setpoint(arm.home, np.zeros(arm.n), np.zeros(arm.n))
    law = armctl.MPC(strong)
    assert np.array_equal(law.torque(state, setpoint), armctl.ComputedTorqueQP(strong).torque(state, setpoint))
    assert law.counts == (1, 0, 0, 0)


@pytest.mark.parametrize("seed", [21, 22, 23])
def test_with_weak_motors_the_error_of_the_tip_is_a_third(arm, seed):
    motion = random_motion(arm, seed)
    weak = weakened(arm, motion, 0.7)
    law = armctl.MPC(weak)
    log = run(weak, law, motion)
    assert law.counts.planned > 0
    assert law.counts.unplanned == 0
    assert tip_rms(log) <= tip_rms(run(weak, Clipped(weak), motion)) / 3
    assert (np.abs(log.tau_cmd) <= weak.limits.tau_max).all()
    assert weak.limits.contains(log.q, tolerance=1e-6)


@pytest.mark.parametrize("seed", some_of([3, 5, 13, 17], [3]))
def test_where_motors_are_weak_for_long_the_arm_stays_near_its_motion(arm, seed):
    """Clipped computed torque lets joints exceed their speed limits instead, and so catches up."""
    motion = random_motion(arm, seed)
    weak = weakened(arm, motion, 0.5)
    log = run(weak, armctl.MPC(weak), motion)
    assert np.abs(log.q - log.q_ref).max() < 0.25
    assert np.linalg.norm(log.tip - log.tip_ref, axis=1).max() < 0.03
    assert (np.abs(log.v) <= 1.001 * weak.limits.v_max).all()
    assert weak.limits.contains(log.q, tolerance=1e-6)


@pytest.mark.parametrize("seed", some_of([2, 18, 20, 24, 27], [2]))
def test_with_motors_that_are_far_too_weak_every_tick_has_a_plan(arm, seed):
    """Errors become so large that their feedback asks for more than the speed limits: the plan matters most there."""
    motion = random_motion(arm, seed)
    weak = weakened(arm, motion, 0.3)
    law = armctl.MPC(weak)
    log = run(weak, law, motion)
    assert law.bandwidth * np.abs(log.q_ref - log.q).max() > 2.0 * weak.limits.v_max.max()
    assert law.counts.unplanned == 0
    assert tip_rms(log) < tip_rms(run(weak, Clipped(weak), motion))
    assert (np.abs(log.tau_cmd) <= weak.limits.tau_max).all()
    assert (np.abs(log.v) <= 1.001 * weak.limits.v_max).all()
    assert weak.limits.contains(log.q, tolerance=1e-6)


def test_the_torque_of_damped_joints_is_foreseen(tmp_path):
    """An error at the start of a motion at the limit of velocity remains until its end: torques have to be foreseen."""
    planar = serial_arm(tmp_path, BENT["planar"])
    motion = armctl.move_j(planar, planar.home, planar.home + np.array([1.5, 0.0, 0.0]))
    weak = weakened(planar, motion, 0.6)
    log = run(weak, "mpc", motion)
    middle = np.searchsorted(log.t, 0.5 * motion.duration)
    assert abs(log.v_ref[middle, 0]) > 0.99 * weak.limits.v_max[0]
    assert np.abs(log.q - log.q_ref)[middle, 0] < 0.5 * np.abs(log.q - log.q_ref)[:, 0].max()


def test_the_arm_accelerates_before_the_torque_is_missing(arm):
    motion = random_motion(arm, 21)
    weak = weakened(arm, motion, 0.7)
    log = run(weak, "mpc", motion)
    direction = log.q_ref[-1] - log.q_ref[0]
    lead = (log.q - log.q_ref) @ direction
    first = np.flatnonzero(np.abs(lead) > 2e-3)[0]
    assert lead[first] > 0.0


def test_a_motor_that_hardly_holds_its_joint_for_a_while_does_not_brake_a_motion_that_it_can_follow(arm):
    """In the middle of this motion, joint 2 needs its whole torque. It has to brake much later, where it has plenty."""
    start = [-1.28, -1.07, 0.97, 1.06, -0.05, -1.78, 1.76]
    motion = armctl.move_j(arm, start, [1.48, -0.79, -1.97, -0.03, -1.33, -0.48, -0.4])
    weak = weakened(arm, motion, 0.7)
    log = run(weak, "mpc", motion)
    middle = (log.t > 0.5) & (log.t < 1.2)
    assert np.abs(log.tau_cmd / weak.limits.tau_max)[middle].max() > 0.99
    assert np.linalg.norm(log.tip - log.tip_ref, axis=1)[middle].max() < 1e-4


def test_a_reference_outside_of_the_joint_limits_leaves_the_arm_inside(arm):
    """A target beyond the limits, as a jump: no preview, and torques far beyond the limits."""
    far = armctl.Setpoint(arm.limits.q_max + 0.5, np.zeros(arm.n), np.zeros(arm.n))

    class Jump:
        duration = 2.0

        def __call__(self, t):
            return far

        def sample(self, times):
            return armctl.Setpoint(*(np.tile(each, (len(times), 1)) for each in far[:3]))

    simulation = armctl.Simulation(arm, "mpc", armctl.Plant(timestep=0.001))
    log = simulation.run(Jump())
    assert not log.failure
    assert arm.limits.contains(log.q, tolerance=1e-6)
    assert (np.abs(log.tau_cmd) <= arm.limits.tau_max).all()
    assert np.abs(log.q[-1] - arm.limits.q_max).max() < 1e-3
    assert np.abs(log.v[-1]).max() < 1e-2
    assert simulation.controller.counts.unplanned == 0


def test_a_reference_that_leaves_the_range_for_a_while_is_followed_up_to_the_limits(arm):
    near = arm.with_limits(replace(arm.limits, q_max=arm.home + 0.35))

    class Excursion:
        duration = 2.0

        def __call__(self, t):
            return armctl.Setpoint(*(column[0] for column in self.sample([t])[:3]))

        def sample(self, times):
            angle = np.pi * np.asarray(times)[:, None]
            each = np.ones(arm.n)
            q = arm.home + 0.3 * (1.0 - np.cos(angle)) * each
            return armctl.Setpoint(q, 0.3 * np.pi * np.sin(angle) * each, 0.3 * np.pi**2 * np.cos(angle) * each)

    law = armctl.MPC(near)
    log = run(near, law, Excursion())
    assert not log.failure
    assert near.limits.contains(log.q, tolerance=1e-6)
    assert law.counts.planned > 0
    assert law.counts.unplanned == 0
    assert np.abs(log.q - np.minimum(log.q_ref, near.limits.q_max)).max() < 0.03


class Rush:
    """One joint moves at its largest speed to a position at its limit, and stops at once."""

    duration = 1.0

    def __init__(self, way):
        self.way = way

    def __call__(self, t):
        return armctl.Setpoint(*(column[0] for column in self.sample([t])[:3]))

    def sample(self, times):
        run = 2.0 * np.maximum(np.asarray(times)[:, None] - 0.1, 0.0)
        v = 2.0 * ((run > 0.0) & (run < 0.9995)) * self.way
        return armctl.Setpoint(np.minimum(run, 0.9995) * self.way, v, 0.0 * v)


@pytest.mark.parametrize("way", [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
def test_the_limits_of_one_joint_do_not_move_another_that_nothing_couples_with_it(tmp_path, way):
    """Two slides at a right angle: their inertia, and the Jacobian of the tip, are diagonal."""
    slide = '<body><joint name="{0}" type="slide" axis="{1}" range="-1 1" damping="1"/><inertial pos="0 0 0" mass="{2}" {3}/>'
    inertia = 'diaginertia="0.1 0.1 0.1"'
    x = slide.format("x", "1 0 0", 1, inertia)
    y = slide.format("y", "0 1 0", 2, inertia)
    bodies = f'{x}{y}<site name="tip"/></body></body>'
    motors = "".join(f'<motor joint="{name}" ctrlrange="-20 20"/>' for name in "xy")
    path = tmp_path / "gantry.xml"
    path.write_text(f"<mujoco><worldbody>{bodies}</worldbody><actuator>{motors}</actuator></mujoco>")
    gantry = armctl.load(path)
    gantry = gantry.with_limits(replace(gantry.limits, v_max=np.full(2, 2.0), a_max=np.full(2, 50.0), j_max=np.full(2, 1e4)))
    law = armctl.MPC(gantry)
    log = armctl.Simulation(gantry, law, armctl.Plant(timestep=0.001)).run(Rush(np.array(way)))
    moving = int(np.argmax(np.abs(way)))
    assert law.counts.planned > 100
    assert np.abs(log.q[:, moving]).max() > 0.99
    assert np.abs(log.v[:, 1 - moving]).max() < 1e-8


def test_without_a_plan_the_limits_of_the_tick_hold(arm):
    """Limits of velocity that contradict those of torque: the arm is faster than it may be."""
    slow = arm.with_limits(replace(arm.limits, v_max=np.full(arm.n, 0.05), tau_max=1.1 * np.abs(arm.gravity(arm.home)) + 0.05))
    law = armctl.MPC(slow)
    simulation = armctl.Simulation(slow, law, armctl.Plant(timestep=0.001))
    simulation.reset(arm.home, np.full(arm.n, 0.3))
    log = simulation.run(armctl.move_j(slow, arm.home, arm.home + 0.005))
    assert not log.failure
    assert law.counts.unplanned > 0
    assert law.counts.ticks >= law.counts.planned >= law.counts.unplanned
    assert (np.abs(log.tau_cmd) <= slow.limits.tau_max).all()


@pytest.mark.parametrize(
    ("seed", "rate", "contradicts"),
    [
        (3, 30.0, True),
        pytest.param(3, 40.0, False, marks=pytest.mark.full),
        pytest.param(21, 200.0, False, marks=pytest.mark.full),
    ],
)
def test_the_plan_foresees_the_limit_of_the_torque_rate(arm, seed, rate, contradicts):
    motion = random_motion(arm, seed)
    law = armctl.MPC(arm, torque_rate=rate)
    log = run(arm, law, motion)
    assert (law.counts.relaxed > 0) == contradicts  # limits of velocity, by the least
    assert np.abs(np.diff(log.tau_cmd, axis=0)).max() <= 1e-3 * rate * (1 + 1e-9)
    assert tip_rms(log) < 1e-3
    assert tip_rms(run(arm, armctl.TorqueRateLimit(arm, armctl.MPC(arm), rate), motion)) > 10 * tip_rms(log)


def test_outside_of_a_range_the_arm_brakes_and_comes_back(arm):
    """The arm moves towards the ends of its joints too fast for its motors."""
    tau_max = 1.1 * np.abs(arm.gravity(arm.home)) + 5.0
    near = arm.with_limits(replace(arm.limits, q_max=arm.home + 0.005, tau_max=tau_max))
    target = armctl.Setpoint(arm.home, np.zeros(arm.n), np.zeros(arm.n))
    excess = []
    for law in (armctl.MPC(near), armctl.ComputedTorqueQP(near)):
        simulation = armctl.Simulation(near, law, armctl.Plant(timestep=0.001))
        simulation.reset(arm.home, np.full(arm.n, 0.3))
        for _ in range(1000):
            simulation.step(law.torque(simulation.measured_state, target))
        log = simulation.log
        assert (np.abs(log.tau_cmd) <= tau_max).all()
        assert np.abs(log.q[-1] - arm.home).max() < 1e-6
        excess.append((log.q - near.limits.q_max).max())
        if law.name == "mpc":
            assert law.counts.unplanned > 0
    assert excess[0] < 1.05 * excess[1]


def test_without_a_solution_the_last_plan_goes_on(arm):
    """Torques that may hardly change contradict their limits, which are never costs."""
    motion = random_motion(arm, 21)
    weak = weakened(arm, motion, 0.5)
    law = armctl.MPC(weak, torque_rate=50.0)
    simulation = armctl.Simulation(weak, law, armctl.Plant(timestep=0.001))
    simulation.reset(motion(0.0).q)
    continued = 0
    for t in np.arange(0.0, 0.6, 0.001):
        end = law.memory[-arm.n :].copy()  # the acceleration at the end of the plan
        unplanned = law.counts.unplanned
        simulation.step(law.torque(simulation.measured_state, motion(t)))
        if law.counts.unplanned > unplanned:
            assert np.array_equal(law.memory[-arm.n :], end)
            continued += end.any()
    assert continued > 1


def test_the_program_may_have_more_rows_than_unknowns():
    rng = np.random.default_rng(2)
    for _ in range(30):
        n, m = 4, 11
        L = rng.normal(size=(n, n))
        H = L @ L.T + 0.1 * np.eye(n)
        f = rng.normal(size=n)
        M = rng.normal(size=(m, n))
        middle = M @ rng.normal(size=n)
        lower = np.concatenate([np.full(n, -UNBOUNDED), middle - 0.1])
        upper = np.concatenate([np.full(n, UNBOUNDED), middle + 0.1])
        x = np.empty(n)
        assert solve_program(H, f, M, lower, upper, x)
        expected, _, status, _ = daqp.solve(H, f, M, upper, lower)
        assert status == 1
        assert np.abs(x - expected).max() < 1e-7


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"horizon": 0.0}, "horizon: expected a number in"),
        ({"torque_rate": -1.0}, "torque_rate: every value must be at least 0"),
    ],
)
def test_wrong_arguments_are_explained(arm, wrong, message):
    with pytest.raises(armctl.InputError, match=message):
        armctl.MPC(arm, **wrong)
