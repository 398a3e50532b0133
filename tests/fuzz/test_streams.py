"""Random chunks, single targets, velocities and stops, some of them broken: a stream keeps all limits and ends at rest.

What is broken - not finite, not increasing, too far ahead, of a wrong shape - is refused by one sentence and changes nothing.
The judge uses the setpoints only: their bounds, their differences, and MuJoCo's inverse dynamics.
"""

from collections import Counter
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
from arms import ARMS, arm_of
from test_motions import MAX_LISTED, SUITE_ARMS, random_q, scaled_limits

import armctl

PUSHES = 50  # of a case
CASES_IN_SUITE = 12
DT = 4e-3
POSITION_TOLERANCE = 2e-9
RATIO_TOLERANCE = 2e-6
TICKS_PER_TORQUE = 7
BROKEN = ("not a number", "infinite", "reversed", "duplicate", "too far ahead", "one row less", "one joint less", "empty")


def holding(arm: armctl.Arm, q: np.ndarray, v: np.ndarray, a: np.ndarray, data: mujoco.MjData) -> np.ndarray:
    """(n,) N m, what the motors have to give beside friction, by MuJoCo."""
    data.qpos[:] = arm.home_qpos
    arm.joint_map.set_positions(data.qpos, q)
    data.qvel[arm.dof_adr] = v
    data.qacc[arm.dof_adr] = a
    mujoco.mj_inverse(arm.model, data)
    return (data.qfrc_inverse + data.qfrc_constraint)[arm.dof_adr]


def violation(arm: armctl.Arm, points: list[armctl.Setpoint], is_judged_by_torque: bool) -> str:
    """Which limit the setpoints break; empty if none."""
    limits = arm.limits
    q, v, a = (np.array([point[i] for point in points]) for i in range(3))
    if not limits.contains(q, POSITION_TOLERANCE):
        return f"position, by {np.maximum(q - limits.q_max, limits.q_min - q).max():.3g}"
    for name, x, bound in (("velocity", v, limits.v_max), ("acceleration", a, limits.a_max)):
        if (np.abs(x) > bound * (1 + RATIO_TOLERANCE)).any():
            return f"{name}, {(np.abs(x) / bound).max():.9g} of its limit"
    jerk = np.abs(np.diff(a, axis=0)) / DT
    if (jerk > limits.j_max * (1 + RATIO_TOLERANCE) + 1e-9 * limits.a_max / DT).any():
        return f"jerk, {(jerk / limits.j_max).max():.9g} of its limit"
    # A jerk below its limit leaves no more than this between the difference of positions and the mean of velocities.
    gap = np.abs(np.diff(q, axis=0) - 0.5 * DT * (v[1:] + v[:-1]))
    if (gap > DT**3 / 12 * limits.j_max * (1 + RATIO_TOLERANCE) + POSITION_TOLERANCE).any():
        return f"position and velocity differ by {gap.max():.3g}"
    if is_judged_by_torque:
        data = mujoco.MjData(arm.model)
        free = limits.tau_max + arm.model.dof_frictionloss[arm.dof_adr]
        for k in range(0, len(q), TICKS_PER_TORQUE):
            share = np.abs(holding(arm, q[k], v[k], a[k], data)) / free
            if (share > 1.0).any():
                return f"torque, {share.max():.6g} of its limit"
    return ""


