"""Steps without collision detection give the same bits, and are made only where it is proved that nothing can touch."""

import copy
import ctypes

import mujoco
import numpy as np
import pytest
from collidable import SHAPES, arm_among, placed
from motions import Still
from synthetic import mjcf, motors

import armctl
from armctl.collision import free_boxes
from armctl.collision.free_box import free_box_scene
from armctl.control import controller_by_name
from armctl.sim import compiled_loop, contact_skip
from armctl.sim.box_proof import BoxProof

PLANTS = (
    armctl.Plant(),
    armctl.Plant(payload=0.5, encoder_noise=1e-4, delay=2),
    armctl.Plant(coulomb_friction=0.3, pushes=armctl.Push(0.1, 0.2, force=[20, 20, -40])),
    armctl.Plant(timestep=0.004, velocity_noise=0.01),
)


class InPython:
    """A controller without a kernel, whose runs make full steps of MuJoCo."""

    def __init__(self, controller: armctl.Controller):
        self._controller = controller

    def torque(self, state, setpoint):
        return self._controller.torque(state, setpoint)


@pytest.fixture(scope="module")
def surrounded(tmp_path_factory: pytest.TempPathFactory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("arm"))


@pytest.fixture
def skips(monkeypatch: pytest.MonkeyPatch) -> list[contact_skip.ContactSkip]:
    """What skips collision detection in the simulations of a test, from their first tick."""
    made = []

    class Noted(contact_skip.ContactSkip):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            made.append(self)

    monkeypatch.setattr(compiled_loop, "ContactSkip", Noted)
    monkeypatch.setattr(free_boxes, "_MIN_STEPS", 0)
    return made


def both_ways(arm: armctl.Arm, name: str, motion: armctl.Trajectory, plant: armctl.Plant) -> armctl.Log:
    """A run in the compiled loop, which is the same as in the Python loop."""
    compiled = armctl.Simulation(arm, controller_by_name(name, arm), plant)
    python = armctl.Simulation(arm, InPython(controller_by_name(name, arm)), plant)
    for sim in (compiled, python):
        sim.reset(motion(0.0).q)
    log = compiled.run(motion)
    expected = python.run(motion)
    for column in ("qpos", "v", "tau", "tau_cmd"):
        assert np.array_equal(getattr(log, column), getattr(expected, column)), (name, str(plant), column)
    assert log.contacts == expected.contacts
    assert log.failure == expected.failure
    return log


@pytest.mark.parametrize("name", ["pd", "computed-torque"])
def test_runs_that_touch_and_runs_that_do_not_are_the_same_as_with_full_steps(surrounded, skips, name: str):
    rng = np.random.default_rng(11)
    steps_free = 0
    skipped_free = 0
    touching = 0
    for k, q in enumerate(surrounded.limits.random(surrounded.home, 8, rng)):
        motion = armctl.move_j(surrounded, surrounded.home, q)
        log = both_ways(surrounded, name, motion, PLANTS[k % len(PLANTS)])
        if log.contacts:
            touching += 1
        else:
            steps_free += len(log)
            skipped_free += skips[-1].skipped
    assert touching >= 2
    assert steps_free > 1000
    assert skipped_free > 0.8 * steps_free


def test_a_ball_that_bounces_is_the_same_and_skips_in_the_air(tmp_path, skips):
    """The floor is hit at several speeds; geoms with a margin touch before they meet."""
    path = tmp_path / "ball.xml"
    for margin in (0.0, 0.01):
        ball = '<body name="ball" pos="0 0 1"><joint name="z" type="slide" axis="0 0 1" range="-2 2"/>'
        ball += f'<geom type="box" size="0.05 0.1 0.1" mass="1" margin="{margin}" solref="-2000 -2"/><site name="tip"/></body>'
        path.write_text(mjcf(ball + '<geom type="plane" size="1 1 1"/>', motors("z")))
        arm = armctl.load(path)
        motion = armctl.move_j(arm, [0.0], [0.1])
        gentle = armctl.PD(arm, stiffness=2.0, damping=0.0)
        log = armctl.simulate(arm, gentle, motion, dwell=3.0)
        expected = armctl.simulate(arm, InPython(gentle), motion, dwell=3.0)
        assert np.array_equal(log.q, expected.q)
        assert log.contacts == expected.contacts
        assert sum(contact.duration for contact in log.contacts) > 0.02
        touched = round(sum(contact.duration for contact in log.contacts) / log.dt)
        assert 0.5 * (len(log) - touched) < skips[-1].skipped < len(log) - touched


