"""Environments step by step: MuJoCo's own step and NumPy make the same motions, observations and rewards."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="pip install -e '.[envs]'")

from scipy.spatial.transform import Rotation
from synthetic import BENT, arm_with_gripper, serial_arm

import armctl
import armctl.envs
from armctl.control import controller_by_name

TASKS = ("Reach", "ReachPast", "Track", "Push", "PickPlace")
ON_A_TABLE = ("Push", "PickPlace")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Model files by whether the task is at a table."""
    folder = tmp_path_factory.mktemp("free")
    serial_arm(folder, BENT["six joints"])
    return {False: folder / "serial.xml", True: arm_with_gripper(tmp_path_factory.mktemp("table"))}


@pytest.fixture
def make(files):
    """Environments that are closed after the test."""
    made = []

    def of(task, action, count=2, **options):
        made.append(armctl.envs.ArmVectorEnv(files[task in ON_A_TABLE], task, action, count, **options))
        return made[-1]

    yield of
    for env in made:
        env.close()


def started(env, row):
    """The arm's model and a state of it as a row of an environment begins."""
    arm = env.batch.arm
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(env.batch.rows.q[row])
    return arm, data


def drive(arm, data, tau):
    """One step of MuJoCo with joint torques."""
    limit = arm.limits.tau_max
    data.ctrl[arm.ctrl_adr] = np.clip(tau, -limit, limit) / arm.gear
    mujoco.mj_step(arm.model, data)


def row_is_at(env, row, arm, data):
    assert env.batch.rows.q[row] == pytest.approx(data.qpos[arm.qpos_adr], abs=1e-10)
    assert env.batch.rows.v[row] == pytest.approx(data.qvel[arm.dof_adr], abs=1e-8)


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_a_torque_acts_after_its_delay_and_the_first_one_until_then(make, delay):
    options = {} if delay == 0 else {"randomize": {"delay": armctl.Range(delay, delay + 1e-9)}}
    env = make("Reach", "torque", ticks=2, **options)
    actions = np.random.default_rng(delay).uniform(-0.05, 0.05, (6, *env.action_space.shape))
    for _ in range(2):  # the second episode remembers nothing of the first
        env.reset(seed=3)
        states = [started(env, row) for row in range(2)]
        given = [[], []]
        for action in actions:
            env.step(action)
            for row, (arm, data) in enumerate(states):
                for _ in range(2):
                    given[row].append(arm.limits.tau_max * action[row].astype(float))
                    drive(arm, data, given[row][max(len(given[row]) - 1 - delay, 0)])
                row_is_at(env, row, arm, data)


@pytest.mark.parametrize("task", ["Reach", "PickPlace"])
@pytest.mark.parametrize("action", ["joint_delta", "joint_target", "cartesian_delta", "cartesian_pose", "torque"])
def test_an_action_beyond_its_range_is_the_one_at_its_end(make, task, action):
    one = make(task, action)
    other = make(task, action)
    for env in (one, other):
        env.reset(seed=4)
    for given in random_actions(one, 5, seed=4):
        one.step(3.0 * given)
        other.step(np.clip(3.0 * given, -1.0, 1.0))
    assert np.array_equal(one.batch.rows.q, other.batch.rows.q)
    assert np.array_equal(one.batch.rows.opening, other.batch.rows.opening)


def approach_speed(arm, way, dt):
    """The signed speed from which each joint stops within a way, exponential near its end."""
    rate = min(40.0, 0.2 / dt)
    linear = rate * np.abs(way)
    rooted = np.sqrt(np.maximum(2.0 * arm.limits.a_max * (np.abs(way) - 0.5 * arm.limits.a_max / rate**2), 0.0))
    return np.sign(way) * np.where(linear * rate > arm.limits.a_max, rooted, linear)