def broken(kind: str, times: np.ndarray, rows: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A chunk with a fault of this kind."""
    times = times.copy()
    rows = rows.copy()
    k = rng.integers(len(times))
    match kind:
        case "not a number":
            rows[k, rng.integers(rows.shape[1])] = np.nan
        case "infinite":
            times[k] = rng.choice([np.inf, -np.inf, np.nan])
        case "reversed":
            times = np.append(times, times[-1] - 0.01)
            rows = np.vstack([rows, rows[-1]])
        case "duplicate":
            times = np.append(times, times[-1])
            rows = np.vstack([rows, rows[-1]])
        case "too far ahead":
            times[-1] += 1e3
        case "one row less":
            rows = rows[:-1]
        case "one joint less":
            rows = rows[:, :-1]
        case "empty":
            times = times[:0]
            rows = rows[:0]
    return times, rows


def course(stream: armctl.Stream) -> np.ndarray:
    """Where a stream is, and how long it moves on."""
    return np.append(np.concatenate(stream.setpoint[:3]), stream.time_left)


def push_positions(stream: armctl.Stream, kind: str, push: Callable[..., object], times: object, q: np.ndarray) -> str:
    """Gives a stream positions, of which it refuses those that are half a turn or 1 m outside the limits; what they are."""
    before = course(stream)
    try:
        push(times, q)
    except armctl.LimitError as error:
        refused = str(error)
    else:
        return kind
    assert "degrees?" in refused or "millimetres?" in refused
    assert np.array_equal(before, course(stream))
    return "far outside"


def push(stream: armctl.Stream, arm: armctl.Arm, rng: np.random.Generator) -> str:
    """Gives a stream something random; what it is."""
    q = stream.setpoint.q
    kind = rng.choice(["chunk", "broken", "target", "far", "twist", "pose", "stop"], p=[0.6, 0.1, 0.14, 0.06, 0.04, 0.04, 0.02])
    gaps = 10.0 ** rng.uniform(-3.5, -0.5) * rng.choice([1, 1, 1, 15], 30)
    times = stream.t + rng.uniform(-0.3, 0.3) + np.minimum(np.cumsum(gaps), 55.0 + np.arange(30) / 30)
    count = int(rng.integers(1, 30))
    times = times[:count]
    walk = rng.standard_normal((count, arm.n)) * 10.0 ** rng.uniform(-5, 0.5)
    if rng.random() < 0.5:
        walk = np.cumsum(walk, axis=0)
    match kind:
        case "chunk":
            kind = push_positions(stream, "chunk", stream.push_chunk, times, q + walk)
        case "broken":
            kind = str(rng.choice(BROKEN))
            before = course(stream)
            with pytest.raises(armctl.InputError) as refused:
                stream.push_chunk(*broken(kind, times, q + walk, rng))
            assert "\n" not in str(refused.value)
            assert np.array_equal(before, course(stream)), kind
        case "target":
            kind = push_positions(stream, "target", stream.push, stream.t + rng.uniform(-0.2, 0.1), q + walk[0])
        case "far":
            kind = push_positions(stream, "far", stream.push, stream.t + rng.choice([0.0, 0.5]), random_q(arm, rng)[0])
        case "twist":
            stream.push_twist(rng.standard_normal(3) * rng.choice([0.1, 10.0]), rng.standard_normal(3))
        case "pose":
            stream.push_pose(stream.t, arm.fk(random_q(arm, rng)[0]))
        case "stop":
            stream.stop()
    return str(kind)


def run(arm: armctl.Arm, rng: np.random.Generator, tally: Counter) -> str:
    """What a stream violates in a case; empty if nothing."""
    real = rng.random() < 0.6
    arm = arm if real else scaled_limits(arm, rng)
    start = random_q(arm, rng)[0]
    zero = np.zeros(arm.n)
    held = np.abs(holding(arm, start, zero, zero, mujoco.MjData(arm.model)))
    stream = armctl.Stream(arm, start)
    points = [stream.setpoint]
    for _ in range(PUSHES):
        tally[push(stream, arm, rng)] += 1
        points += [stream.step(DT) for _ in range(int(rng.exponential(6.0)))]
    tally["not changed"] += stream.report.refused
    can_hold = real and bool((held <= 0.95 * arm.limits.tau_max).all())
    found = violation(arm, points, can_hold)
    stream.step(stream.time_left)
    if not found and np.abs(stream.setpoint.v / arm.limits.v_max).max() > 1e-6:
        return "it does not end at rest"
    return found


def test_random_chunks_break_no_limit_and_broken_ones_are_refused(fuzz_cases, fuzz_seconds, fuzz_first):
    names = ARMS if fuzz_seconds else [name for name in ARMS if name in SUITE_ARMS]
    arms = [arm_of(name) for name in names]
    tally = Counter()
    violations = []
    for case, rng in enumerate(fuzz_cases(CASES_IN_SUITE), start=fuzz_first):
        arm = arms[case % len(arms)]
        try:
            found = run(arm, rng, tally)
        except Exception as error:
            found = f"{type(error).__name__}: {error}"
        if found:
            violations.append(f"case {case}, {arm.name}: {found}")
    print(f"{case + 1 - fuzz_first} streams, {sum(tally.values()) - tally['not changed']} pushes: {dict(tally)}")
    assert not violations, "\n".join([f"{len(violations)} violations", *violations[:MAX_LISTED]])
