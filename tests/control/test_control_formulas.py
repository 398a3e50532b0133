"""Torques of control laws at random states beside formulas with the arm's own inertia and gravity."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from motions import Still
from synthetic import BENT, SHAPES, Shape, serial_arm

import armctl
from armctl.control.gains import extra_inertia, sample_configurations
from armctl.control.observer_gains import max_held_payload, min_effective_mass
from armctl.control.task_space import arm_length
from armctl.core.trajectory import Setpoint

DT = 0.001


@pytest.mark.parametrize("shape", [SHAPES["light"], SHAPES["tapering"], BENT["six joints"]], ids=["light", "tapering", "six"])
def test_the_feedback_of_computed_torque_is_an_acceleration_times_the_inertia_and_what_is_added_to_it(tmp_path, shape):
    arm = serial_arm(tmp_path, replace(shape, joint=""))
    law = armctl.ComputedTorque(arm, bandwidth=15.0, damping_ratio=0.8)
    rng = np.random.default_rng(0)
    added = extra_inertia(arm, 15.0, 0.8, DT)
    for _ in range(20):
        q = rng.uniform(-1, 1, arm.n)
        v = rng.uniform(-1, 1, arm.n)
        error = rng.uniform(-0.1, 0.1, arm.n)
        error_rate = rng.uniform(-0.1, 0.1, arm.n)
        state = armctl.State(q, v, 0.0, DT)
        without = law.torque(state, Setpoint(q, v, np.zeros(arm.n)))
        with_feedback = law.torque(state, Setpoint(q + error, v + error_rate, np.zeros(arm.n)))
        correction = 15.0**2 * error + 2 * 0.8 * 15.0 * error_rate
        expected = arm.mass_matrix(q) @ correction + 2 * 0.8 * 15.0 * added * (error_rate + 15.0 * error)
        assert with_feedback - without == pytest.approx(expected, rel=1e-6, abs=1e-9 * np.abs(expected).max())
    if shape is not BENT["six joints"]:
        assert (added > 0.0).any()


@pytest.mark.parametrize("share", [0.1, 0.7, 1.5])
def test_a_joint_of_negligible_inertia_gets_what_its_motor_accelerates_at_1000_rad_per_s2(tmp_path, share):
    arm = serial_arm(tmp_path, Shape(0.3, 2.0, 100.0, joints=1, home="0.3"))
    inertia = arm.mass_matrix(arm.home)[0]
    strong = arm.with_limits(replace(arm.limits, tau_max=1000.0 * inertia / share))
    assert extra_inertia(strong, 15.0, 0.8, DT) == pytest.approx(np.maximum(inertia / share - inertia, 0.0), rel=1e-9)


def test_a_clipped_torque_of_a_damped_joint_is_foreseen_so_that_the_others_stand_still(tmp_path):
    """Only the Coriolis torques of the first joint's speed act on the others, and the law knows them by its estimate."""
    arm = serial_arm(tmp_path, Shape(0.3, 2.0, 100.0, joints=3, joint='armature="0.1" damping="20"', home="0.2 0.5 0.9"))
    simulation = armctl.Simulation(arm, "computed-torque", armctl.Plant(timestep=DT))  # at home
    log = simulation.run(Still(arm.home + np.array([0.5, 0.0, 0.0]), 0.1))
    assert np.abs(log.tau_cmd[:, 0]).max() > 1.4 * arm.limits.tau_max[0]
    assert np.abs((arm.coriolis(log.q[50], log.v[50]) @ log.v[50])[1:]).min() > 0.01
    assert np.abs(log.v[:, 1:]).max() < 1e-10


class Fall:
    """The second joint moves from one position to another in half a second, and rests there."""

    duration = 0.8

    def __init__(self, start, end):
        self.start = start
        self.way = end - start

    def __call__(self, t):
        return Setpoint(*(column[0] for column in self.sample([t])[:3]))

    def sample(self, times):
        w = np.pi / 0.5
        phase = w * np.clip(times, 0.0, 0.5)[:, None]
        moves = (np.asarray(times) < 0.5)[:, None]
        return Setpoint(
            self.start + 0.5 * self.way * (1 - np.cos(phase)),
            0.5 * w * self.way * np.sin(phase) * moves,
            0.5 * w**2 * self.way * np.cos(phase) * moves,
        )


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_qp_stops_a_falling_link_before_its_limit_with_a_motor_that_hardly_holds_it(tmp_path, side):
    """A motor that gives 1.6 times the largest torque of gravity has little left to brake with, and much to rise with."""
    arm = serial_arm(tmp_path, Shape(0.3, 2.0, 1e3, joints=2, home=f"0 {0.3 * side}", range="-3 3"))
    weight = np.abs(arm.gravity(np.array([0.0, 0.5 * np.pi])))[1]
    end = np.array([0.0, 1.5 * side])
    low = np.array([-3.0, -1.5])
    many = np.full(2, 1e3)
    weak = arm.with_limits(replace(arm.limits, q_min=low, q_max=-low, v_max=many, a_max=many, tau_max=np.full(2, 1.6 * weight)))
    motion = Fall(arm.home, 2.0 * end - arm.home)
    log = armctl.simulate(weak, armctl.ComputedTorqueQP(weak), motion, armctl.Plant(timestep=DT))
    assert np.abs(log.q[:, 1]).max() > 1.4
    assert np.abs(log.q[:, 1]).max() < 1.5 + 1e-3


