"""Several actuators on one joint: their torques add, or the arm is refused; load, info and doctor name them."""

import mujoco
import numpy as np
import pytest
from synthetic import FAST, limb, mjcf, tendon

import armctl

M = '<motor name="m" joint="b" gear="10" ctrlrange="-5 5"/>'
ELBOW = "<motor name='first' joint='a' ctrlrange='-60 60'/>"
SUMS = {
    "two motors": (M + '<motor name="n" joint="b" gear="10" ctrlrange="-3 3"/>', 80.0),
    "opposite gears": (M + '<motor name="n" joint="b" gear="-4" ctrlrange="-5 5"/>', 70.0),
    "a trim motor": ('<motor name="n" joint="b" ctrlrange="-1 1"/><motor name="m" joint="b" gear="8" ctrlrange="-5 5"/>', 41.0),
    "three motors": (M + '<motor name="n" joint="b" ctrlrange="-3 3"/><motor name="o" joint="b" forcerange="-7 7"/>', 60.0),
    "a position servo": (M + '<position name="n" joint="b" kp="100" forcerange="-20 20"/>', 70.0),
    "a velocity servo": (M + '<velocity name="n" joint="b" kv="10" forcerange="-7 7"/>', 57.0),
    "a general motor": (M + '<general name="n" joint="b" gear="2" gainprm="3" ctrlrange="-1 1"/>', 56.0),
    "a general servo": (
        M + '<general name="n" joint="b" gainprm="50" biastype="affine" biasprm="0 -50 -5" forcerange="-9 9"/>',
        59.0,
    ),
    "a motor on a tendon": (M + '<motor name="n" tendon="cable" ctrlrange="-500 500"/>', 70.0),
    "a cylinder": (M + '<cylinder name="n" joint="b" area="2" bias="1 0 0" ctrlrange="-5 5"/>', 59.0),
    "a motor behind a filter": (
        M + '<general name="n" joint="b" dyntype="filterexact" dynprm="0.01" gainprm="3" ctrlrange="-2 2"/>',
        56.0,
    ),
    "an integrated control": (M + '<general name="n" joint="b" dyntype="integrator" gainprm="3" actrange="-1 1"/>', 53.0),
    "a gain that is affine by name": (
        M + '<general name="n" joint="b" gaintype="affine" gainprm="3 0 0" ctrlrange="-2 2"/>',
        56.0,
    ),
    "motors on a cable that bears 50 N": (
        '<motor name="m" tendon="weak" ctrlrange="-30 30"/><motor name="n" tendon="weak" ctrlrange="-40 40"/>',
        2.0,
    ),
    "a motor and a cable that bears 50 N": (M + '<motor name="n" tendon="weak" ctrlrange="-500 500"/>', 52.0),
    "an integrating servo": (M + '<intvelocity name="n" joint="b" kp="5" actrange="-1 1" forcerange="-6 6"/>', 56.0),
    "one for each direction": (
        '<motor name="m" joint="b" ctrlrange="0 30"/><motor name="n" joint="b" ctrlrange="-30 0"/>',
        30.0,
    ),
}
OFF = {
    "gains of 0": M + '<velocity name="n" joint="b" kv="0"/>',
    "a gear of 0": M + '<motor name="n" joint="b" gear="0" ctrlrange="-5 5"/>',
    "a disabled group": '<position name="n" joint="b" kp="90" group="2"/>' + M,
}
REFUSED = {
    "a servo without a limit": (M + '<position name="n" joint="b" kp="100"/>', "'n' without a torque limit"),
    "a DC motor": (M + '<dcmotor name="n" joint="b" nominal="24 33 21"/>', "falls with the speed"),
    "other delays": (M + '<motor name="n" joint="b" ctrlrange="-3 3" delay="0.004" nsample="6"/>', "their delays differ"),
}


def written(actuators: str, more: str = "") -> str:
    cable = ""
    if "tendon=" in actuators:
        cable = tendon(b=0.04)
        cable += cable.replace('name="cable"', 'name="weak" actuatorfrcrange="-50 50"')
    return mjcf(limb("a b", joint='armature="0.05"'), FAST + more + cable + f"<actuator>{ELBOW}{actuators}</actuator>")