def guarded_torque(arm, data, tau):
    """The torque of which MuJoCo's step makes the allowed velocities that are next to those of a torque; whether it differs."""
    model = arm.model
    dt = model.opt.timestep
    now = mujoco.MjData(model)
    now.qpos[:] = data.qpos
    now.qvel[:] = data.qvel
    mujoco.mj_forward(model, now)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, now, inertia)
    inertia += dt * np.diag(model.dof_damping)  # of the implicit step
    bias = now.qfrc_bias - now.qfrc_passive
    q = data.qpos[arm.qpos_adr]
    v = data.qvel[arm.dof_adr]
    free = np.linalg.solve(inertia, tau - bias)
    margin = 1e-3 * (arm.limits.q_max - arm.limits.q_min)
    upper = np.minimum(approach_speed(arm, arm.limits.q_max - margin - q, dt), arm.limits.v_max)
    lower = np.maximum(approach_speed(arm, arm.limits.q_min + margin - q, dt), -arm.limits.v_max)
    most = np.maximum((upper - v) / dt, -2.0 * arm.limits.a_max)
    least = np.minimum((lower - v) / dt, 2.0 * arm.limits.a_max)
    return inertia @ np.clip(free, least, most) + bias, (free > most) | (free < least)


def test_a_torque_that_drives_a_joint_too_fast_or_into_a_stop_is_that_of_the_allowed_velocity(tmp_path):
    """Large damping, of which an explicit step would make another velocity."""
    shape = replace(
        BENT["six joints"], joint='armature="0.1" damping="20"', torque=1000.0, range="-0.6 0.6", home="0 0 0 0 0 0"
    )
    serial_arm(tmp_path, shape)
    env = armctl.envs.ArmVectorEnv(tmp_path / "serial.xml", "Reach", "torque", 1, ticks=1, horizon=200)
    env.reset(seed=2)
    arm, data = started(env, 0)
    rng = np.random.default_rng(2)
    guarded = 0
    for k in range(120):
        if k % 40 == 0:
            action = rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
        env.step(action)
        tau, is_changed = guarded_torque(arm, data, arm.limits.tau_max * action[0].astype(float))
        drive(arm, data, tau)
        row_is_at(env, 0, arm, data)
        guarded += is_changed.any()
    env.close()
    assert guarded > 20


def follow_by_hand(arm, q, v, target, dt):
    """One tick of a reference that approaches a target: its setpoint, and where it is afterwards."""
    speed = approach_speed(arm, target - q, dt)
    after = np.clip(np.clip(speed, -arm.limits.v_max, arm.limits.v_max), v - arm.limits.a_max * dt, v + arm.limits.a_max * dt)
    a = (after - v) / dt
    return armctl.Setpoint(q, v, a, v, a), q + dt * after, after


@pytest.mark.parametrize("controller", ["computed-torque", "pd-gravity"])
@pytest.mark.parametrize("action", ["joint_delta", "joint_target"])
def test_a_controller_follows_the_target_of_an_action_as_by_hand(make, action, controller):
    ticks = 5
    env = make("Reach", action, ticks=ticks, controller=controller)
    env.reset(seed=5)
    states = [started(env, row) for row in range(2)]
    arm = states[0][0]
    margin = 1e-3 * (arm.limits.q_max - arm.limits.q_min)
    low = arm.limits.q_min + margin
    high = arm.limits.q_max - margin
    laws = [controller_by_name(controller, arm) for _ in states]
    targets = env.batch.rows.q.copy()
    references = [(env.batch.rows.q[row].copy(), np.zeros(arm.n)) for row in range(2)]
    for actions in np.random.default_rng(1).uniform(-1.0, 1.0, (6, *env.action_space.shape)):
        env.step(actions)
        for row, (_, data) in enumerate(states):
            if action == "joint_delta":
                moved = targets[row] + 0.5 * ticks * arm.dt * arm.limits.v_max * actions[row]
                targets[row] = np.clip(moved, low, high)
            else:
                targets[row] = low + 0.5 * (1.0 + actions[row]) * (high - low)
            for _ in range(ticks):
                q, v = references[row]
                setpoint, q, v = follow_by_hand(arm, q, v, targets[row], arm.dt)
                references[row] = (q, v)
                state = armctl.State(data.qpos[arm.qpos_adr].copy(), data.qvel[arm.dof_adr].copy(), data.time, arm.dt)
                drive(arm, data, laws[row].torque(state, setpoint))
            row_is_at(env, row, arm, data)
    assert np.abs(env.batch.rows.v).max() > 0.1


