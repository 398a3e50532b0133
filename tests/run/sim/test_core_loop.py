"""The tick loop of the compiled core keeps what it works on, refuses wrong arguments, and gives commands with a delay.

That a controller in Python gets the same ticks is what test_tick_loop shows.
"""

import gc
import sys
import threading
import time
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
from motions import Sway

import armctl
from armctl import _core
from armctl.core.trajectory import TickReference
from armctl.run.execution.recorder import TickRows
from armctl.run.sim.drivetrain import drivetrain_of
from armctl.run.sim.mujoco_library import mujoco_api
from armctl.run.sim.stepper import Stepper

pytestmark = pytest.mark.core


@pytest.fixture
def stepper(bundled: armctl.Arm) -> Stepper:
    return Stepper(bundled, armctl.Plant())


def tick_loop(stepper: Stepper, api: _core.MujocoApi | None = None, **changes: object) -> _core.TickLoop:
    arm = armctl.load("robot_arm_3dof")
    options: dict[str, object] = drivetrain_of(arm, armctl.Plant()).addresses | {
        "pushed_arm": arm.core_model,
        "substeps": 1,
        "dt": 0.002,
        "diverged_speed": 1e3,
    }
    return _core.TickLoop(api or mujoco_api(), stepper.model, stepper.data, **(options | changes))


def wrench_sensor(stepper: Stepper, **changes: object) -> _core.WrenchSensor:
    options = {
        "arm": armctl.load("robot_arm_3dof").core_model,
        "bodies": np.array([1]),
        "root": 1,
        "tip": 1,
        "offset": np.zeros(3),
        "is_connected": False,
        "dt": stepper.dt,
        "delay": 0,
        "is_sampled": False,
        "estimated": 0,
    }
    return _core.WrenchSensor(mujoco_api(), stepper.model, stepper.data, **(options | changes))


def run(loop: _core.TickLoop, arm: armctl.Arm, ticks: int = 10, **changes: object) -> _core.TickEnd:
    stepper = Stepper(arm, armctl.Plant())
    rows = TickRows(TickReference(*map(np.ascontiguousarray, stepper.reference(Sway(arm), ticks))), stepper.model.nq, arm.n)
    law = changes.pop("law", _core.PD(stiffness=np.full(arm.n, 100.0), damping=np.full(arm.n, 10.0)))
    options = {
        **rows.reference._asdict(),
        "qpos_rows": rows.qpos,
        "v_rows": rows.v,
        "command_rows": rows.tau_cmd,
        "torque_rows": rows.tau,
        "first": 0,
        "last": ticks,
    }
    parts = {name: changes.pop(name, None) for name in ("sensors", "delay", "joint_torque")}
    tips = changes.pop("wrench_sensors", [])
    end = _core.TickEnd(0)
    loop.run(law, end, **parts, wrench_sensors=tips, touching=b"", tips=len(tips), **(options | changes))
    return end


@pytest.mark.parametrize("make", [tick_loop, wrench_sensor])
def test_the_core_keeps_the_simulation_alive_that_it_works_on(stepper: Stepper, make: Callable[..., object]):
    before = sys.getrefcount(stepper.data), sys.getrefcount(stepper.model)
    made = make(stepper)
    assert sys.getrefcount(stepper.data) > before[0]
    assert sys.getrefcount(stepper.model) > before[1]
    del made
    assert (sys.getrefcount(stepper.data), sys.getrefcount(stepper.model)) == before


def test_a_loop_keeps_the_model_alive_that_threads_copy(stepper: Stepper):
    # Each of several threads that begin at the same time may make these functions, and only one of them is kept for later ones.
    names = ["step", "rne_post_constraint", "make_batch", "delete_batch", "apply", "error"]
    places = [
        "contact_count",
        "contact_array",
        "contact_stride",
        "contact_geoms",
        "contact_exclude",
        "repair_first",
        "repair_stride",
    ]
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    before = sys.getrefcount(model)
    loop = tick_loop(stepper, _core.MujocoApi(**dict.fromkeys(names + places, 0), empty_model=model))
    gc.collect()
    assert sys.getrefcount(model) > before
    del loop
    assert sys.getrefcount(model) == before


def test_a_second_thread_on_a_loop_gets_one_sentence(bundled: armctl.Arm, stepper: Stepper):
    loop = tick_loop(stepper)
    ends = []
    thread = threading.Thread(target=lambda: ends.append(run(loop, bundled, 20_000)))
    thread.start()
    while stepper.data.time == 0.0:
        time.sleep(1e-4)
    with pytest.raises(armctl.InputError, match="another thread runs it; give each thread a simulation of its own"):
        run(loop, bundled)
    thread.join()
    assert ends[0].count == 20_000
    assert run(loop, bundled).count == 10


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"law": _core.PD(stiffness=np.ones(1), damping=np.ones(1))}, "law: it is one for 1 joints, and the simulation has 3"),
        ({"last": 11}, "first, last: they are not rows of the reference"),
        ({"q": np.zeros((10, 2))}, r"q: need an array of shape \(10, 3\), got \(10, 2\)"),
        ({"delay": _core.Delay(1, 1)}, "delay: it is one for 1 joints, and the simulation has 3"),
        ({"pushes": np.zeros((10, 6))}, "pushes: they need `push`"),
        ({"jitter": np.zeros(9, np.int64)}, r"jitter: need an array of shape \(10,\)"),
        ({"ages": np.zeros((10, 2), np.int64)}, r"ages: need an array of shape \(10, 3\)"),
        ({"noise": np.zeros((9, 2, 3))}, r"noise: need an array of shape \(10, 2, 3\)"),
        ({"times": np.zeros(10), "wrench_sensors": "one"}, "wrench_sensors: a law that needs the wrench needs a sensor"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_wrong_arguments_of_ticks_are_refused_in_one_sentence(
    bundled: armctl.Arm, stepper: Stepper, changes: dict[str, object], message: str
):
    if "wrench_sensors" in changes:
        changes = changes | {"wrench_sensors": [wrench_sensor(stepper)]}
    with pytest.raises(armctl.InputError, match=message):
        run(tick_loop(stepper), bundled, **changes)
    assert stepper.data.time == 0.0


def test_addresses_that_a_model_does_not_have_are_refused_in_one_sentence(stepper: Stepper):
    with pytest.raises(armctl.InputError, match="motors: the model has no such joint or motor"):
        tick_loop(stepper, ctrl_addresses=np.array([0, 1, 99]))
    with pytest.raises(armctl.InputError, match="motors: the model has no such joint or motor"):
        tick_loop(stepper, qpos_addresses=np.array([0, 1, -1]))
    with pytest.raises(armctl.InputError, match="bodies: 99 is not one of"):
        wrench_sensor(stepper, bodies=np.array([99]))
    with pytest.raises(armctl.InputError, match="estimated: need 0, 3 or 6"):
        wrench_sensor(stepper, estimated=4)


def test_a_delay_gives_the_first_command_until_it_has_enough():
    delay = _core.Delay(1, 3)
    for ticks in (2, 0, 3):
        delay.restart(ticks)
        given = np.zeros(1)
        seen = []
        for k in range(8):
            delay.delayed(np.array([float(k)]), given)
            seen.append(given[0])
        assert seen == [max(k - ticks, 0) for k in range(8)]
    with pytest.raises(armctl.InputError, match="ticks: need at most 3, got 4"):
        delay.restart(4)
