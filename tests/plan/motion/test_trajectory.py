"""The trajectory as a value: files of any content, foreign motions, and calls with wrong arguments."""

import dataclasses
import pickle
from dataclasses import replace

import numpy as np
import pytest
from arms import arm_of
from motions import Still

import armctl
from armctl.core.trajectory import check_motion
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory, Slowdown


def move(arm: armctl.Arm, way: float = 0.1) -> JointTrajectory:
    return armctl.move_j(arm, arm.home, arm.home + way)


def test_a_motion_survives_pickle_and_files(bundled, tmp_path):
    motion = replace(move(bundled), slowed=Slowdown(1.5, "elbow", 1.2))
    file = motion.save(tmp_path / "motion")
    assert file.name == "motion.npz"
    for copy in (pickle.loads(pickle.dumps(motion)), JointTrajectory.load(file)):
        assert np.array_equal(copy.coefficients, motion.coefficients)
        assert np.array_equal(copy.knots, motion.knots)
        assert copy.joint_names == motion.joint_names
        assert copy.slowed == motion.slowed
        assert np.array_equal(copy.limits.tau_max, motion.limits.tau_max)
        assert not copy.coefficients.flags.writeable


def test_a_table_holds_the_samples(bundled, tmp_path):
    motion = move(bundled)
    file = motion.to_csv(tmp_path / "motion.csv", dt=0.01)
    rows = np.genfromtxt(file, delimiter=",", names=True)
    assert rows.dtype.names[:2] == ("t", "q_shoulder_yaw")
    assert np.array_equal(rows["v_elbow"], motion.sample(rows["t"]).v[:, 2])
    assert rows["t"][-1] == motion.duration


@pytest.fixture
def saved(bundled, tmp_path) -> dict[str, np.ndarray]:
    """The arrays of a trajectory file."""
    with np.load(move(bundled).save(tmp_path / "good.npz")) as data:
        return dict(data)


def changed(array: np.ndarray, at, value) -> np.ndarray:
    array = array.copy()
    array[at] = value
    return array


