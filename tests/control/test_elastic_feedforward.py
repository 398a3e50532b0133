"""The laws for elastic joints: the margins of PD, a small part of its error, and friction that turns with the motion."""

from dataclasses import replace

import numpy as np
import pytest
from arms import arm_of

import armctl

DT = 0.001
RESONANCE_HZ = 8.0


def elastic(arm, resonance=RESONANCE_HZ):
    """A plant with springs at which each joint's link resonates with the rotor locked, and the attributes of a law for it."""
    link = arm.mass_matrix(arm.home).diagonal()
    rotor = 0.5 * link
    stiffness = link * (2 * np.pi * resonance) ** 2
    return armctl.Plant(elasticity=stiffness, rotor_inertia=rotor, timestep=DT), stiffness, rotor


@pytest.fixture(scope="module", params=["planar", "robot_arm_3dof"])
def arm(request):
    return arm_of(request.param)


def errors(arm, law, plant):
    motion = armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + 0.3), speed=0.5)
    log = armctl.simulate(arm, law, motion, plant, dwell=0.5)
    assert not log.failure
    return float(np.sqrt(np.mean((log.q - log.q_ref) ** 2)))


def test_it_follows_with_a_tenth_of_the_error_of_pd_at_the_same_margins(arm):
    plant, stiffness, rotor = elastic(arm)
    pd = armctl.PD(arm)
    law = armctl.ElasticFeedforward(arm, stiffness, rotor, stiffness=pd.stiffness, damping=pd.damping)
    pd = armctl.PD(arm, stiffness=pd.stiffness, damping=pd.damping)
    margins = [armctl.linearize(arm, each, arm.home, plant).margins() for each in (pd, law)]
    assert margins[1].delay_margin == pytest.approx(margins[0].delay_margin, rel=1e-4)
    assert margins[1].peak_sensitivity == pytest.approx(margins[0].peak_sensitivity, rel=1e-4)
    assert errors(arm, law, plant) < 0.1 * errors(arm, pd, plant)


def test_feedback_of_the_springs_follows_with_a_tenth_of_the_error_of_pd_at_the_same_margin(arm):
    plant, stiffness, rotor = elastic(arm)
    law = armctl.ElasticFeedback(arm, stiffness, rotor)
    margin = armctl.linearize(arm, law, arm.home, plant).margins().delay_margin
    share = 0.95
    while armctl.linearize(arm, pd_of(arm, share), arm.home, plant).margins().delay_margin < margin:
        share *= 0.9
    assert errors(arm, law, plant) < 0.1 * errors(arm, pd_of(arm, share), plant)


def pd_of(arm, share):
    """PD with a share of the default gains."""
    gains = armctl.PD(arm)
    return armctl.PD(arm, stiffness=share * gains.stiffness, damping=share * gains.damping)


def test_feedback_of_the_springs_damps_links_and_removes_what_wrong_springs_leave(arm):
    plant, stiffness, rotor = elastic(arm)
    laws = armctl.ElasticFeedforward, armctl.ElasticFeedback
    ratios = [armctl.linearize(arm, law(arm, stiffness, rotor), arm.home, plant).modes()[:, 1].min() for law in laws]
    assert ratios[1] > max(ratios[0], 0.09)
    motion = armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + 0.3))
    logs = [armctl.simulate(arm, law(arm, 1.25 * stiffness, rotor), motion, plant, dwell=4.0) for law in laws]
    ends = [np.abs(log.q - log.q_ref)[-1].max() for log in logs]
    assert ends[1] < max(0.1 * ends[0], 1e-6)


def test_a_deflection_is_as_late_as_other_measurements(arm):
    plant, stiffness, rotor = elastic(arm)
    seen = []

    class Watching(armctl.ElasticFeedback):
        def torque(self, state, setpoint):
            seen.append((state.q - state.deflection[0]).copy())
            return super().torque(state, setpoint)

    motion = armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + 0.3))
    log = armctl.simulate(arm, Watching(arm, stiffness, rotor), motion, replace(plant, sensor_delay=2))
    assert np.array(seen)[2:] == pytest.approx(log.q[:-2], abs=1e-12)


def test_feedback_of_the_springs_without_their_deflection_is_refused(arm):
    rest = np.zeros(arm.n)
    setpoint = armctl.Setpoint(arm.home, rest, rest, rest, rest)
    with pytest.raises(armctl.InputError, match=r"state\.deflection: elastic-feedback needs"):
        armctl.ElasticFeedback(arm, 100.0, 0.1).torque(armctl.State(arm.home, rest, 0.0, DT), setpoint)


def test_at_rest_the_link_is_at_its_reference(arm):
    plant, stiffness, rotor = elastic(arm)
    law = armctl.ElasticFeedforward(arm, stiffness, rotor)
    log = armctl.simulate(arm, law, armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + 0.3)), plant, dwell=3.0)
    assert log.q[-1] == pytest.approx(log.q_ref[-1], abs=1e-3 * 0.3)


def test_stiff_springs_make_it_pd_with_feedforward(arm):
    rest = np.zeros(arm.n)
    law = armctl.ElasticFeedforward(arm, 1e12, stiffness=10.0, damping=1.0, friction=False)
    setpoint = armctl.Setpoint(arm.home + 0.1, rest + 0.2, rest + 0.3, rest + 0.2, rest + 0.3)
    torque = law.torque(armctl.State(arm.home, rest, 0.0, DT), setpoint)
    assert torque == pytest.approx(10.0 * 0.1 + 1.0 * 0.2 + arm.inverse_dynamics(*setpoint[:3]), abs=1e-8)


def test_compensated_friction_turns_with_the_motion(arm):
    plant, stiffness, rotor = elastic(arm)
    rubbing = arm.with_payload(0.0, coulomb_friction=0.3)
    with_friction, without = (
        armctl.ElasticFeedforward(rubbing, stiffness, rotor, friction=each, stiffness=20.0, damping=2.0)
        for each in (True, False)
    )
    assert errors(rubbing, with_friction, plant) < 0.75 * errors(rubbing, without, plant)


def test_rigid_computed_torque_on_soft_joints_is_called_unstable_before_the_run_and_is(arm):
    soft, _, _ = elastic(arm, 3.0)
    at_link = armctl.Plant(elasticity=soft.elasticity, rotor_inertia=soft.rotor_inertia, timestep=DT, encoder_side="link")
    found = armctl.margins(arm, "computed-torque", 1, [at_link])
    assert not found
    assert "the closed loop is unstable" in found.reason
    log = armctl.simulate(
        arm, "computed-torque", armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + 0.1)), at_link, dwell=5.0
    )
    tail = np.abs(log.q - log.q_ref)[-500:].max() if not log.failure else np.inf
    assert tail > 0.05


def test_a_spring_without_stiffness_is_refused(arm):
    with pytest.raises(armctl.InputError, match="every spring needs a stiffness above 0"):
        armctl.ElasticFeedforward(arm, 0.0)
