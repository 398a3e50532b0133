"""Many runs on threads: each is the run that `simulate` makes, with any number of threads."""

import threading

import numpy as np
import pytest
from arms import arm_of
from motions import Still, Sway

import armctl

PLANTS = [
    armctl.Plant(
        payload=0.2 * (k % 3), viscous_friction=0.1 * (k % 2), encoder_noise=1e-4, delay=k % 4, continuous=k == 5, seed=k
    )
    for k in range(9)
]


class Fails:
    """Raises after some ticks."""

    name = "fails"

    def __init__(self, n: int, ticks: int):
        self.n = n
        self.ticks = ticks

    def torque(self, state, setpoint):
        if state.t >= self.ticks * state.dt - 1e-9:
            raise ValueError("no more")
        return np.zeros(self.n)


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("controller", ["computed-torque-observer", "qp"])
def test_each_run_is_that_of_simulate(bundled, controller: str, threads: int):
    logs = armctl.simulate_many(bundled, controller, Sway(bundled), PLANTS, threads=threads)
    for log, plant in zip(logs, PLANTS, strict=True):
        alone = armctl.simulate(bundled, controller, Sway(bundled), plant)
        assert str(plant) == log.plant
        assert all(np.array_equal(getattr(log, name), getattr(alone, name)) for name in ("q", "v", "tau", "tau_cmd", "qpos"))


def test_a_plant_changed_in_place_is_a_new_plant():
    """Also where other joints are braked, constraints are tied to them, and the plant before was continuous."""
    panda = arm_of("panda")
    changed = armctl.simulate_many(panda, "pd-gravity", Still(panda.home, 0.1), PLANTS, dwell=0.0, threads=1)
    for log, plant in zip(changed[4:7], PLANTS[4:7], strict=True):
        simulation = armctl.Simulation(panda, "pd-gravity", plant)
        assert np.array_equal(simulation.run(Still(panda.home, 0.1), dwell=0.0).q, log.q)


@pytest.mark.parametrize(("threads", "is_callers"), [(1, True), (2, False)])
def test_a_single_thread_is_that_of_the_caller(bundled, threads: int, is_callers: bool):
    seen = set()

    def notes_its_thread(q: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
        seen.add(threading.current_thread())
        return np.zeros(bundled.n)

    plants = [armctl.Plant(joint_torque=notes_its_thread)] * 2
    armctl.simulate_many(bundled, "pd", Still(bundled.home, 0.01), plants, dwell=0.0, threads=threads)
    assert (threading.current_thread() in seen) == is_callers


def test_one_controller_serves_all_runs_and_keeps_its_own_memory(bundled):
    controller = armctl.ComputedTorqueObserver(bundled)
    motions = [Sway(bundled), Still(bundled.home, 0.1), Still(bundled.home + 0.01, 0.1)]
    armctl.simulate(bundled, controller, motions[0], armctl.Plant(payload=0.5))
    before = controller.disturbance
    logs = armctl.simulate_many(bundled, controller, motions, armctl.Plant(payload=0.5), threads=2)
    assert np.array_equal(controller.disturbance, before)
    assert [log.motion_duration for log in logs] == [0.4, 0.1, 0.1]


def test_controllers_may_differ_from_run_to_run_and_progress_is_told(bundled, monkeypatch, capsys):
    monkeypatch.setattr(armctl.core.progress, "LINE_INTERVAL_S", 0.0)
    logs = armctl.simulate_many(
        bundled,
        ["pd", armctl.PD(bundled, bandwidth=5.0), Fails(3, 10)],
        Sway(bundled),
    )
    assert capsys.readouterr().err.splitlines() == [f"simulate: {done} of 3 runs" for done in (1, 2, 3)]
    assert [log.controller for log in logs] == ["pd", "pd", "fails"]
    assert np.abs(logs[0].q_ref - logs[0].q).max() < np.abs(logs[1].q_ref - logs[1].q).max()
    assert len(logs[2]) == 10
    assert "no more" in logs[2].failure


def test_a_controller_that_fails_at_once_is_an_error(bundled):
    with pytest.raises(armctl.SimulationError, match="no more"):
        armctl.simulate_many(bundled, Fails(3, 0), Sway(bundled))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((["pd", "pd"], None, [armctl.Plant()] * 3), r"expected lists of one length above 0, got lengths \[2, 3\]$"),
        ((["pd"], None, []), r"expected lists of one length above 0, got lengths \[0, 1\]$"),
        (("pd", None, ["heavy"]), "^plants: expected Plant, got 'heavy'"),
        (("pdd", None, None), "pdd"),
    ],
)
def test_wrong_lists_are_explained(bundled, arguments, sentence: str):
    controller, _, plants = arguments
    with pytest.raises(armctl.ArmctlError, match=sentence):
        armctl.simulate_many(bundled, controller, Sway(bundled), plants)


def test_runs_along_one_motion_share_its_reference(bundled):
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.01)
    first, second = (armctl.simulate(bundled, "pd", motion, dwell=0.0) for _ in range(2))
    assert second.q_ref is first.q_ref
    assert second.tip_ref is first.tip_ref
