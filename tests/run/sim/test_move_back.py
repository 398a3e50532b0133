"""Commands.move_back and Commands.gate: the way of a run back, and a gate that looks at the simulation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arms import BUNDLED, arm_of, some_of

import armctl


@pytest.mark.parametrize("name", some_of([BUNDLED, "panda", "ur5e"], [BUNDLED], ["panda"]))
def test_the_way_back_is_the_way_out_within_the_limits(name: str):
    sim = armctl.Simulation(arm_of(name))
    start = sim.state.q
    result = sim.move_to(sim.tip.position + np.array([-0.05, 0.05, 0.03]))
    assert result, result.reason
    out = sim.log.q_ref
    back = sim.move_back()
    assert back, back.reason
    assert np.abs(sim.state.q - start).max() < 1e-4
    assert sim.log.motion_duration < 1.5 * result.log.motion_duration
    nearest = np.abs(sim.log.q_ref[::20, None] - out[None]).max(axis=2).min(axis=1)
    assert nearest.max() < 2e-3  # between two ticks of the way out
    limits = sim.arm.limits
    assert (np.abs(sim.log.v_ref) <= limits.v_max * (1 + 1e-6)).all()
    assert (np.abs(sim.log.a_ref) <= limits.a_max * (1 + 1e-6)).all()


def test_a_second_call_goes_forward_again_and_half_the_speed_takes_twice_as_long():
    sim = armctl.Simulation(arm_of(BUNDLED))
    goal = sim.arm.home + 0.3
    assert sim.move_j(goal)
    assert sim.move_back()
    once = sim.log.motion_duration
    assert sim.move_back(speed=0.5)
    assert np.abs(sim.state.q - goal).max() < 1e-4
    assert sim.log.motion_duration == pytest.approx(2 * once, rel=0.02)


def test_the_way_back_keeps_the_velocity_limits_near_the_ends_of_the_ranges():
    arm = arm_of(BUNDLED)
    limits = replace(arm.limits, deceleration_limit=0.3 * arm.limits.a_max)
    arm = arm.with_limits(limits)
    sim = armctl.Simulation(arm)
    near = arm.home.copy()
    near[0] = limits.q_max[0] - 0.02
    sim.reset(near)
    out = sim.move_j(arm.home, avoid=False)  # away from the end, where no velocity is limited
    assert out, out.reason
    assert sim.move_back()
    low, high = limits.velocity_bounds(sim.log.q_ref)
    assert (sim.log.v_ref <= high * (1 + 1e-6) + 1e-9).all()
    assert (sim.log.v_ref >= low * (1 + 1e-6) - 1e-9).all()
    assert sim.log.motion_duration > 1.1 * out.log.motion_duration


def test_the_way_back_is_proved_in_the_world_as_it_is_now():
    sim = armctl.Simulation(arm_of(BUNDLED))
    assert sim.move_j(sim.arm.home + np.array([0.8, 0.0, 0.0]))
    tip = sim.arm.fk(sim.arm.home).position
    sim.world.add("box", armctl.Box([0.1, 0.1, 0.1]), at=tip)
    before = sim.state.q
    refused = sim.move_back()
    assert not refused
    assert "box" in refused.reason
    assert (sim.state.q == before).all()
    sim.world.remove("box")
    assert sim.move_back()


def test_only_the_way_of_the_last_motion_can_be_gone_back():
    sim = armctl.Simulation(arm_of(BUNDLED))
    with pytest.raises(armctl.InputError, match="nothing has run yet"):
        sim.move_back()
    first = sim.move_j(sim.arm.home + 0.1).log
    assert sim.move_j(sim.arm.home + 0.2)
    with pytest.raises(armctl.InputError, match="only the way of the last motion"):
        sim.move_back(first)
    sim.apply_ctrl(np.zeros(sim.arm.n), 0.01)
    with pytest.raises(armctl.InputError, match="no reference"):
        sim.move_back()


LOOSE = """
<mujoco><worldbody>
  <body name="can" pos="0.3 -0.2 0.05"><freejoint/><geom type="cylinder" size="0.03 0.05" mass="0.2"/></body>
  <geom name="floor" type="plane" size="1 1 0.1"/>
</worldbody></mujoco>
"""


def test_the_gate_of_a_simulation_sees_what_moved_and_its_motion_runs(tmp_path: Path):
    (tmp_path / "scene.xml").write_text(LOOSE)
    sim = armctl.Simulation(armctl.load(BUNDLED, scene=tmp_path / "scene.xml"))
    gate = sim.gate(clearance=0.005)
    goal = sim.arm.home + np.array([0.5, 0.0, 0.0])
    free = gate.admit(sim.state.q, q=goal)
    assert free, free.reason
    address = sim.model.jnt_qposadr[sim.model.body("can").jntadr[0]]
    sim.data.qpos[address : address + 3] = sim.arm.fk(goal).position
    blocked = gate.admit(sim.state.q, q=goal)
    assert not blocked
    assert "can" in blocked.bodies
    sim.run(blocked.motion)
    assert not [contact for contact in sim.log.contacts if contact.other == "can"]
    sim.data.qpos[address : address + 3] = [0.0, 0.0, 5.0]
    assert gate.admit(sim.state.q, q=goal)
    sim.world.add("box", armctl.Box([0.1, 0.1, 0.1]), at=sim.arm.fk(goal).position)
    assert "box" in gate.admit(sim.state.q, q=goal).bodies
