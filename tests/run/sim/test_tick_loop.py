"""A controller in Python and its compiled law make the same simulation: every controller on every plant, bit for bit."""

import ctypes
import gc
import itertools
import threading
import time
import weakref
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from motions import Still, Sway
from synthetic import BENT, mjcf, serial_arm

import armctl
from armctl import _core
from armctl.control import CONTROLLERS, controller_by_name
from armctl.control.interface import CompiledController, ControllerWrapper, has_compiled_law, traits
from armctl.run.sim import tick_loop

PLANTS = {
    "nominal": armctl.Plant(),
    "heavier, with friction": armctl.Plant(payload=0.3, mass_scale=1.1, coulomb_friction=0.2, viscous_friction=0.1),
    "delayed": armctl.Plant(delay=3),
    "encoder noise": armctl.Plant(encoder_noise=1e-4, seed=3),
    "all noise, delay": armctl.Plant(encoder_noise=1e-4, velocity_noise=1e-3, delay=1),
    "pushed": armctl.Plant(
        pushes=[armctl.Push(0.05, 0.1, force=[5, 0, 3]), armctl.Push(0.1, 0.1, force=[0, 2, 0], torque=[0.1, 0, 0])]
    ),
    "continuous, slow ticks": armctl.Plant(continuous=True, timestep=0.004, encoder_noise=1e-5),
    "late, coarse sensors": armctl.Plant(sensor_delay=2, encoder_bits=14, encoder_noise=1e-4, seed=5),
    "differenced": armctl.Plant(encoder_bits=16, velocity="differenced", sensor_delay=1, continuous=True),
    "jitter": armctl.Plant(delay=1, jitter=3, seed=2),
    "elastic": armctl.Plant(elasticity=3000.0, rotor_inertia=0.05, sensor_delay=1, continuous=True),
    "elastic, measured at the links": armctl.Plant(
        elasticity=3000.0,
        rotor_inertia=0.05,
        encoder_side="link",
        jitter=1,
        pushes=armctl.Push(0.02, 0.05, force=[5, 0, 3]),
        continuous=True,
    ),
    "with a torque of its own": armctl.Plant(joint_torque=lambda q, v, t: -0.2 * np.sin(3.0 * q) - 0.1 * v + t, jitter=1),
    "continuous, pushed": armctl.Plant(continuous=True, pushes=armctl.Push(0.011, 0.02, force=[5, 0, 3])),
}
WITH_FORCES = {
    "hybrid-force": lambda arm: armctl.HybridForce(arm, {"x": 15.0}, approach_speed=0.2),
    "admittance": lambda arm: armctl.Admittance(arm),
    "hybrid-force, limited rates": lambda arm: armctl.TorqueRateLimit(arm, armctl.HybridForce(arm, {"x": 15.0}), 500.0),
}
PUSH = armctl.Push(0.01, 0.05, force=[5, 0, 3], torque=[0.1, 0, 0])
SENSORS = {
    "flange": armctl.Plant(pushes=PUSH),
    "noise, delay": armctl.Plant(force_noise=0.2, moment_noise=0.01, wrench_delay=2, encoder_noise=1e-5, seed=2),
    "torques": armctl.Plant(wrench_source="torques", coulomb_friction=0.1, encoder_noise=1e-6, force_noise=0.1),
    "torques, continuous": armctl.Plant(wrench_source="torques", payload=0.2, wrench_delay=1, continuous=True),
}


class InPython(ControllerWrapper):
    """A controller without a kernel that does what another controller does."""

    def __init__(self, controller: armctl.Controller):
        self._controller = controller
        self.traits = traits(controller)

    def torque(self, state, setpoint):
        return self._controller.torque(state, setpoint)


@pytest.fixture(scope="module")
def rubbing(tmp_path_factory: pytest.TempPathFactory) -> armctl.Arm:
    return serial_arm(tmp_path_factory.mktemp("arm"), BENT["rubbing"])