def torque_in_mujoco(text: str) -> float:
    """The torque of both signs on joint b that all actuators of a file give at rest, by MuJoCo alone."""
    model = mujoco.MjModel.from_xml_string(text)
    greatest = []
    for sign in (1, -1):
        data = mujoco.MjData(model)
        for control in range(1, model.nu):
            moves = sign * float(model.actuator_gear[control, 0])
            data.ctrl[control] = np.sign(moves) * 1e6
            if model.actuator_ctrllimited[control]:
                data.ctrl[control] = model.actuator_ctrlrange[control, int(moves > 0)]
            if model.actuator_actnum[control]:
                state = model.actuator_actadr[control]
                data.act[state] = data.ctrl[control]
                is_servo = model.actuator_biasprm[control, 1] != 0.0  # gives as much elsewhere, at another position
                if is_servo:
                    model.actuator_actlimited[control] = 0
                    data.act[state] = np.sign(moves) * 1e6
                elif model.actuator_actlimited[control]:
                    data.act[state] = model.actuator_actrange[control, int(moves > 0)]
        mujoco.mj_forward(model, data)
        greatest.append(sign * float(data.qfrc_actuator[1]))
    return min(greatest)


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("form", SUMS)
def test_the_torques_of_several_actuators_add(form: str, order: int):
    actuators, expected = SUMS[form]
    text = written("/>".join(actuators.split("/>")[:-1][::order]) + "/>")
    with pytest.warns(armctl.ArmctlWarning, match="joint 'b' is moved by '.*sum of their torques"):
        arm = armctl.load(mujoco.MjSpec.from_string(text))
    assert torque_in_mujoco(text) == pytest.approx(expected)
    assert arm.limits.tau_max[1] == pytest.approx(expected)
    assert any("'m' (" in note and "'n' (" in note for note in arm.notes)
    findings = armctl.diagnose(mujoco.MjSpec.from_string(text)).findings
    assert any("sum of their torques" in finding.text for finding in findings)
    arms = [arm]
    model = mujoco.MjModel.from_xml_string(text)
    if not model.na:  # a compiled model cannot lose a state
        with pytest.warns(armctl.ArmctlWarning, match="sum of their torques"):
            arms.append(armctl.load(model))
    for each in arms:
        simulation = armctl.Simulation(each)
        log = simulation.apply_ctrl([0.0, expected / each.gear[1]], duration=each.dt)
        assert log.tau[0] == pytest.approx([0.0, expected])
        assert simulation.data.qfrc_actuator[1] == pytest.approx(expected)


@pytest.mark.parametrize("form", OFF)
def test_an_actuator_that_the_file_switches_off_adds_nothing_and_is_named(form: str):
    text = written(OFF[form]).replace("<option ", '<option actuatorgroupdisable="2" ')
    arm = armctl.load(mujoco.MjSpec.from_string(text))
    assert arm.limits.tau_max[1] == pytest.approx(50.0)
    assert any("switches 'n' of joint 'b' off: only 'm' counts" in note for note in arm.notes)
    assert any("switches 'n'" in finding.text for finding in armctl.diagnose(mujoco.MjSpec.from_string(text)).findings)


@pytest.mark.parametrize("form", REFUSED)
def test_actuators_that_do_not_add_to_one_motor_are_refused(form: str):
    actuators, reason = REFUSED[form]
    with pytest.raises(armctl.ModelError, match=reason) as caught:
        armctl.load(mujoco.MjSpec.from_string(written(actuators)))
    assert "'m'" in str(caught.value)
    assert "'n'" in str(caught.value)
    assert len(str(caught.value)) <= 400


def test_a_limit_of_the_joint_itself_bounds_the_sum():
    text = written(M + '<position name="n" joint="b" kp="100"/>').replace('name="b"', 'name="b" actuatorfrcrange="-33 33"', 1)
    with pytest.warns(armctl.ArmctlWarning, match="sum of their torques"):
        arm = armctl.load(mujoco.MjSpec.from_string(text))
    assert arm.limits.tau_max[1] == 33.0


def test_an_actuator_that_also_acts_on_the_arm_in_another_way_is_named():
    thruster = M + '<motor name="n" site="end" gear="0 0 1 0 0 0" ctrlrange="-5 5"/>'
    text = written(thruster).replace('<body name="B"', '<site name="end" pos="0.1 0 0"/><body name="B"')
    with pytest.warns(armctl.ArmctlWarning, match="the actuator 'n' also acts on a: it stays as it is"):
        armctl.load(mujoco.MjSpec.from_string(text))