def test_the_posture_spring_pulls_the_elbow_and_not_the_tip(redundant):
    """Without a spring at the tip, its torques accelerate no tip; an elbow that moves feels all of the stiffness."""
    posture = np.linspace(5.0, 35.0, redundant.n)
    law = armctl.Impedance(redundant, posture_stiffness=posture)
    for away in np.random.default_rng(0).uniform(-0.2, 0.2, (5, redundant.n)):
        q = redundant.home + away
        J = redundant.jacobian(q)
        spring = law.joint_stiffness(q, 0.0)
        assert spring == pytest.approx(spring.T, abs=1e-9)
        mobility = J @ np.linalg.inv(redundant.mass_matrix(q))
        assert np.abs(mobility @ spring).max() < 1e-4 * np.abs(mobility @ np.diag(posture)).max()
        elbow = np.linalg.svd(J)[2][-1]  # moves no tip
        assert elbow @ spring @ elbow == pytest.approx(elbow @ (posture * elbow))
        stiff = law.joint_stiffness(q, [100, 200, 300, 4, 5, 6])
        assert stiff - spring == pytest.approx(J.T @ np.diag([100, 200, 300, 4, 5, 6]) @ J, abs=1e-9)


@pytest.mark.parametrize("name", ["planar", "six joints"])
def test_the_payload_that_the_motors_hold_is_the_largest_one(tmp_path, name):
    arm = serial_arm(tmp_path, replace(BENT[name], torque=40.0))
    held = max_held_payload(arm)

    def share(mass):
        heavy = arm.with_payload(mass)
        return max(np.max(np.abs(heavy.gravity(q)) / arm.limits.tau_max) for q in sample_configurations(arm))

    assert held > 0.1
    assert share(0.999 * held) < 1.0 < share(1.001 * held)


@pytest.mark.parametrize("name", ["planar", "six joints"])
def test_the_least_mass_beside_the_tip_is_that_of_mujocos_jacobians_of_points_around_it(tmp_path, name):
    arm = serial_arm(tmp_path, BENT[name])
    model, data = arm.model, mujoco.MjData(arm.model)
    lever = 0.2
    accelerations = np.zeros((2, 3))  # m/s^2 of 1 N: the largest at points on either side of the tip
    for q in sample_configurations(arm):
        data.qpos[:] = arm.qpos(q)
        mujoco.mj_forward(model, data)
        mobility = np.linalg.inv(arm.mass_matrix(q))
        for side, sign in enumerate((1.0, -1.0)):
            for axis in range(3):
                point = data.site("tip").xpos + sign * lever * np.eye(3)[axis]
                J = np.zeros((3, model.nv))
                mujoco.mj_jac(model, data, J, None, point, arm.tip_body)
                largest = np.linalg.eigvalsh(J @ mobility @ J.T)[-1]
                accelerations[side, axis] = max(accelerations[side, axis], largest)
    assert min_effective_mass(arm, lever) == pytest.approx(1.0 / accelerations.max())
    assert accelerations[1].max() != pytest.approx(accelerations[0].max())


@pytest.mark.parametrize("shape", [*SHAPES.values(), *BENT.values()], ids=[*SHAPES, *BENT])
def test_the_length_of_an_arm_is_that_of_its_segments_in_mujoco(tmp_path, shape):
    arm = serial_arm(tmp_path, shape)
    data = mujoco.MjData(arm.model)
    mujoco.mj_kinematics(arm.model, data)
    joints = [int(np.flatnonzero(arm.model.jnt_dofadr == dof)[0]) for dof in arm.dof_adr]
    points = [*data.xanchor[joints], data.site("tip").xpos]
    assert arm_length(arm) == pytest.approx(np.linalg.norm(np.diff(points, axis=0), axis=1).sum(), abs=1e-12)
