"""Bode plots, step responses, crossovers and disk margins of linear loops, compared with python-control."""

import numpy as np
import pytest

import armctl

control = pytest.importorskip("control", reason="python-control is an extra")
LOOPS = 50


def loop_of(seed: int) -> armctl.LinearLoop:
    """A random discrete loop of one input that is stable when closed, with poles near the unit circle."""
    rng = np.random.default_rng(seed)
    while True:
        dt = 10.0 ** rng.uniform(-3, -1)
        order = int(rng.integers(2, 6))
        rates = -(10.0 ** rng.uniform(-0.5, 0.8, order)) / (100 * dt)
        zeros = -(10.0 ** rng.uniform(-0.5, 0.8, order - 1)) / (50 * dt)
        plant = control.zpk(zeros, rates, 1.0)
        plant = plant * 10.0 ** rng.uniform(-0.5, 1.0) / abs(plant(0.0))
        sampled = control.ss(control.sample_system(plant, dt)) * control.tf([1.0], [1.0] + [0.0] * int(rng.integers(0, 8)), dt)
        loop = armctl.LinearLoop.from_system(sampled)
        if loop.is_stable and loop.slowest_pole > 1e-4 / dt:
            return loop


@pytest.fixture(scope="module")
def loops() -> list[armctl.LinearLoop]:
    return [loop_of(seed) for seed in range(LOOPS)]


@pytest.mark.parametrize("count", [5, pytest.param(LOOPS, marks=pytest.mark.nightly)])
def test_margins_and_all_crossovers_are_python_controls(loops, count):
    found = 0
    for loop in loops[:count]:
        w = np.geomspace(1e-6, 0.999, 4_000) * np.pi / loop.dt
        answer = control.frequency_response(loop.to_control(), w)
        measured = (answer.magnitude, np.degrees(answer.phase), w)
        gains, phases, _, at_phase, at_gain, _ = control.stability_margins(measured, returnall=True)
        mine = loop.gain_crossovers()
        assert [each.frequency for each in mine] == pytest.approx(sorted(at_gain), rel=1e-4)
        order = np.argsort(at_gain)
        expected = np.radians(np.asarray(phases)[order])
        off = (np.array([each.phase_margin for each in mine]) - expected + np.pi) % (2 * np.pi) - np.pi
        assert off == pytest.approx(0.0, abs=1e-3)
        nyquist = np.pi / loop.dt
        inside = [k for k in np.argsort(at_phase) if 0.0 < at_phase[k] < 0.99 * nyquist and 0.01 < gains[k] < 100.0]
        between = [each for each in loop.phase_crossovers() if 0.0 < each.frequency < 0.99 * nyquist]
        assert [each.gain_margin for each in between] == pytest.approx(np.asarray(gains)[inside], rel=1e-3)
        assert [each.frequency for each in between] == pytest.approx(np.asarray(at_phase)[inside], rel=1e-3)
        margins = loop.margins()
        assert margins.phase_margin == pytest.approx(min([abs(each.phase_margin) for each in mine], default=np.inf))
        assert margins.delay_margin == pytest.approx(min([each.delay_margin for each in mine], default=np.inf))
        found += len(mine) + len(between)
    assert found > count


@pytest.mark.parametrize("count", [10, pytest.param(LOOPS, marks=pytest.mark.nightly)])
def test_disk_margins_are_python_controls(loops, count):
    for loop in loops[:count]:
        w = np.geomspace(1e-5, 0.999_999, 3_000) * np.pi / loop.dt
        radius, gain_db, phase_degrees = control.disk_margins(loop.to_control(), w, skew=0.0)
        mine = loop.disk_margins()
        assert mine.together == mine.joints[0]
        assert mine.together.radius == pytest.approx(float(radius), rel=1e-4)
        if mine.together.radius < 1.99:
            low, high = mine.together.gain
            assert 20 * np.log10(high) == pytest.approx(float(gain_db), rel=1e-3)
            assert low == pytest.approx(1 / high)
            assert np.degrees(mine.together.phase) == pytest.approx(float(phase_degrees), rel=1e-3)


