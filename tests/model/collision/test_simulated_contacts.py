"""What a proof calls free makes no contact in a simulation: margins, gaps, listed pairs, and pairs that a proof leaves out."""

import mujoco
import numpy as np
import pytest

import armctl
from armctl.model.collision.checkers import collision_checker

ARM = """<mujoco><option{option}><flag {flag}/></option><compiler angle="radian"/><worldbody>
<geom name="floor" type="plane" size="2 2 .1" pos="0 0 {floor}" margin="{margin}" gap="{gap}"/>
<geom name="ball" size=".06" pos=".35 .2 .25" margin=".01"/>
<body name="turret" pos="0 0 .2"><joint name="pan" axis="0 0 1" range="-3 3" damping="1"/>
<geom type="cylinder" size=".06 .05"/>
<body name="upper" pos="0 0 .1"><joint name="lift" axis="0 1 0" range="-1 1" damping="1"/>
<geom name="upper" type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
<body name="lower" pos=".3 0 0"><joint name="elbow" axis="0 1 0" range="-2 2" damping="1"/>
<geom name="lower" type="{shape}" pos=".15 0 0" size=".1 .03 .02" margin=".005"/></body></body></body></worldbody>
<contact>{pair}</contact>
<actuator><motor joint="pan" ctrlrange="-50 50"/><motor joint="lift" ctrlrange="-50 50"/>
<motor joint="elbow" ctrlrange="-50 50"/></actuator></mujoco>"""


def arm_over_floor(margin=0.0, gap=0.0, *, floor=-0.1, shape="box", pair="", option="", flag=""):
    text = ARM.format(margin=margin, gap=gap, floor=floor, shape=shape, pair=pair, option=option, flag=flag)
    return armctl.load(mujoco.MjSpec.from_string(text))


MARGINS = [
    {},
    {"margin": 0.05},
    {"margin": 0.05, "gap": 0.2},
    {"gap": 0.3},
    {"margin": 0.02, "shape": "ellipsoid"},
    {"margin": 0.02, "pair": '<pair geom1="lower" geom2="floor" margin="0.15"/>'},
    {"margin": 0.2, "pair": '<pair geom1="floor" geom2="lower"/><pair geom1="ball" geom2="lower" margin="0.1" gap="0.1"/>'},
    {"margin": 0.2, "option": ' o_margin="0.04"', "flag": 'override="enable"'},
]


@pytest.mark.parametrize("margins", MARGINS)
def test_a_checker_finds_contact_exactly_where_mujoco_lets_bodies_press_on_each_other(margins):
    arm = arm_over_floor(**margins)
    checker = collision_checker(arm)
    data = mujoco.MjData(arm.model)
    touched = 0
    for q in arm.limits.random(arm.home, 300, np.random.default_rng(0)):
        data.qpos[:] = arm.qpos(q)
        mujoco.mj_forward(arm.model, data)
        depths = [contact.includemargin - contact.dist for contact in data.contact if contact.efc_address >= 0]
        pair, distance = checker.nearest(q)
        assert (checker.hit(q) >= 0) == (distance <= 0.0)
        if min(map(abs, depths), default=1.0) < 1e-6:
            continue
        touched += bool(depths)
        assert bool(depths) == (distance <= 0.0), (q, depths, distance)
        if depths and margins.get("shape") != "ellipsoid":
            assert max(checker.depth(q, p) for p in range(len(checker.geometry.pairs))) == pytest.approx(max(depths), abs=2e-3)
        assert pair >= 0
    assert 20 < touched < 300


@pytest.mark.parametrize("controller", ["computed-torque", "in Python"])
@pytest.mark.parametrize("margins", MARGINS)
def test_a_move_that_is_proved_free_presses_on_nothing(margins, controller):
    arm = arm_over_floor(**margins)
    law = armctl.ComputedTorque(arm)

    class InPython:
        def torque(self, state, setpoint):
            return law.torque(state, setpoint)

    simulation = armctl.Simulation(arm, InPython() if controller == "in Python" else controller)
    moved = 0
    for q in arm.limits.random(arm.home, 6, np.random.default_rng(1)):
        result = simulation.move_j(q)
        moved += result.log is not None
        assert result.contacts == ()
        assert result.left_out == ()
        assert result.ok == (result.log is not None), result
    assert moved >= 2


def test_a_contact_within_the_gap_of_a_geom_exerts_no_force_and_is_not_reported():
    arm = arm_over_floor(gap=1.0)
    log = armctl.Simulation(arm).move_j(arm.home + 0.1).log
    assert log.contacts == ()


def test_a_link_within_the_margin_of_the_floor_wherever_the_arm_is_does_not_rub_on_it():
    with pytest.warns(armctl.ArmctlWarning, match="world overlaps with turret wherever the arm is; their contact is left out"):
        arm = arm_over_floor(margin=0.3, floor=-0.1)
    simulation = armctl.Simulation(arm)
    result = simulation.move_j([1.0, -0.9, 0.0])
    assert result.ok, result
    assert result.contacts == ()
    assert np.abs(result.log.q[-1] - result.log.q_ref[-1]).max() < 1e-3


LINKS = """<mujoco><compiler angle="radian"/><worldbody><body name="base"><geom size=".03 .05" type="cylinder"/>
<body name="a" pos="0 0 .1"><joint name="j1" axis="0 0 1" range="-2 2" damping="1"/><geom name="ga" size=".03"/>
<body name="b" pos="0 0 .02"><joint name="j2" axis="0 1 0" range="-1 1" damping="1"/><geom size=".01" mass="1"/>
<body name="c" pos="0 0 .02"><joint name="j3" axis="0 0 1" range="-2 2" damping="1"/>
<geom type="capsule" fromto="0 0 0 0 0 .3" size=".03"/></body></body></body></body></worldbody>
<actuator><motor joint="j1" ctrlrange="-50 50"/><motor joint="j2" ctrlrange="-50 50"/><motor joint="j3" ctrlrange="-50 50"/>
</actuator></mujoco>"""


@pytest.mark.parametrize("read", [mujoco.MjModel.from_xml_string, mujoco.MjSpec.from_string])
def test_contacts_that_a_proof_leaves_out_and_a_simulation_keeps_are_named(read):
    arm = armctl.load(read(LINKS))
    result = armctl.Simulation(arm).move_j([0.2, 0.2, 0.2])
    assert {(contact.body, contact.other) for contact in result.contacts} == {("a", "c")}
    assert result.left_out == (("a", "c"),)
    assert result.clearance > 0.0
    check = armctl.check_clearance(arm, armctl.move_j(arm, arm.home, arm.home + 0.2))
    assert check.left_out == (("a", "c"),)
    assert str(check).endswith("not proved, since they always touch: a with c")


def test_an_obstacle_that_a_link_cuts_wherever_the_arm_is_is_named_by_every_proof():
    crate = armctl.World().add("crate", armctl.Box([1.0, 1.0, 0.2]), at=[0.0, 0.0, 0.2])
    text = ARM.format(margin=0.0, gap=0.0, floor=-1.0, shape="box", pair="", option="", flag="")
    arm = armctl.load(mujoco.MjSpec.from_string(text), scene=crate)
    check = armctl.check_clearance(arm, armctl.move_j(arm, arm.home, arm.home))
    assert ("crate", "turret") in check.left_out