@pytest.mark.parametrize("action", ["cartesian_delta", "cartesian_pose"])
def test_a_cartesian_action_moves_the_tip_of_the_target_by_its_lengths_and_angles(make, action):
    env = make("Reach", action, ticks=100)  # so long that speed limits do not bind
    env.reset(seed=2)
    arm = env.batch.arm
    is_delta = action == "cartesian_delta"
    length, angle = (0.025, 0.1) if is_delta else (0.5, 1.0)  # m and rad of a full action
    moves = np.random.default_rng(2).uniform(-1.0, 1.0, (2, 6)) * (0.3 if is_delta else 0.03)
    goals = []
    for q, move in zip(env.batch.rows.q, moves, strict=True):
        start = arm.fk(q if is_delta else arm.home)
        turned = Rotation.from_rotvec(angle * move[3:]) * Rotation.from_matrix(start.rotation)
        goals.append((start.position + length * move[:3], turned))
    env.step(moves)
    for target, (position, turned) in zip(env.batch.rows.target, goals, strict=True):
        tip = arm.fk(target)
        assert tip.position == pytest.approx(position, abs=2e-4)
        assert (Rotation.from_matrix(tip.rotation) * turned.inv()).magnitude() < 2e-3


def random_actions(env, steps, seed=0):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, *env.action_space.shape)).astype(np.float32)


@pytest.mark.parametrize("task", TASKS)
def test_each_number_of_an_observation_is_what_its_column_says(make, task):
    env = make(task, "joint_delta")
    env.reset(seed=1)
    batch = env.batch
    rows = batch.rows
    for action in random_actions(env, 3):
        observations = env.step(action)[0]
    if task in ON_A_TABLE:  # a tilted object, whose axis and its mirror image differ
        rows.object[:, 3:7] = [np.roll(Rotation.random(rng=row).as_quat(), 1) for row in range(2)]
        observations = batch.observe()
    for row, observation in enumerate(observations):
        tip = batch.arm.fk(rows.q[row]).position
        expected = {"q": rows.q[row], "v": rows.v[row], "to_target": rows.target[row] - rows.q[row], "tip": tip}
        controlled = tip
        if task in ON_A_TABLE:
            controlled = rows.object[row, :3]
            turned = Rotation.from_quat(np.roll(rows.object[row, 3:7], -1))
            expected |= {
                "object": controlled,
                "object_axis": turned.apply([0.0, 0.0, 1.0]),
                "object_velocity": rows.object[row, 7:10],
                "tip_to_object": controlled - tip,
            }
        if task == "PickPlace":
            expected["opening"] = rows.opening[row]
        if task == "ReachPast":
            expected |= {"obstacle": batch.obstacle[row], "tip_to_obstacle": batch.obstacle[row] - tip}
        if task == "Track":
            path = batch.task.goals[batch.goal_number[row]]
            expected["goal_velocity"] = (path[4] - path[3]) / (batch.step_time)
            assert batch.goal[row] == pytest.approx(path[3])
        expected |= {"goal": batch.goal[row], "to_goal": batch.goal[row] - controlled}
        assert set(expected) == set(batch.observer.columns)
        for name, values in expected.items():
            assert observation[batch.observer.columns[name]] == pytest.approx(values, abs=1e-6), name