def test_bode_nyquist_step_response_and_poles_are_python_controls(loops):
    for loop in loops:
        theirs = loop.to_control()
        w = np.geomspace(1e-3, 0.99, 40) * np.pi / loop.dt
        bode = loop.bode(w)
        response = control.frequency_response(theirs, w)
        assert bode.magnitude[:, 0] == pytest.approx(response.magnitude, rel=1e-8)
        assert np.exp(1j * bode.phase[:, 0]) == pytest.approx(np.exp(1j * response.phase), abs=1e-8)
        assert loop.nyquist(w).curve[:, 0] == pytest.approx(response.complex, rel=1e-8)
        closed = control.feedback(theirs)
        step = loop.step_response(400 * loop.dt)
        assert step.y[:, 0] == pytest.approx(control.step_response(closed, step.t).outputs, abs=1e-7)
        assert np.sort(np.abs(loop.poles()))[::-1] == pytest.approx(np.sort(np.abs(closed.poles()))[::-1], abs=1e-3)
        assert step.final[0] == pytest.approx(float(closed.dcgain()))
        if step.y.max() < 0.91 * step.final[0]:
            continue  # python-control finds no rise in a response that is not long enough
        info = control.step_info(step.y[:, 0], step.t, final_output=float(closed.dcgain()))
        assert 100 * step.overshoot[0] == pytest.approx(info["Overshoot"], abs=1e-6)
        for mine, theirs_ in ((step.rise_time[0], info["RiseTime"]), (step.settling_time[0], info["SettlingTime"])):
            assert np.isnan(theirs_) or mine == pytest.approx(theirs_, abs=1e-9)


@pytest.mark.parametrize("n", [2, 3])
def test_the_disk_margin_of_several_joints_is_that_of_the_worst_phases(n):
    """For up to three factors the bound is exact: then it is the largest spectral radius over all their phases."""
    rng = np.random.default_rng(n)
    w0 = np.array([1.0])
    for _ in range(6):
        gain = 0.4 * rng.normal(size=(n, n))
        loop = armctl.LinearLoop(A=0.9 * np.eye(n), B=0.1 * np.eye(n), C=gain + np.eye(n), D=np.zeros((n, n)), dt=0.01)
        mine = loop.disk_margins().together
        w0 = np.array([mine.frequency])
        balanced = loop.sensitivity(w0)[0] - 0.5 * np.eye(n)
        angles = np.linspace(0.0, 2 * np.pi, 181)
        grid = np.stack(np.meshgrid(*[angles] * (n - 1)), axis=-1).reshape(-1, n - 1)
        turned = np.exp(1j * np.column_stack([np.zeros(len(grid)), grid]))[:, :, None] * balanced
        largest = np.abs(np.linalg.eigvals(turned)).max()
        assert mine.radius == pytest.approx(1 / largest, rel=5e-3)
        assert mine.radius <= 1 / largest * (1 + 1e-6)


def test_factors_inside_the_disk_margin_keep_a_loop_of_an_arm_stable_and_larger_ones_do_not():
    arm = armctl.load("robot_arm_3dof")
    loop = armctl.linearize(arm, "pd", arm.home, armctl.Plant(delay=2))
    found = loop.disk_margins()
    assert found.together.radius <= min(found.joints).radius
    assert "gain 0." in str(found)
    low, high = found.together.gain
    rng = np.random.default_rng(0)

    def radius(factors: np.ndarray) -> float:
        return float(np.abs(np.linalg.eigvals(loop.A - loop.B @ np.diag(factors) @ loop.C)).max())

    for _ in range(200):
        assert radius(rng.uniform(low, high, arm.n)) < 1.0
    worst = loop.margins().upper_gain_margin
    assert radius(np.full(arm.n, worst * 1.01)) > 1.0
    assert high < worst


def test_the_loop_gain_of_a_joint_has_the_other_loops_closed():
    arm = armctl.load("robot_arm_3dof")
    loop = armctl.linearize(arm, "computed-torque-observer", arm.home, armctl.Plant(delay=1))
    theirs = loop.to_control()
    w = np.array([1.0, 30.0, 200.0])
    bode = loop.bode(w)
    for i in range(arm.n):
        others = [k for k in range(arm.n) if k != i]
        closed = np.zeros((arm.n, arm.n))
        closed[others, others] = 1.0
        inner = control.feedback(theirs, control.ss([], [], [], closed, loop.dt))[i, i]
        assert bode.magnitude[:, i] == pytest.approx(np.abs(inner(np.exp(1j * w * loop.dt))), rel=1e-6)
    assert list(bode.to_dict()) == ["w", *(f"{kind}.{name}" for kind in ("magnitude", "phase") for name in arm.joint_names)]