def test_nothing_touches_in_a_box_that_is_proved(surrounded):
    """Corners and other points of boxes, by MuJoCo's collision detection."""
    scene = free_box_scene(surrounded.model)
    assert scene is not None
    proof = BoxProof(scene)
    prove = ctypes.CFUNCTYPE(ctypes.c_ssize_t, ctypes.c_ssize_t)(proof.function)
    rng = np.random.default_rng(3)
    proved = 0
    shrunken = 0
    for q in surrounded.limits.random(surrounded.home, 150, rng):
        proof.positions[:] = q
        asked = rng.uniform(0.0, 0.2, surrounded.n)
        proof.delta[:] = asked
        touches = placed(surrounded, q).ncon > 0
        if not prove(proof.argument):
            continue
        assert not touches
        proved += 1
        shrunken += bool((proof.delta < asked).any())
        for corner in rng.choice([-1.0, 1.0, 0.5], (6, surrounded.n)):
            assert placed(surrounded, q + corner * proof.delta).ncon == 0
    assert proved > 50
    assert shrunken > 15


@pytest.mark.parametrize("name", ["table", "box", "hfield"])
def test_height_fields_and_loose_objects_are_left_to_mujoco(tmp_path, skips, name: str):
    things = {
        "table": SHAPES,
        "box": SHAPES + '<body pos="2 2 0"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>',
        "hfield": SHAPES + '<geom type="hfield" hfield="hills" pos="0 0 -1"/>',
    }[name]
    arm = arm_among(tmp_path, things, '<hfield name="hills" nrow="4" ncol="4" size="1 1 0.1 0.1"/>')
    armctl.simulate(arm, "pd-gravity", armctl.move_j(arm, arm.home, arm.home + 0.02))
    assert (skips[-1].skipped > 0) == (name == "table")


def test_options_that_change_collisions_are_left_to_mujoco(surrounded):
    changes = {
        "sleeping": lambda model: setattr(model.opt, "enableflags", int(mujoco.mjtEnableBit.mjENBL_SLEEP)),
        "iterations": lambda model: setattr(model.opt, "ccd_iterations", 2),
    }
    assert free_box_scene(surrounded.model) is not None
    for change in changes.values():
        model = copy.copy(surrounded.model)
        change(model)
        assert free_box_scene(model) is None


def test_a_body_that_a_user_moves_is_noticed_by_the_next_run(tmp_path, skips):
    arm = arm_among(tmp_path, '<body name="target" pos="2 2 0"><geom size="0.1"/></body>')
    sim = armctl.Simulation(arm, "computed-torque")
    assert not sim.run(Still(arm.home, 0.05)).contacts
    assert skips[-1].skipped > 0
    sim.model.body("target").pos = arm.fk(arm.home).position
    assert {contact.other for contact in sim.run(Still(arm.home, 0.05)).contacts} == {"target"}


def test_the_options_of_the_model_are_as_before_after_a_run_and_after_an_error(surrounded, skips, monkeypatch):
    sim = armctl.Simulation(surrounded)
    flags = sim.model.opt.disableflags
    sim.run(Still(surrounded.home, 0.05))
    assert skips[-1].skipped > 0
    assert sim.model.opt.disableflags == flags
    called = compiled_loop.guarded_call
    monkeypatch.setattr(compiled_loop, "guarded_call", lambda function, table: called(function, table) or "the stack is full")
    with pytest.raises(mujoco.FatalError):
        sim.run(Still(surrounded.home, 0.05))
    assert sim.model.opt.disableflags == flags


def test_short_use_of_an_arm_does_not_load_the_proofs(surrounded):
    boxes = free_boxes.FreeBoxes()
    assert boxes.scene(surrounded.model, free_boxes._MIN_STEPS - 1) is None
    assert boxes.scene(surrounded.model, 1) is not None


def test_runs_in_free_space_find_the_same_contacts_with_fewer_checks(surrounded, monkeypatch):
    checks = []
    collide = mujoco.mj_collision
    monkeypatch.setattr(mujoco, "mj_collision", lambda model, data: checks.append(data) or collide(model, data))
    outcomes = {}
    counts = {}
    for least in (10**9, 0):
        monkeypatch.setattr(free_boxes, "_MIN_STEPS", least)
        checks.clear()
        for k, q in enumerate(surrounded.limits.random(surrounded.home, 6, np.random.default_rng(11))):
            motion = armctl.move_j(surrounded, surrounded.home, q)
            log = armctl.simulate(surrounded, "computed-torque", motion, armctl.Plant(free_space=True))
            outcomes[k, least] = (log.failure, log.contacts)
        counts[least] = len(checks)
    assert counts[0] < 0.7 * counts[10**9]
    assert all(outcomes[k, 0] == outcomes[k, 10**9] for k in range(6))
    assert 0 < sum(bool(outcomes[k, 0][0]) for k in range(6)) < 6