@pytest.mark.parametrize("task", ON_A_TABLE)
def test_the_object_and_the_gripper_are_those_of_the_simulation(make, task):
    env = make(task, "joint_delta", 1)
    env.reset(seed=4)
    batch = env.batch
    arm, data = started(env, 0)
    body = arm.model.body("object")
    for action in random_actions(env, 8):
        env.step(action)
    simulated = batch.rows.simulated.data(0)
    data.qpos[:] = simulated.qpos
    data.qvel[:] = simulated.qvel
    mujoco.mj_forward(arm.model, data)
    assert batch.rows.object[0, :3] == pytest.approx(data.xpos[body.id], abs=1e-9)
    axis = data.xmat[body.id].reshape(3, 3)[:, 2]
    found = batch.observe()[0]
    assert found[batch.observer.columns["object_axis"]] == pytest.approx(axis, abs=1e-6)
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(arm.model, data, mujoco.mjtObj.mjOBJ_BODY, body.id, velocity, 0)
    about_mass = velocity[3:] + np.cross(velocity[:3], data.xpos[body.id] - data.xipos[body.id])
    assert found[batch.observer.columns["object_velocity"]] == pytest.approx(about_mass, abs=1e-5)
    if task == "PickPlace":
        closed = float(np.clip(data.joint("left").qpos[0] / -0.03, -0.1, 1.1))
        assert batch.rows.opening[0] == pytest.approx(1.0 - closed, abs=0.02)
        assert 0.05 < batch.rows.opening[0] < 0.98


@pytest.mark.parametrize("reward", ["dense", "sparse"])
@pytest.mark.parametrize("task", TASKS)
def test_the_reward_is_the_distance_the_success_and_the_touch(make, task, reward):
    env = make(task, "joint_delta", reward=reward, horizon=4)
    env.reset(seed=2)
    batch = env.batch
    for step, action in enumerate(random_actions(env, 4)):
        _, rewards, terminated, truncated, information = env.step(action)
        assert not terminated.any()
        assert truncated.all() == (step == 3)
        if truncated.any():
            break
        controlled = batch.rows.object[:, :3] if task in ON_A_TABLE else batch.arm.fk_many(batch.rows.q)[0]
        distance = np.linalg.norm(controlled - batch.goal, axis=1)
        expected = 1.0 * (distance < 0.02) - (1.0 if reward == "sparse" else 5.0 * distance)
        if task == "ReachPast":
            expected -= information["touched"]
        assert rewards == pytest.approx(expected, abs=1e-5)
        assert information["distance"] == pytest.approx(distance, abs=1e-6)
        assert np.array_equal(information["is_success"], distance < 0.02)


@pytest.mark.parametrize("reward", ["dense", "sparse"])
@pytest.mark.parametrize("away", [0.019, 0.021])
def test_success_begins_at_two_centimetres(make, reward, away):
    env = make("Reach", "joint_delta", reward=reward)
    goal = np.array([0.3, 0.2, 0.1])
    achieved = goal + away * np.array([0.6, 0.0, -0.8])
    is_near = away < 0.02
    expected = is_near - 1.0 if reward == "sparse" else is_near - 5.0 * away
    assert env.compute_reward(achieved, goal, {}) == pytest.approx(expected)
    assert env.compute_reward(np.array([achieved] * 3), np.array([goal] * 3), [{}] * 3) == pytest.approx([expected] * 3)


@pytest.mark.parametrize("wrong", ["x", None, [1.0, 2.0], np.zeros(3, complex), np.zeros((2, 2)), object(), [[1], [1, 2]]])
def test_goals_and_actions_of_a_wrong_kind_are_refused(make, wrong):
    env = make("ReachPast", "joint_delta")
    with pytest.raises(armctl.InputError, match=r"^achieved_goal: "):
        env.compute_reward(wrong, np.zeros(3), {})
    with pytest.raises(armctl.InputError, match=r"^desired_goal: "):
        env.compute_reward(np.zeros(3), wrong, {})
    with pytest.raises(armctl.InputError, match=r"^action: "):
        env.step(wrong)