def test_a_load_moves_a_joint_as_far_as_its_compliance_at_rest_says():
    arm = armctl.load("robot_arm_3dof")
    loop = armctl.linearize(arm, "pd", arm.home)
    response = loop.load_response()
    at_rest = np.abs(loop.joint_compliance([1e-3])[0]).diagonal()
    assert response.final == pytest.approx(at_rest, rel=1e-4)
    assert response.y[-1] == pytest.approx(at_rest, rel=0.02)
    free = armctl.linearize(arm, "computed-torque-observer", arm.home).load_response()
    assert np.abs(free.final).max() < 1e-3 * np.abs(free.y).max()


def test_curves_are_drawn_into_files_and_into_axes_of_the_caller(tmp_path):
    from matplotlib.figure import Figure

    arm = armctl.load("robot_arm_3dof")
    loop = armctl.linearize(arm, "pd", arm.home)
    for name, each in {"bode": loop.bode(), "nyquist": loop.nyquist(), "step": loop.step_response()}.items():
        assert each.plot(tmp_path / f"{name}.svg", size=(4.0, 3.0)).stat().st_size > 5000
    axes = Figure().subplots(2, 2)
    loop.bode().plot(ax=axes[0])
    loop.nyquist().plot(ax=axes[1, 0])
    loop.step_response().plot(ax=axes[1, 1])
    assert len(axes[0, 0].lines) == len(axes[0, 1].lines) == arm.n + 1
    assert axes[1, 1].get_xlabel() == "time, s"
    with pytest.raises(armctl.InputError, match="ax: expected 2 axes"):
        loop.bode().plot(ax=axes[0, 0])


def test_a_loop_with_direct_feedthrough_is_closed_as_python_control_does():
    system = control.ss([[0.5]], [[1.0]], [[0.3]], [[0.7]], 0.01)
    loop = armctl.LinearLoop.from_system(system)
    closed = control.feedback(system)
    assert loop.poles() == pytest.approx(closed.poles())
    step = loop.step_response(0.5)
    assert step.y[:, 0] == pytest.approx(control.step_response(closed, step.t).outputs, abs=1e-12)
    assert loop.margins().upper_gain_margin == np.inf


def test_systems_of_scipy_and_transfer_functions_are_taken():
    from scipy import signal

    numerator, denominator = [0.02, 0.01], [1.0, -1.6, 0.65]
    mine = [
        armctl.LinearLoop.from_system(control.tf(numerator, denominator, 0.02)),
        armctl.LinearLoop.from_system(signal.dlti(numerator, denominator, dt=0.02)),
        armctl.LinearLoop.from_system(signal.dlti(numerator, denominator, dt=0.02).to_ss()),
        armctl.LinearLoop.from_system(control.tf(numerator, denominator, True), dt=0.02),
    ]
    for loop in mine:
        assert loop.dt == 0.02
        assert loop.transfer([3.0])[0, 0, 0] == pytest.approx(control.tf(numerator, denominator, 0.02)(np.exp(0.06j)))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: armctl.LinearLoop.from_system(control.tf([1.0], [1.0, 1.0])), "continuous"),
        (lambda: armctl.LinearLoop.from_system(control.tf([1.0], [1.0, 1.0]), dt=0.01), "continuous"),
        (lambda: armctl.LinearLoop.from_system(3.0), "python-control"),
        (lambda: armctl.LinearLoop(A=[[1.0]], B=[[1.0, 2.0]], C=[[1.0]], D=[[0.0]], dt=0.1), "B: expected 1 x 1"),
        (lambda: armctl.LinearLoop(A=[[1.0]], B=[[1.0]], C=[[1.0]], D=[[-1.0]], dt=0.1), "no inverse"),
        (lambda: armctl.LinearLoop(A=[[1.0]], B=[[1.0]], C=[[1.0]], D=[[0.0]], dt=0.0), "dt"),
        (lambda: armctl.LinearLoop(A=[[1.0]], B=[[1.0]], C=[[1.0]], D=[[0.0]], dt=0.1, names=("a", "b")), "names"),
        (lambda: loop_of(0).bode([0.0]), "w: expected frequencies"),
        (lambda: loop_of(0).step_response(-1.0), "duration"),
    ],
)
def test_a_wrong_loop_is_refused(call, message):
    with pytest.raises(armctl.InputError, match=message):
        call()


def test_an_unstable_loop_has_no_disk_margin_and_no_final_value():
    loop = armctl.LinearLoop(A=np.array([[1.2]]), B=np.eye(1), C=0.1 * np.eye(1), D=np.zeros((1, 1)), dt=0.01)
    assert loop.disk_margins().together.radius == 0.0
    assert np.isnan(loop.step_response().final[0])
    assert np.isnan(loop.step_response().overshoot[0])
    assert len(loop.gain_crossovers()) == 0
