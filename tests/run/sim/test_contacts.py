"""What a run touched, and for how long."""

import mujoco
import numpy as np
import pytest
from synthetic import limb, mjcf, motors

import armctl
from armctl import Log, Simulation
from armctl.model.mjmodel.queries import contact_forces

BLOCK = '<body name="block" pos="{} 0 0.3"><geom type="box" size="0.02 0.2 0.2"/></body>'
REACHER = (
    '<body name="slider" pos="0 0 0.3"><joint name="x" type="slide" axis="1 0 0" range="-1 1" damping="1"/>'
    '<geom type="sphere" size="0.02" mass="1"/>{}<site name="tip"/></body>'
)


@pytest.fixture
def slider(tmp_path):
    """An arm of one slide joint, along x, with a block in its way."""

    def loaded(block_at: float, behind: str = "") -> armctl.Arm:
        path = tmp_path / "slider.xml"
        path.write_text(mjcf(REACHER.format(behind) + BLOCK.format(block_at), motors("x")))
        return armctl.load(path)

    return loaded


def test_a_run_that_touches_nothing_says_so(slider):
    result = Simulation(slider(0.5)).move_j([0.3])
    assert result.ok
    assert result.contacts == ()
    assert "touched" not in str(result)


def test_a_run_that_touches_something_says_what_and_for_how_long(slider):
    arm = slider(0.3)
    sim = Simulation(arm, "pd-gravity")
    result = sim.move_j([0.5], avoid=False)
    assert not result.ok
    (contact,) = result.contacts
    assert (contact.body, contact.other) == ("slider", "block")
    inside = np.flatnonzero(result.log.q[:, 0] > 0.26)
    assert contact.start == pytest.approx(inside[0] * sim.dt, abs=2 * sim.dt)
    assert contact.duration == pytest.approx(len(inside) * sim.dt, abs=3 * sim.dt)
    assert result.reason.endswith(f"slider touched block for {contact.duration:.3g} s")
    assert str(contact) in str(armctl.Report.from_log(result.log))


def test_contacts_are_counted_by_mujocos_own_count(slider):
    arm = slider(0.3)
    sim = Simulation(arm)
    touching = 0
    for k in range(600):
        sim.step([5.0 if k % 200 < 100 else -5.0])
        touching += sim.data.ncon > 0
    (contact,) = sim.log.contacts
    assert touching > 10
    assert contact.duration == pytest.approx(touching * sim.dt)


def test_what_is_behind_the_last_joint_does_not_touch_itself(slider):
    finger = '<body name="{0}" pos="0 0 {1}"><joint name="{0}" type="slide" axis="0 0 1" range="-0.1 0.1"/>'
    finger += '<geom type="sphere" size="0.03" mass="0.1"/></body>'
    arm = slider(9.0, finger.format("one", 0.2) + finger.format("two", 0.25))
    sim = Simulation(arm)
    log = sim.move_j([0.1]).log
    assert sim.data.ncon > 0
    assert log.contacts == ()


def test_a_log_names_the_contacts_of_each_of_two_arms(tmp_path):
    path = tmp_path / "pair.xml"
    other = REACHER.format("").replace('"slider" pos="0 0 0.3"', '"still" pos="0 2 0.3"').replace('"x"', '"y"')
    path.write_text(mjcf(REACHER.format("") + other.replace('"tip"', '"end"') + BLOCK.format(0.3), motors("x y")))
    arm = armctl.load(path, tips=["end", "tip"])
    sim = armctl.Simulation(arm, "pd")
    log = sim.run(armctl.move_j(arm, arm.home, arm.home + np.array([0.0, 0.5])))
    assert [(c.body, c.other) for c in log.contacts] == [("slider", "block")]


def test_contacts_are_saved_and_loaded_with_the_log(slider, tmp_path):
    log = Simulation(slider(0.3), "pd").move_j([0.5], avoid=False).log
    assert log.contacts
    assert Log.load(log.save(tmp_path / "run.npz")).contacts == log.contacts


def test_contact_of_neighbouring_runs_does_not_leak_into_the_next(slider):
    sim = Simulation(slider(0.3), "pd")
    assert sim.move_j([0.5], avoid=False).contacts
    sim.reset()
    assert sim.move_j([0.1]).contacts == ()


def test_a_loose_object_on_a_table_is_no_contact_of_the_arm(load):
    scene = armctl.World().add("table", armctl.Box([0.2, 0.2, 0.1]), [0.9, 0.9, 0.05])
    scene = scene.add("cube", armctl.Box([0.05] * 3), [0.9, 0.9, 0.125], mass=0.1)
    arm = load(limb("a b", '<site name="tip"/>'), motors("a b"), scene=scene)
    sim = Simulation(arm)
    log = sim.move_j(arm.home + 0.1, avoid=False).log
    assert sim.data.ncon > 0
    assert log.contacts == ()


def test_the_forces_of_contacts_hold_what_rests_on_them_on_a_slope_too(load):
    for slope in (0.0, 0.2):
        ground = f'<body euler="0 {slope} 0"><geom type="plane" size="1 1 0.1" friction="1 0.1 0.1"/></body>'
        block = '<body name="block" pos="0 0 0.06"><freejoint/><geom type="box" size="0.05 0.05 0.05" mass="2"/></body>'
        model = mujoco.MjModel.from_xml_string(mjcf(ground + block))
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, 1000)
        forces = contact_forces(model, data)[:, 1]
        assert len(forces) == 4
        assert forces.sum(axis=0) == pytest.approx([0.0, 0.0, 2 * 9.81], abs=0.05)


def test_a_contact_late_in_a_long_loop_of_steps_is_counted_from_its_begin(slider):
    arm = slider(0.3)
    sim = Simulation(arm)
    touched = []
    for k in range(1500):
        sim.step([5.0 if k >= 1200 else 0.0])
        touched += [sim.data.time] if sim.data.ncon else []
    (contact,) = sim.log.contacts
    assert touched[0] > 1200 * sim.dt
    assert contact.start == pytest.approx(touched[0], abs=2 * sim.dt)