LIMITS = [field.name for field in dataclasses.fields(armctl.Limits)]
FAULTS = {
    "decreasing knots": (lambda d: {"knots": d["knots"][::-1].copy()}, "must start at 0 and must not decrease"),
    "knots from 1 s": (lambda d: {"knots": d["knots"] + 1}, "must start at 0"),
    "a NaN": (lambda d: {"coefficients": changed(d["coefficients"], (0, 1, 0), np.nan)}, "must be finite"),
    "an overflow": (lambda d: {"coefficients": changed(d["coefficients"], (0, 5, 0), 1.7e308) * 1e3}, "finite"),
    "a jump": (lambda d: {"coefficients": changed(d["coefficients"], (1, 0, 2), 1.0)}, "the position of elbow jumps at"),
    "one knot less": (lambda d: {"knots": d["knots"][:-1]}, "does not fit"),
    "flat coefficients": (lambda d: {"coefficients": d["coefficients"].ravel()}, "does not fit"),
    "integers": (lambda d: {"knots": np.arange(len(d["knots"]))}, "type int64"),
    "text for numbers": (lambda d: {"knots": d["knots"].astype(str)}, "type <U"),
    "a joint less": (lambda d: {"joint_names": d["joint_names"][:2]}, "do not fit"),
    "numbers for names": (lambda d: {"joint_names": np.arange(3)}, "not a list of texts"),
    "one text for names": (lambda d: {"joint_names": np.array("elbow")}, "not a list of texts"),
    "one text for units": (lambda d: {"units": np.array("rad")}, "not a list of texts"),
    "a slowdown of text": (lambda d: {"slowed": np.array(["a", "b", "c"])}, "slowed"),
    "negative limits": (lambda d: {"v_max": -d["v_max"]}, "v_max"),
    "limits of two joints": (lambda d: {name: d[name][:2] for name in LIMITS}, "fit"),
    "another format": (lambda d: {"format": np.array(99)}, "format"),
    "an object": (lambda d: {"knots": np.array([None])}, "allow_pickle"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_file_whose_content_is_no_motion_is_rejected_in_one_sentence(saved, tmp_path, fault):
    change, reason = FAULTS[fault]
    with np.errstate(over="ignore"):
        np.savez(tmp_path / "bad.npz", **saved | change(saved))
    with pytest.raises(armctl.InputError, match=reason) as caught:
        JointTrajectory.load(tmp_path / "bad.npz")
    assert len(str(caught.value)) <= 400
    assert "\n" not in str(caught.value)


def test_any_bytes_load_as_the_motion_or_are_rejected(bundled, tmp_path):
    good = move(bundled).save(tmp_path / "good.npz").read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(300):
        damaged = bytearray(good)
        for at in rng.integers(0, len(good), rng.integers(1, 20)):
            damaged[at] = rng.integers(256)
        end = len(good) if rng.random() < 0.7 else int(rng.integers(len(good)))
        (tmp_path / "bad.npz").write_bytes(damaged[:end])
        try:
            motion = JointTrajectory.load(tmp_path / "bad.npz")
        except armctl.InputError:
            continue
        assert np.isfinite(motion(0.5 * motion.duration).q).all()


def test_a_file_that_is_no_archive_is_rejected(tmp_path):
    (tmp_path / "text.npz").write_text("no archive")
    np.savez(tmp_path / "other.npz", a=1)
    np.save(tmp_path / "array.npz.npy", np.zeros(3))
    for name in ("text.npz", "other.npz", "array.npz.npy"):
        with pytest.raises(armctl.InputError, match=f"{name}: no trajectory that armctl wrote"):
            JointTrajectory.load(tmp_path / name)
    with pytest.raises(armctl.InputError, match=r"nothing\.npz: cannot be read: No such file"):
        JointTrajectory.load(tmp_path / "nothing.npz")


def test_a_suffix_of_another_format_is_rejected(bundled, tmp_path):
    motion = move(bundled)
    with pytest.raises(armctl.InputError, match=r"'run.csv' does not end in .npz; for another format see to_csv"):
        motion.save(tmp_path / "run.csv")
    with pytest.raises(armctl.InputError, match=r"'run.npz' does not end in .csv; for another format see save"):
        motion.to_csv(tmp_path / "run.npz")
    with pytest.raises(armctl.InputError, match=r"'run.doc' is not the name of a picture"):
        motion.plot(tmp_path / "run.doc")
    assert motion.to_csv(tmp_path / "run").name == "run.csv"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.csv"]


def test_a_plot_names_its_axes_and_draws_every_joint(bundled):
    motion = move(bundled)
    axes = motion.plot().axes
    labels = ["position, rad", "velocity / limit", "acceleration / limit", "jerk / limit"]
    assert [each.get_ylabel() for each in axes] == labels
    assert [each.get_xlabel() for each in axes] == ["", "", "", "time, s"]
    for each, bounds in zip(axes, [np.ones(3), bundled.limits.v_max, bundled.limits.a_max], strict=False):
        kind = axes.index(each)
        for joint, line in enumerate(each.lines):
            t, drawn = line.get_data()
            assert drawn == pytest.approx(motion.sample(t)[kind][:, joint] / bounds[joint])
        assert len(each.lines) == 3


def test_saving_replaces_a_file_whole_or_not_at_all(bundled, tmp_path, monkeypatch):
    file = move(bundled).save(tmp_path / "motion.npz")
    before = file.read_bytes()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(armctl.ArmctlError, match=r"motion.npz: cannot be written: No space left on device"):
        move(bundled, 0.2).save(file)
    assert file.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["motion.npz"]


def test_a_motion_can_be_drawn(bundled, tmp_path):
    figure = move(bundled).plot(tmp_path / "motion.png")
    assert len(figure.axes) == 4
    assert (tmp_path / "motion.png").stat().st_size > 1000


def test_a_file_makes_its_folder(bundled, tmp_path):
    motion = move(bundled)
    assert motion.save(tmp_path / "new" / "one").exists()
    assert motion.to_csv(tmp_path / "newer" / "one.csv").exists()


# Motions of another arm


def renamed(arm: armctl.Arm) -> JointTrajectory:
    """A motion that fits in everything but the names of the joints."""
    return replace(move(arm), joint_names=("a", "b", "c"))


def test_a_motion_of_another_arm_is_rejected(bundled):
    message = "trajectory: it was planned for the joints a, b, c, but the arm has shoulder_yaw, shoulder_pitch, elbow"
    calls = [
        lambda motion: armctl.simulate(bundled, "pd", motion),
        lambda motion: armctl.Simulation(bundled).run(motion),
        lambda motion: armctl.check_torque(bundled, motion),
    ]
    for call in calls:
        with pytest.raises(armctl.InputError, match=message):
            call(renamed(bundled))
        with pytest.raises(armctl.InputError, match="trajectory: it moves 7 joints, but the arm has 3"):
            call(Still(np.zeros(7)))
        with pytest.raises(armctl.InputError, match=r"trajectory: \[0, 0, 0\] is not a trajectory"):
            call([0, 0, 0])


def test_limits_of_another_arm_are_rejected(bundled):
    two = armctl.Limits(*([-1.0] * 2, [1.0] * 2, *[[1.0] * 2] * 4))
    with pytest.raises(armctl.InputError, match="limits: they are for 2 joints, but the motion has 3"):
        move(bundled).check_limits(two)


def test_a_motion_is_of_its_own_joints(bundled):
    check_motion(move(bundled), bundled.joint_names)
    check_motion(Still(bundled.home), bundled.joint_names)


@pytest.mark.parametrize("angle", [1e308, -1.0, 0.0, np.nan, np.inf, "x"])
def test_an_arc_of_no_sensible_angle_is_rejected(bundled, angle):
    with pytest.raises(armctl.InputError, match="angle: "):
        armctl.move_c(bundled, bundled.home, tip(bundled, 0.03, 0.03), tip(bundled, 0.06), angle=angle)


# Speed

PLANS = {
    "move_j": lambda arm, **more: armctl.move_j(arm, arm.home, arm.home + 0.3, **more),
    "free": lambda arm, **more: armctl.move_j(arm, arm.home, arm.home + np.array([0.3, -0.2, 0.1]), straight=False, **more),
    "through": lambda arm, **more: armctl.move_through(arm, arm.home + np.array([[0.0], [0.2], [0.1]]), **more),
    "move_l": lambda arm, **more: armctl.move_l(arm, arm.home, tip(arm, 0.05), **more),
    "move_c": lambda arm, **more: armctl.move_c(arm, arm.home, tip(arm, 0.03, 0.03), tip(arm, 0.06), **more),
    "move_path": lambda arm, **more: armctl.move_path(arm, arm.home, [tip(arm, 0.05), tip(arm, 0.05, 0.05)], **more),
}


def tip(arm: armctl.Arm, *way: float) -> np.ndarray:
    """A point so many metres from the tip at home."""
    return arm.fk(arm.home).position + np.pad(way, (1, 2 - len(way)))


@pytest.fixture(scope="module")
def strong() -> armctl.Arm:
    """The bundled arm without torque limits, which do not scale with the speed."""
    arm = arm_of("robot_arm_3dof")
    return arm.with_limits(replace(arm.limits, tau_max=np.full(3, np.inf)))


@pytest.mark.parametrize("plan", PLANS)
def test_a_fraction_of_the_speed_is_the_same_motion_slowed_down(strong, plan):
    full, half = PLANS[plan](strong), PLANS[plan](strong, speed=0.5)
    assert half.duration == pytest.approx(2 * full.duration, rel=5e-3)
    times = np.linspace(0.0, 1.0, 50)
    assert np.abs(half.sample(times * half.duration).q - full.sample(times * full.duration).q).max() < 2e-3
    assert half.check_limits(strong.limits.at_speed(0.5)).ok


@pytest.mark.parametrize("plan", PLANS)
@pytest.mark.parametrize("speed", [0.0, -1.0, 1.1, np.nan, "fast", None, [0.5]])
def test_a_speed_that_is_no_fraction_is_rejected(strong, plan, speed):
    with pytest.raises(armctl.InputError, match="speed"):
        PLANS[plan](strong, speed=speed)


def test_the_speed_scales_the_caps_of_the_tip(strong):
    slow = armctl.move_l(strong, strong.home, tip(strong, 0.1), tip_speed=0.05, speed=0.5)
    q, v = slow.sample(np.linspace(0.0, slow.duration, 400))[:2]
    speeds = [np.linalg.norm(strong.jacobian(a)[:3] @ b) for a, b in zip(q, v, strict=True)]
    assert 0.99 * 0.025 < max(speeds) < 0.025 * (1 + 1e-5)


# Results


def test_a_check_is_true_or_gives_its_reason(bundled):
    motion = move(bundled)
    tight = replace(bundled.limits, v_max=0.1 * bundled.limits.v_max)
    good, bad = motion.check_limits(), motion.check_limits(tight)
    assert good
    assert good.reason == ""
    assert not bad
    assert "velocity" in bad.reason
    assert len(bad.reason) <= 400


def test_a_position_outside_by_more_than_a_nanoradian_is_a_violation(bundled):
    motion = move(bundled)
    end = motion(motion.duration).q
    for excess, inside in ((0.9e-9, True), (1.1e-9, False)):
        limits = replace(bundled.limits, q_max=end - excess)
        assert motion.check_limits(limits).ok is inside


def test_a_joint_with_one_limit_or_none_to_move_in_is_checked(bundled):
    motion = move(bundled)
    one_sided = replace(bundled.limits, q_min=np.full(3, -np.inf), q_max=bundled.home + 0.05)
    locked = replace(bundled.limits, q_min=bundled.home, q_max=bundled.home)
    for limits in (one_sided, locked):
        check = motion.check_limits(limits)
        assert not check.ok
        assert {peak.quantity for peak in check.violations} == {"position"}


# Wrong calls


@pytest.mark.parametrize(
    "call",
    [
        lambda motion, path: motion(None),
        lambda motion, path: motion("now"),
        lambda motion, path: motion([0.0, 1.0]),
        lambda motion, path: motion.sample(None),
        lambda motion, path: motion.jerk("x"),
        lambda motion, path: motion.check_limits(3),
        lambda motion, path: motion.stopped_at(None),
        lambda motion, path: motion.scaled("x"),
        lambda motion, path: motion.save(5),
        lambda motion, path: motion.save(""),
        lambda motion, path: motion.save("a\0b"),
        lambda motion, path: motion.to_csv(None),
        lambda motion, path: motion.to_csv(path / "x.csv", dt=0.0),
        lambda motion, path: motion.to_csv(path / "x.csv", dt=1e-9),
        lambda motion, path: motion.plot(5),
        lambda motion, path: JointTrajectory.load(1.0),
        lambda motion, path: JointTrajectory.load(None),
        lambda motion, path: JointTrajectory(None, None, motion.joint_names, motion.limits),
        lambda motion, path: JointTrajectory(motion.knots, motion.coefficients, ("a",), motion.limits),
        lambda motion, path: JointTrajectory(*motion.pieces, motion.joint_names, None),
        lambda motion, path: motion.limits.clamp(None),
        lambda motion, path: motion.limits.clamp([np.nan] * 3),
        lambda motion, path: motion.limits.contains("x"),
        lambda motion, path: motion.limits.random(np.zeros(3), 1, 0),
        lambda motion, path: motion.limits.random(np.zeros(3), -1, np.random.default_rng(0)),
    ],
)
def test_a_wrong_call_is_an_input_error(bundled, tmp_path, call):
    with pytest.raises(armctl.InputError) as caught:
        call(move(bundled), tmp_path)
    assert len(str(caught.value)) <= 400


@pytest.mark.parametrize(
    ("low", "high"), [(3.5, 6.0), (-6.0, -3.5), (-np.inf, -6.0), (6.0, np.inf), (-np.inf, np.inf), (1.0, 1.0)]
)
def test_random_positions_are_inside_any_range(low, high):
    limits = armctl.Limits([low], [high], *[[1.0]] * 4)
    q = limits.random(np.zeros(1), 100, np.random.default_rng(0))
    assert limits.contains(q)
    assert np.isfinite(q).all()


class Named:
    """A trajectory of a user's own with all members but some."""

    duration = 1.0

    def __call__(self, t):
        return armctl.Setpoint(np.zeros(3), np.zeros(3), np.zeros(3))

    def sample(self, times):
        return armctl.Setpoint(*(np.zeros((len(times), 3)) for _ in range(3)))


@pytest.mark.parametrize("lacking", [["duration"], ["__call__"], ["sample"], ["duration", "__call__"], ["__call__", "sample"]])
def test_a_trajectory_class_is_told_what_it_lacks(bundled, lacking: list[str]):
    members = {name: vars(Named)[name] for name in ("duration", "__call__", "sample") if name not in lacking}
    own = type("Own", (), members)()
    sentence = rf"is not a trajectory; .* It lacks {', '.join(lacking)}: one of your own has"
    for call in (lambda: armctl.simulate(bundled, "pd", own), lambda: armctl.Simulation(bundled).run(own)):
        with pytest.raises(armctl.InputError, match=sentence):
            call()
    with pytest.raises(armctl.InputError, match="is a class, not a trajectory"):
        armctl.simulate(bundled, "pd", Named)
    assert len(armctl.simulate(bundled, "pd", Named(), dwell=0.0))