@pytest.fixture(scope="module")
def at_wall() -> armctl.Arm:
    """The bundled arm, 1 mm inside a wall."""
    reach = float(armctl.load("robot_arm_3dof").fk(armctl.load("robot_arm_3dof").home).position[0])
    scene = armctl.World().add("wall", armctl.Box([0.1, 1.0, 1.0]), at=[reach + 0.049, 0.0, 0.5])
    return armctl.load("robot_arm_3dof", scene=scene)


def same(first: armctl.Log, second: armctl.Log) -> bool:
    columns = ("t", "q", "v", "tau", "tau_cmd", "q_ref", "qpos", "tip", "wrench")
    assert all(np.array_equal(getattr(first, name), getattr(second, name)) for name in columns)
    assert [str(contact) for contact in first.contacts] == [str(contact) for contact in second.contacts]
    assert first.failure == second.failure
    return True


def test_every_shipped_law_that_has_a_name_runs_in_the_compiled_loop(bundled):
    assert all(has_compiled_law(controller_by_name(name, bundled), bundled.n) for name in CONTROLLERS)


def test_an_impedance_whose_stiffness_is_a_function_of_the_time_runs_in_python(bundled):
    varying = armctl.Impedance(bundled, stiffness=lambda t: 1000.0 + 500.0 * np.sin(20.0 * t))
    plant = armctl.Plant(payload=0.2)
    log = armctl.simulate(bundled, varying, Sway(bundled), plant)
    assert not has_compiled_law(varying, bundled.n)
    assert same(log, armctl.simulate(bundled, InPython(varying), Sway(bundled), plant))
    varying.stiffness = 1000.0
    assert has_compiled_law(varying, bundled.n)
    assert np.abs(armctl.simulate(bundled, varying, Sway(bundled), plant).tau - log.tau).max() > 0.01


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("name", CONTROLLERS)
def test_both_loops_give_the_same_bits(rubbing, name: str, plant: str):
    logs = [
        armctl.simulate(rubbing, controller, Sway(rubbing), PLANTS[plant], dwell=0.02)
        for controller in (controller_by_name(name, rubbing), InPython(controller_by_name(name, rubbing)))
    ]
    assert same(*logs)
    assert len(logs[0]) > (10 if logs[0].failure else 100)  # learning with encoders at elastic motors diverges


@pytest.mark.parametrize("plant", ["nominal", "all noise, delay", "continuous, slow ticks"])
def test_both_loops_give_the_same_bits_at_the_limits_of_speed_and_torque(rubbing, plant: str):
    limits = rubbing.limits
    arm = rubbing.with_limits(replace(limits, tau_max=0.3 * limits.tau_max, v_max=np.full(rubbing.n, 0.3)))
    logs = [
        armctl.simulate(arm, controller, Sway(arm), PLANTS[plant], dwell=0.02)
        for controller in ("qp", InPython(armctl.ComputedTorqueQP(arm)))
    ]
    assert same(*logs)
    assert (np.abs(logs[0].v).max(axis=0) > 0.25).any()
    assert np.abs(logs[0].v_ref).max() > 0.3


@pytest.mark.parametrize("name", ["computed-torque-observer", "computed-torque"])
def test_memory_and_noise_go_on_from_run_to_run_and_through_single_ticks(rubbing, name: str):
    plant = armctl.Plant(encoder_noise=1e-4, delay=2, pushes=armctl.Push(0.01, 0.1, force=[5, 0, 3]))
    states = []
    logs = []
    for controller in (controller_by_name(name, rubbing), InPython(controller_by_name(name, rubbing))):
        sim = armctl.Simulation(rubbing, controller, plant)
        sim.run(Still(rubbing.home + 0.01, 0.05))
        states.append(sim.measured_state.q)
        sim.run(Still(rubbing.home, 0.03))
        for _ in range(3):
            sim.step()
        states.append(sim.measured_state.v)
        logs.append(sim.run(Still(rubbing.home + 0.02, 0.05)))
    assert same(*logs)
    assert np.array_equal(states[0], states[2])
    assert np.array_equal(states[1], states[3])


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("name", WITH_FORCES)
def test_controllers_get_the_same_wrench_in_both_loops(at_wall, name: str, sensor: str):
    make = WITH_FORCES[name]
    logs = []
    for controller in (make(at_wall), InPython(make(at_wall))):
        sim = armctl.Simulation(at_wall, controller, SENSORS[sensor])
        first = sim.run(Still(at_wall.home, 0.1))
        sim.step()
        sim.measured_state  # noqa: B018  # the measurement of the next tick
        logs.append((first, sim.run(Still(at_wall.home, 0.1))))
    assert has_compiled_law(make(at_wall), at_wall.n)
    assert all(same(*pair) for pair in zip(*logs, strict=True))
    assert logs[0][0].wrench.any()
    assert np.isfinite(logs[0][1].wrench).all()


