"""A run compares where its motion begins with where the arm is, and says if the motion ends moving."""

import warnings

import numpy as np
import pytest
from motions import Still

import armctl


@pytest.fixture
def sim(bundled) -> armctl.Simulation:
    return armctl.Simulation(bundled)


@pytest.mark.parametrize("law", ["computed-torque", "pd-gravity", "pd", "lqr"])
@pytest.mark.parametrize("step", [[2.0, 0.0, 0.0], [0.0, -0.4, 0.0], [0.0, 0.0, 2e-3], [0.3, 0.3, 0.3]])
def test_a_planned_motion_that_begins_elsewhere_is_refused_and_nothing_moves(bundled, law, step):
    sim = armctl.Simulation(bundled, law)
    motion = armctl.move_j(bundled, bundled.home + np.array(step), bundled.home)
    with pytest.raises(armctl.InputError, match=r"trajectory: it begins with .* from where the arm is, .*sim\.reset") as caught:
        sim.run(motion)
    assert len(str(caught.value)) <= 400
    assert sim.data.time == 0.0
    sim.reset(q=bundled.home + np.array(step))
    log = sim.run(motion)
    assert (np.abs(log.v) <= 1.2 * bundled.limits.v_max).all()


def test_a_motion_may_begin_where_the_arm_is_or_where_its_reference_ended(bundled):
    sim = armctl.Simulation(bundled, armctl.PD(bundled), armctl.Plant(payload=0.5))
    assert not sim.run(armctl.move_j(bundled, bundled.home, bundled.home + 0.3), dwell=0.5).failure
    reference = bundled.home + 0.3
    here = sim.state.q
    assert np.abs(here - reference).max() > 2e-3  # the payload holds it off
    for start in (reference, here, 0.5 * (reference + here)):
        sim = armctl.Simulation(bundled, armctl.PD(bundled), armctl.Plant(payload=0.5))
        sim.run(armctl.move_j(bundled, bundled.home, reference), dwell=0.5)
        assert not sim.run(armctl.move_j(bundled, start, bundled.home)).failure


def test_a_reference_of_the_callers_own_may_be_a_step_and_gives_a_warning(sim):
    with pytest.warns(armctl.ArmctlWarning, match="trajectory: it begins with"):
        log = sim.run(Still(sim.arm.home + 0.05, 0.5))
    assert np.abs(log.q[-1] - sim.arm.home - 0.05).max() < 1e-2


def test_a_motion_that_begins_moving_is_refused_from_rest_and_goes_on_from_another_one(sim):
    arm = sim.arm
    whole = armctl.move_j(arm, arm.home, arm.home + 0.8)
    half = 0.5 * whole.duration
    moving = whole(half)
    rest = armctl.move_j(arm, armctl.Setpoint(moving.q, moving.v, moving.a), arm.home + 0.8)
    sim.reset(q=moving.q)
    with pytest.raises(armctl.InputError, match=r"moving at .* but the arm moves at 0 rad/s"):
        sim.run(rest)
    sim.reset(q=moving.q, v=moving.v)
    log = sim.run(rest)
    assert np.abs(log.q[-1] - arm.home - 0.8).max() < 1e-3


def test_a_motion_that_ends_moving_is_told_and_one_that_is_continued_is_not(sim):
    arm = sim.arm
    whole = armctl.move_j(arm, arm.home, arm.home + 0.8)
    cut = whole.until(0.5 * whole.duration)
    speed = np.abs(whole(0.5 * whole.duration).v).max()
    sentence = r"trajectory: it ends with .* moving at .* stops dead"
    for run in (lambda: sim.run(cut), lambda: armctl.simulate(arm, "pd", cut)):
        with pytest.warns(armctl.ArmctlWarning, match=sentence):
            run()
    check = cut.check_limits()
    assert check.ok
    assert f"{speed:.3g} rad/s" in check.ends_moving
    assert "does not end at rest" in str(check)
    assert not whole.check_limits().ends_moving
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sim.reset()
        sim.run(cut.then(armctl.move_j(arm, cut(cut.duration), arm.home)))
        sim.reset()
        sim.run(whole.stopped_at(0.4 * whole.duration))


IN_DEGREES = [90.0, 0.0, -45.0]


@pytest.mark.parametrize(
    "call",
    [
        lambda arm: arm.checked("q", IN_DEGREES),
        lambda arm: armctl.move_j(arm, arm.home, IN_DEGREES),
        lambda arm: armctl.Simulation(arm).move_j(IN_DEGREES),
        lambda arm: armctl.Simulation(arm).reset(q=IN_DEGREES),
        lambda arm: armctl.Simulation(arm).run(Still(np.array(IN_DEGREES), 0.1)),
        lambda arm: armctl.Stream(arm, arm.home).push(0.0, IN_DEGREES),
        lambda arm: armctl.Stream(arm, arm.home).push_chunk([0.1, 0.2], [arm.home, IN_DEGREES]),
        lambda arm: armctl.DifferentialIk(arm).step(IN_DEGREES, [0.3, 0.1, 0.3], 0.01),
        lambda arm: armctl.solve_ik(arm, [0.3, 0.1, 0.3], IN_DEGREES),
        lambda arm: armctl.simulate(arm, "pd", Still(np.array(IN_DEGREES), 0.1)),
    ],
)
def test_degrees_are_refused_with_a_question_wherever_joint_positions_come_in(bundled, call):
    with pytest.raises(armctl.LimitError, match=r"90 rad is outside \[.*\] rad; degrees\?") as caught:
        call(bundled)
    assert len(str(caught.value)) <= 400


def test_a_refused_push_changes_nothing_of_a_stream(bundled):
    stream = armctl.Stream(bundled, bundled.home)
    stream.push(0.0, bundled.home + 0.1)
    before = stream.pieces
    with pytest.raises(armctl.LimitError):
        stream.push(0.01, np.degrees(bundled.home + 1.0))
    assert np.array_equal(stream.pieces.coefficients, before.coefficients)
    assert stream.report.clamped == 0


def test_positions_a_little_outside_are_moved_inside_as_before(bundled):
    stream = armctl.Stream(bundled, bundled.home)
    stream.push(0.0, bundled.limits.q_max + 0.5)
    assert stream.report.clamped == 1