@pytest.mark.parametrize("info", ["x", 3, [None], object(), {"touched": [True, False, True]}])
def test_information_that_does_not_fit_the_goals_is_refused(make, info):
    env = make("ReachPast", "joint_delta")
    with pytest.raises(armctl.InputError, match=r"^info: .* does not fit goals of shapes"):
        env.compute_reward(np.zeros((2, 3)), np.zeros((2, 3)), info)


def test_noise_is_differenced_to_velocities_that_the_controller_sees(make):
    """Damping turns the noise of velocities into torques, which shake the arm as much as noise of the same size by hand."""
    deviation = 1e-4
    ticks = 50
    env = make(
        "Reach", "joint_delta", 8, ticks=1, controller="pd", randomize={"encoder_noise": armctl.Range(deviation, 1.01e-4)}
    )
    env.reset(seed=0)
    batch = env.batch
    arm = batch.arm
    starts = batch.rows.q.copy()
    nothing = np.zeros(env.action_space.shape)
    speeds = []
    for _ in range(ticks):
        env.step(nothing)
        speeds.append(batch.rows.v.copy())
    rng = np.random.default_rng(0)
    by_hand = {}
    for differenced in (True, False):
        found = []
        for q in starts:
            data = mujoco.MjData(arm.model)
            data.qpos[:] = arm.qpos(q)
            law = controller_by_name("pd", arm)
            last = np.zeros(arm.n)
            for _ in range(ticks):
                noise = deviation * rng.standard_normal(arm.n)
                v = data.qvel[arm.dof_adr] + (noise - last) / arm.dt * differenced
                last = noise
                state = armctl.State(data.qpos[arm.qpos_adr] + noise, v, data.time, arm.dt)
                drive(arm, data, law.torque(state, armctl.Setpoint(q, 0.0 * q, 0.0 * q)))
                found.append(data.qvel[arm.dof_adr].copy())
        changes = np.diff(np.reshape(found, (len(starts), ticks, arm.n)), axis=1)
        by_hand[differenced] = changes.std()
    assert by_hand[True] > 3.0 * by_hand[False]
    changes = np.diff(speeds, axis=0)
    assert changes.std() == pytest.approx(by_hand[True], rel=0.1)


def test_a_varied_object_has_the_inertia_of_its_cylinder(make):
    ranges = {"object_size": armctl.Range(0.7, 1.3), "object_mass": armctl.Range(0.05, 0.5)}
    env = make("Push", "joint_delta", 3, randomize=ranges)
    env.reset(seed=0)
    for row in range(3):
        model = env.batch.rows.simulated.model(row)
        body = model.body("object")
        radius, half = model.geom("object").size[:2]
        mass = float(body.mass[0])
        across = mass * (3.0 * radius**2 + (2.0 * half) ** 2) / 12.0
        assert np.sort(body.inertia) == pytest.approx(np.sort([across, across, 0.5 * mass * radius**2]), rel=1e-6)
        assert half == pytest.approx(radius * env.batch.task.height / (2.0 * env.batch.task.radius))


def test_the_jaws_close_at_ten_centimetres_a_second(make):
    env = make("PickPlace", "joint_delta", 1, ticks=10)
    env.reset(seed=0)
    actions = np.zeros(env.action_space.shape)
    actions[:, -1] = -1.0
    data = env.batch.rows.simulated.data(0)
    control = env.batch.arm.model.actuator("grip").id
    controls = []
    for _ in range(20):
        env.step(actions)
        controls.append(float(data.ctrl[control]))
    # Each of the two fingers moves at half of the speed at which their distance changes, and the control is its position.
    assert np.diff(controls[:10]) == pytest.approx(np.full(9, -0.05 * env.batch.step_time), rel=0.02)
