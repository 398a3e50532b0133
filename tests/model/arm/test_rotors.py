"""Rotors behind gears: bodies of the model, carried by the links before them, couple the joints as textbooks say."""

import mujoco
import numpy as np
import pytest

import armctl

# Siciliano, Sciavicco, Villani, Oriolo, "Robotics" (2009), section 7.3.2: a planar arm of two links with a motor at each joint.
LENGTH, CENTER, LINK_MASS, LINK_INERTIA = 1.0, 0.5, 50.0, 10.0
MOTOR_MASS, ROTOR_INERTIA, GEAR = 5.0, 0.01, 100.0


def model() -> str:
    link = f'<inertial pos="{CENTER} 0 0" mass="{LINK_MASS}" diaginertia="{LINK_INERTIA} {LINK_INERTIA} {LINK_INERTIA}"/>'
    rotor = f'<inertial pos="0 0 0" mass="{MOTOR_MASS}" diaginertia="{ROTOR_INERTIA} {ROTOR_INERTIA} {ROTOR_INERTIA}"/>'
    shape = f'<geom type="capsule" size="0.02" fromto="0.1 0 0 {LENGTH - 0.1} 0 0"/>'
    gear = '<joint joint1="r{0}" joint2="j{0}" polycoef="0 {1} 0 0 0"/>'
    return f"""<mujoco><compiler inertiafromgeom="false" angle="radian"/>
    <option timestep="0.001" gravity="0 -9.81 0"/>
    <worldbody>
      <body name="rotor 1">{rotor}<joint name="r1" axis="0 0 1"/></body>
      <body name="link 1">{link}{shape}<joint name="j1" axis="0 0 1" range="-3 3"/>
        <body name="rotor 2" pos="{LENGTH} 0 0">{rotor}<joint name="r2" axis="0 0 1"/></body>
        <body name="link 2" pos="{LENGTH} 0 0">{link}{shape}<joint name="j2" axis="0 0 1" range="-3 3"/>
          <site name="tip" pos="{LENGTH} 0 0"/>
        </body>
      </body>
    </worldbody>
    <equality>{gear.format(1, GEAR)}{gear.format(2, GEAR)}</equality>
    <actuator><motor joint="j1" ctrlrange="-4000 4000"/><motor joint="j2" ctrlrange="-4000 4000"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def arm() -> armctl.Arm:
    return armctl.load(mujoco.MjSpec.from_string(model()), tip="tip")


@pytest.mark.parametrize("angle", [0.3, 1.2, -2.0])
def test_the_mass_matrix_has_the_terms_of_the_textbook(arm: armctl.Arm, angle: float):
    cosine = np.cos(angle)
    second = LINK_INERTIA + LINK_MASS * CENTER**2
    coupling = LINK_INERTIA + LINK_MASS * (CENTER**2 + LENGTH * CENTER * cosine)
    first = LINK_INERTIA + LINK_MASS * CENTER**2 + GEAR**2 * ROTOR_INERTIA + ROTOR_INERTIA + MOTOR_MASS * LENGTH**2
    first += LINK_INERTIA + LINK_MASS * (LENGTH**2 + CENTER**2 + 2 * LENGTH * CENTER * cosine)
    textbook = [[first, coupling + GEAR * ROTOR_INERTIA], [coupling + GEAR * ROTOR_INERTIA, second + GEAR**2 * ROTOR_INERTIA]]
    np.testing.assert_allclose(arm.mass_matrix([0.7, angle]), textbook, rtol=1e-14)


def test_a_rotor_does_not_slow_its_joint_down_and_the_arm_follows(arm: armctl.Arm):
    assert arm.limits.v_max == pytest.approx([2.0, 2.0])
    motion = armctl.move_j(arm, [0.0, 0.0], [0.5, 1.0])
    report = armctl.Report.from_log(armctl.simulate(arm, "computed-torque", motion))
    assert motion.duration < 3.0
    assert report.joint_rms_rad < 1e-4
