"""How errors decay under computed torque: by its formula, judged by MuJoCo's inverse dynamics and by simulated errors."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from motions import Still
from synthetic import BENT, SHAPES, Shape, limb, motors, serial_arm

import armctl
from armctl.cli.describe import describe, facts
from armctl.lab.loops.margins_html import margins_table

HEAVY_DAMPING = replace(BENT["six joints"], joint='armature="0.02" damping="8"')
LIGHT = replace(SHAPES["light"], joint="")
ARMS = {
    "damped": BENT["planar"],
    "damped wrist": HEAVY_DAMPING,
    "damping alone": Shape(0.3, 2.0, 100.0, joints=1, joint='damping="30"', home="0.3"),
    "light links": LIGHT,
    "light and damped": replace(LIGHT, joint='damping="0.5"'),
    "strong motors": replace(BENT["redundant"], torque=2000.0),
}


def torque_of_mujoco(arm: armctl.Arm, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """(n,) N m, by `mj_inverse` in continuous time."""
    model = arm.model
    data = mujoco.MjData(model)
    data.qpos[arm.qpos_adr] = q
    data.qvel[arm.dof_adr] = v
    data.qacc[arm.dof_adr] = a
    mujoco.mj_inverse(model, data)
    return data.qfrc_inverse[arm.dof_adr]


@pytest.mark.parametrize("shape", ARMS.values(), ids=ARMS)
@pytest.mark.parametrize(("bandwidth", "ratio"), [(30.0, 1.0), (1.3**0.5, 0.48), (5.0, 2.5)])
def test_the_textbook_form_is_the_textbook_law(tmp_path, shape, bandwidth, ratio):
    arm = serial_arm(tmp_path, shape)
    law = armctl.ComputedTorque(arm, bandwidth=bandwidth, damping_ratio=ratio, form="textbook")
    rng = np.random.default_rng(3)
    for dt in (0.0, 0.002):
        q, v, q_ref, v_ref, a_ref = rng.uniform(-0.5, 0.5, (5, arm.n))
        a = a_ref + bandwidth**2 * (q_ref - q) + 2 * ratio * bandwidth * (v_ref - v)
        tau = law.torque(armctl.State(q, v, 0.0, dt), armctl.Setpoint(q_ref, v_ref, a_ref))
        assert tau == pytest.approx(torque_of_mujoco(arm, q, v, a), rel=1e-9, abs=1e-9)
    assert law.added_inertia(0.002) == pytest.approx(np.zeros(arm.n))


@pytest.mark.parametrize("shape", ARMS.values(), ids=ARMS)
@pytest.mark.parametrize("bandwidth", [10.0, 30.0])
def test_no_error_decays_more_slowly_than_the_bandwidth_says(tmp_path, shape, bandwidth):
    arm = serial_arm(tmp_path, shape)
    goal = arm.limits.clamp(arm.home)
    law = armctl.ComputedTorque(arm, bandwidth=bandwidth)
    loop = armctl.linearize(arm, law, goal)
    slowest = loop.slowest_pole
    assert 0.78 * bandwidth < slowest < 1.1 * bandwidth  # the estimate of the velocity moves two equal poles apart
    simulation = armctl.Simulation(arm, law)
    off = 1e-3 * np.where(np.arange(arm.n) % 2, -1.0, 1.0)
    simulation.reset(goal + off)
    seconds = 10.0 / bandwidth
    log = simulation.run(Still(goal, seconds))
    t = log.t[:, None]
    left = np.abs(log.q - goal).max(axis=1, keepdims=True) / 1e-3
    # The formula leaves (1 + w t) exp(-w t).
    rate = 0.78 * bandwidth
    assert (left <= 3.0 * (1 + rate * t) * np.exp(-rate * t) + 1e-6).all()


@pytest.mark.parametrize("name", ["computed-torque-observer", "computed-torque-learning", "qp", "mpc", "operational-space"])
def test_the_laws_derived_from_it_lose_no_error_more_slowly_on_damped_joints(tmp_path, name):
    arm = serial_arm(tmp_path, HEAVY_DAMPING)
    goal = arm.limits.clamp(arm.home)
    simulation = armctl.Simulation(arm, name)
    simulation.reset(goal + 1e-3)
    log = simulation.run(Still(goal, 1.0))
    assert np.abs(log.q[-1] - goal).max() < 1e-3 * 1e-4


def test_margins_and_a_comparison_have_the_slowest_pole(load):
    arm = load(limb("a b", joint='damping="3" armature="0.05"'), motors("a b"))
    motion = armctl.move_j(arm, arm.home, arm.home + 0.3)
    reports = armctl.compare(arm, ["computed-torque", armctl.ComputedTorque(arm, bandwidth=8.0)], motion, configurations=2)
    assert [report.slowest_pole_per_s for report in reports] == pytest.approx([30.0, 8.0], rel=0.22)
    assert "slowest pole, 1/s" in armctl.table(reports)
    found = armctl.margins(arm, "computed-torque", 2)
    assert found.slowest_pole.value == pytest.approx(30.0, rel=0.22)
    assert found.bandwidth == 30.0
    assert f"slowest pole {found.slowest_pole.value:.3g} 1/s (bandwidth 30 rad/s)" in str(found)
    table = margins_table([found, armctl.margins(arm, "pd", 2)])
    poles = [row[table.header.index("slowest pole, 1/s")] for row in table.rows]
    assert [row[table.header.index("bandwidth, rad/s")] for row in table.rows] == ["30", "-"]
    assert float(poles[0]) == pytest.approx(found.slowest_pole.value, rel=1e-2)


def test_the_description_of_an_arm_has_the_slowest_pole_beside_the_bandwidth(load):
    arm = load(limb("a b", joint='damping="3" armature="0.05"'), motors("a b"))
    slowest = armctl.linearize(arm, "computed-torque", arm.home).slowest_pole
    assert facts(arm)["slowest_pole_per_s"] == pytest.approx(slowest)
    assert f"slowest pole {slowest:.3g} 1/s, bandwidth 30 rad/s" in describe(arm, facts(arm))


def test_a_comparison_waits_for_slow_laws_and_says_when_they_settled(load):
    arm = load(limb("a b", joint='damping="6" armature="0.05"'), motors("a b"))
    motion = armctl.move_j(arm, arm.home, arm.home + 0.5)
    law = armctl.PDGravity(arm, stiffness=20.0, damping=2.0)  # decays with 20 / (6 + 2) 1/s
    short, long = (
        armctl.compare(arm, [law], motion, [armctl.Plant()], configurations=0, dwell=dwell)[0] for dwell in (0.25, 4.0)
    )
    default = armctl.compare(arm, [law], motion, [armctl.Plant()], configurations=0)[0]
    assert not short.ok
    assert long.ok
    assert long.final_tip_error_m < 0.01 * short.final_tip_error_m
    assert long.settling_time_s > 0.5
    assert short.verdict.startswith("not reached, not yet at rest")
    assert default.ok
    assert np.abs(default.log.v[-1]).max() < 1e-3
    assert motion.duration + 0.5 < default.duration_s < motion.duration + 5.0


def test_a_comparison_waits_no_longer_than_until_the_arm_rests_or_the_dwell_ends(load):
    arm = load(limb("a b", joint='damping="6" armature="0.05"'), motors("a b"))
    motion = armctl.move_j(arm, arm.home, arm.home + 0.5)
    sagging = armctl.PD(arm, stiffness=20.0, damping=2.0)
    fast, slow, at_rest = armctl.compare(
        arm,
        ["computed-torque", armctl.PDGravity(arm, stiffness=4.0, damping=2.0), sagging],
        motion,
        [armctl.Plant()],
        configurations=0,
        dwell=6.0,
    )
    assert fast.duration_s < motion.duration + 1.5
    assert slow.duration_s == pytest.approx(motion.duration + 6.0, abs=0.03)  # decays with 4 / (6 + 2) 1/s
    assert slow.verdict.startswith("not reached, not yet at rest")
    assert at_rest.duration_s < motion.duration + 6.0
    assert at_rest.verdict.startswith("not reached: ")