def test_a_wrench_that_torques_tell_is_the_same_in_both_loops(bundled):
    plant = armctl.Plant(wrench_source="torques", wrench_delay=1, pushes=PUSH)
    controllers = (armctl.Admittance(bundled), InPython(armctl.Admittance(bundled)))
    logs = [armctl.simulate(bundled, controller, Sway(bundled), plant) for controller in controllers]
    assert same(*logs)
    assert logs[0].wrench.any()


def test_a_rate_limit_runs_compiled_if_its_controller_does(bundled):
    logs = []
    for limited in (armctl.PDGravity(bundled), InPython(armctl.PDGravity(bundled))):
        controller = armctl.TorqueRateLimit(bundled, limited, 100.0)
        assert has_compiled_law(controller, bundled.n) == isinstance(limited, CompiledController)
        sim = armctl.Simulation(bundled, controller)
        sim.run(Still(bundled.home, 0.1))
        logs.append(sim.run(Still(bundled.home + 0.05, 0.1)))
    assert same(*logs)
    change = np.abs(np.diff(logs[0].tau_cmd, axis=0)).max()
    assert change == pytest.approx(100.0 * bundled.dt)


@pytest.mark.parametrize("plant", ["nominal", "delayed"])
def test_a_planning_controller_behind_a_rate_limit_foresees_the_reference_in_both_loops(rubbing, plant: str):
    logs = []
    for wrap in (lambda controller: controller, InPython):
        limited = armctl.TorqueRateLimit(rubbing, armctl.MPC(rubbing), 500.0)
        logs.append(armctl.simulate(rubbing, wrap(limited), Sway(rubbing), PLANTS[plant], dwell=0.02))
    assert same(*logs)
    assert np.abs(np.diff(logs[0].tau_cmd, axis=0)).max() == pytest.approx(500.0 * rubbing.dt)


SLIDER = """<body name="slider" pos="0 0 0.3"><joint name="x" type="slide" axis="1 0 0" range="-9 9"/>
<geom size="0.02" mass="1"/><site name="tip"/></body>
<body name="block" pos="0.3 0 0.3"><geom type="box" size="0.02 0.2 0.2"/></body>"""


@pytest.fixture
def slider(tmp_path: Path) -> armctl.Arm:
    """A ball on a strong slide joint, with a block in its way."""
    path = tmp_path / "slider.xml"
    path.write_text(mjcf(SLIDER, '<actuator><motor joint="x" ctrlrange="-1e9 1e9"/></actuator>'))
    return armctl.load(path)


def test_contacts_are_those_of_the_python_loop(slider):
    """A spring presses a ball against a block."""
    logs = []
    for wrap in (lambda controller: controller, InPython):
        sim = armctl.Simulation(slider, wrap(armctl.PD(slider, stiffness=50.0, damping=5.0)))
        logs.append(sim.run(Still(np.array([0.6]), 1.0)))
    assert sum(contact.duration for contact in logs[0].contacts) > 0.1
    assert same(*logs)


def test_a_long_run_in_several_calls_is_the_same(rubbing, monkeypatch):
    plant = PLANTS["all noise, delay"]
    whole = armctl.simulate(rubbing, "computed-torque", Sway(rubbing), plant)
    monkeypatch.setattr(tick_loop, "MAX_TICKS", 7)
    assert same(whole, armctl.simulate(rubbing, "computed-torque", Sway(rubbing), plant))


def test_a_run_that_diverges_ends_at_the_same_tick_for_the_same_reason(slider):
    plant = armctl.Plant(encoder_noise=1e-4, delay=1)
    wild = armctl.PD(slider, stiffness=1e7, damping=0.0)
    logs = [armctl.simulate(slider, controller, Still(np.zeros(1)), plant) for controller in (wild, InPython(wild))]
    assert same(*logs)
    assert "diverged" in logs[0].failure


_NUMBERS = ctypes.POINTER(ctypes.c_double)


@ctypes.CFUNCTYPE(None, *[_NUMBERS] * 7, ctypes.c_int64)
def _spring(parameters, q, v, reference, wrench, memory, tau, n):
    for i in range(n):
        tau[i] = parameters[0] * (reference[i] - q[i]) - parameters[1] * v[i]


class OwnLaw(CompiledController):
    """A law of one's own, which is a C function."""

    name = "own"

    def __init__(self, arm: armctl.Arm):
        super().__init__(arm.n)
        self.stiffness = 5.0

    def make_law(self, dt: float, continuous: bool) -> _core.Law:
        return armctl.CFunctionLaw(ctypes.cast(_spring, ctypes.c_void_p).value, n=self.n, parameters=[self.stiffness, 1.0])


class Doubled(OwnLaw):
    """A law that overrides `torque`."""

    def torque(self, state, setpoint):
        return 2.0 * super().torque(state, setpoint)


def test_a_c_function_runs_compiled_and_an_overridden_torque_is_called(bundled):
    logs = {
        kind: armctl.simulate(bundled, wrap(kind(bundled)), Sway(bundled))
        for kind, wrap in itertools.product((OwnLaw, Doubled), (lambda law: law, InPython))
    }
    own = armctl.simulate(bundled, OwnLaw(bundled), Sway(bundled))
    assert same(own, logs[OwnLaw])
    assert same(armctl.simulate(bundled, Doubled(bundled), Sway(bundled)), logs[Doubled])
    assert np.allclose(logs[Doubled].tau_cmd[0], 2.0 * own.tau_cmd[0])


def test_a_torque_that_is_not_finite_ends_the_run_and_the_next_one_continues(bundled):
    plant = armctl.Plant(encoder_noise=1e-4, pushes=armctl.Push(0.0, 1.0, force=[1, 0, 0]))
    logs = []
    for wrap in (lambda controller: controller, InPython):
        controller = OwnLaw(bundled)
        sim = armctl.Simulation(bundled, wrap(controller), plant)
        sim.run(Still(bundled.home, 0.05))
        controller.stiffness = np.nan
        failed = sim.run(Still(bundled.home, 0.05))
        assert "no finite torque" in failed.failure
        controller.stiffness = 5.0
        logs.append(sim.run(Still(bundled.home, 0.05)))
    assert same(*logs)


class Nested:
    """A controller that simulates another arm in its own tick, and may then break the model that it controls."""

    def __init__(self, arm: armctl.Arm, breaks_at: int = -1):
        self.law = armctl.PDGravity(arm)
        self.other = armctl.Simulation(arm, armctl.PD(arm))
        self.seen = InPython(armctl.PD(arm))
        self.breaks_at = breaks_at
        self.ticks = 0
        self.sim: armctl.Simulation | None = None

    def torque(self, state, setpoint):
        self.ticks += 1
        self.other.controller = self.seen if self.ticks % 2 else armctl.PD(self.other.arm)
        self.other.run(Still(self.other.arm.home, 0.004), dwell=0.0)
        if self.ticks == self.breaks_at and self.sim is not None:
            self.other.model.opt.integrator = 99
            with pytest.raises(mujoco.FatalError, match="integrator"):
                self.other.run(Still(self.other.arm.home, 0.004), dwell=0.0)
            self.sim.model.opt.integrator = 99
        return self.law.torque(state, setpoint)


def test_a_controller_may_run_a_simulation_in_its_own_tick(bundled):
    nested = armctl.simulate(bundled, Nested(bundled), Still(bundled.home + 0.01, 0.05))
    assert same(nested, armctl.simulate(bundled, armctl.PDGravity(bundled), Still(bundled.home + 0.01, 0.05)))


def test_errors_of_mujoco_in_and_after_a_nested_simulation_end_the_right_one(bundled):
    controller = Nested(bundled, breaks_at=5)
    sim = controller.sim = armctl.Simulation(bundled, controller)
    with pytest.raises(mujoco.FatalError, match="integrator"):
        sim.run(Still(bundled.home, 0.1))
    assert sim.log is not None
    assert len(sim.log) == 4


def test_a_controller_that_keeps_its_own_exception_and_simulation_is_forgotten(bundled):
    class Failing:
        def torque(self, state, setpoint):
            raise ValueError

    controller = Failing()
    controller.sim = armctl.Simulation(bundled, controller, PLANTS["with a torque of its own"])
    with pytest.raises(armctl.SimulationError) as raised:
        controller.sim.run(Still(bundled.home, 0.1))
    controller.error = raised.value
    kept = weakref.ref(controller)
    del controller, raised
    gc.collect()
    assert kept() is None


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
@pytest.mark.parametrize("plant", ["jitter", "late, coarse sensors"])
def test_a_run_goes_on_with_the_same_noise_after_an_exception_in_a_tick(bundled, plant: str, error: type[BaseException]):
    """The tick that the exception ends is measured already, and not driven: the next run begins with its measurement."""

    class Fails(InPython):
        ticks = 0

        def torque(self, state, setpoint):
            self.ticks += 1
            if self.ticks == 8:
                raise error
            return super().torque(state, setpoint)

    law = armctl.PDGravity(bundled)
    seen = []
    for controller in (Fails(law), InPython(law)):
        sim = armctl.Simulation(bundled, controller, PLANTS[plant])
        if isinstance(controller, Fails):
            with pytest.raises((armctl.SimulationError, KeyboardInterrupt)):
                sim.run(Still(bundled.home + 0.01, 0.1))
            assert sim.log is not None
            assert len(sim.log) == 7
            sim.run(Still(bundled.home + 0.01, 0.1), dwell=0.0)
            seen.append(sim.data.qpos.copy())
        else:
            sim.run(Still(bundled.home + 0.01, 7 * sim.dt - sim.dt), dwell=0.0)
            sim.run(Still(bundled.home + 0.01, 0.1), dwell=0.0)
            seen.append(sim.data.qpos.copy())
    assert np.array_equal(*seen)


def test_an_error_of_mujoco_does_not_end_the_process_and_keeps_the_ticks(bundled):
    sim = armctl.Simulation(bundled)
    sim.run(Still(bundled.home, 0.1))
    sim.model.opt.integrator = 99
    with pytest.raises(mujoco.FatalError, match="integrator"):
        sim.run(Still(bundled.home, 0.1))
    assert sim.log is not None
    assert "FatalError" in sim.log.failure


def test_a_second_thread_on_a_simulation_gets_one_sentence(rubbing):
    """One thread runs many ticks; the other one cannot run, step or reset the same simulation in the meantime."""
    sim = armctl.Simulation(rubbing)
    logs = []
    thread = threading.Thread(target=lambda: logs.append(sim.run(Still(rubbing.home, 30.0))))
    thread.start()
    while sim.data.time == 0.0:
        time.sleep(1e-4)
    for use in (lambda: sim.run(Still(rubbing.home, 0.1)), sim.step, sim.reset):
        with pytest.raises(armctl.InputError, match="another thread runs it; give each thread a simulation of its own"):
            use()
    thread.join()
    assert len(logs) == 1
    assert logs[0].failure == ""
    assert len(logs[0]) > 10_000


def test_the_design_of_gains_is_no_computing_time_of_a_run(bundled, monkeypatch):
    clock = itertools.count(0.0, 1e-3)  # s, a call later each time
    design_time = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock) + design_time[0])

    class DesignedSlowly(armctl.ComputedTorque):
        def make_law(self, dt: float, continuous: bool) -> _core.Law:
            design_time[0] += 100.0
            return super().make_law(dt, continuous)

    log = armctl.simulate(bundled, DesignedSlowly(bundled), armctl.move_j(bundled, bundled.home, bundled.home + 0.05))
    assert design_time[0] > 0.0
    assert log.real_time_factor > 1.0
