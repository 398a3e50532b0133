"""Films and pictures: decoded again, to see that they show what they should."""

import base64
import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from arms import BUNDLED, arm_of, at_hand
from PIL import Image, ImageSequence

import armctl
from armctl import InputError, NotInstalledError, Simulation
from armctl.cli.main import main
from armctl.model.mjmodel.target_marker import TARGET
from armctl.report.render import Renderer, record, still
from armctl.report.render.camera import axes, box_corners, fitted_camera
from armctl.report.render.renderer import INSTALL, gl_context, thinned


def _can_draw() -> bool:
    try:
        gl_context(16, 16).free()
    except NotInstalledError:
        return False
    return True


draws = pytest.mark.skipif(not _can_draw(), reason=f"no OpenGL without a screen: {INSTALL}")


@pytest.fixture(scope="module")
def sim() -> Simulation:
    sim = Simulation(arm_of(BUNDLED))
    assert sim.move_to(sim.target)
    return sim


def green(image: np.ndarray) -> np.ndarray:
    """Which pixels are of the target."""
    r, g, b = np.moveaxis(np.asarray(image).astype(int), -1, 0)
    return (g > 80) & (g > 1.5 * r) & (g > 1.5 * b)


def decoded(path: Path) -> list[np.ndarray]:
    if path.suffix == ".gif":
        with Image.open(path) as film:
            return [np.array(image.convert("RGB")) for image in ImageSequence.Iterator(film)]
    av = pytest.importorskip("av", reason="no decoder: pip install -e '.[view]'")
    with av.open(path) as film:
        return [image.to_ndarray(format="rgb24") for image in film.decode(video=0)]


def seconds(path: Path) -> float:
    """How long a film plays."""
    if path.suffix == ".gif":
        with Image.open(path) as film:
            return sum(image.info["duration"] for image in ImageSequence.Iterator(film)) / 1e3
    return len(decoded(path)) / 30


@draws
@pytest.mark.parametrize(("ending", "per_second"), [(".mp4", 30), (".gif", 25)])
def test_a_film_shows_the_arm_and_lasts_three_seconds(sim: Simulation, tmp_path: Path, ending: str, per_second: int):
    path = sim.record(tmp_path / "new" / f"reach{ending}", size=(320, 240))
    frames = decoded(path)
    assert sim.log is not None
    assert sim.log.t[-1] < 2.0
    assert seconds(path) == pytest.approx(3.0, abs=1.5 / per_second)
    assert {image.shape for image in frames} == {(240, 320, 3)}
    assert np.abs(frames[-1].astype(int) - frames[0]).max(axis=2).mean() > 1.0
    assert green(frames[0]).sum() > 20


@pytest.mark.nightly
@draws
def test_slow_motion_takes_longer(sim: Simulation, tmp_path: Path):
    assert sim.log is not None
    slow, slower = (seconds(sim.record(tmp_path / f"{s}.gif", size=(64, 48), speed=s)) for s in (0.2, 0.1))
    assert slow == pytest.approx(sim.log.t[-1] / 0.2 + 1.0, abs=0.1)
    assert slower == pytest.approx(sim.log.t[-1] / 0.1 + 1.0, abs=0.1)


@draws
def test_a_notebook_shows_a_film(sim: Simulation, tmp_path: Path):
    film = sim.record(tmp_path / "reach.gif", size=(64, 48))
    data = re.fullmatch(r'<img src="data:image/gif;base64,(.+)" alt="film">', film._repr_html_())
    assert data is not None
    assert base64.b64decode(data[1]) == film.read_bytes()


@draws
def test_the_same_run_gives_the_same_pixels(sim: Simulation, tmp_path: Path):
    assert sim.log is not None
    first, second = (still(sim.log, sim.arm, tmp_path / f"{k}.png", size=(160, 120)).read_bytes() for k in range(2))
    assert first == second


@draws
def test_the_trace_of_the_tip_is_in_the_picture(sim: Simulation):
    data, model = sim.data, sim.model
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    assert sim.log is not None
    with Renderer(model, (320, 240)) as renderer:
        with_trace = renderer.image(data, camera, sim.log.tip)
        without = renderer.image(data, camera)
    changed = (with_trace != without).any(axis=2)
    assert 50 < changed.sum() < 5000


@pytest.mark.nightly
@pytest.mark.skipif(not at_hand("panda"), reason="panda: its model is not installed")
def test_a_film_shows_what_the_gripper_carries(tmp_path: Path):
    start, down = np.array([0.5, 0.1, 0.02]), [np.pi, 0, 0]
    arm = armctl.load("panda", scene=armctl.World().add("cube", armctl.Box([0.04] * 3), start, mass=0.05))
    sim, cube = Simulation(arm), arm.model.joint("cube").qposadr[0]
    assert sim.gripper.open()
    assert sim.move_to(armctl.Pose(start, rpy=down))
    reached = sim.log
    assert sim.gripper.close()
    sim.move_to(armctl.Pose(start + np.array([0.0, 0.0, 0.3]), rpy=down))
    log = sim.log
    assert reached is not None
    assert log is not None
    assert log.qpos.shape == (len(log), arm.model.nq)
    np.testing.assert_array_equal(log.qpos[:, arm.qpos_adr], log.q)
    assert log.qpos[-1, cube + 2] - log.qpos[0, cube + 2] == pytest.approx(0.3, abs=5e-3)
    again = armctl.Log.load(log.save(tmp_path / "log.npz"))
    np.testing.assert_array_equal(again.qpos, log.qpos)
    if not _can_draw():
        return
    film = record([reached, again], arm, tmp_path / "carried.gif", size=(160, 120))
    assert seconds(film) == pytest.approx(max(3.0, (len(reached) + len(log)) * log.dt + 1.0), abs=0.1)
    at_home = replace(log, qpos=np.array([arm.qpos(q) for q in log.q]))
    ends = [np.array(Image.open(still(run, arm, tmp_path / "end.png", size=(320, 240)))) for run in (log, at_home)]
    assert (np.abs(ends[0].astype(int) - ends[1]).max(axis=2) > 30).sum() > 20  # the cube, and the fingers around it


def test_a_log_of_another_scene_is_refused(tmp_path: Path, sim: Simulation):
    assert sim.log is not None
    with pytest.raises(InputError, match="it is of a model with 2 positions"):
        record(replace(sim.log, qpos=sim.log.qpos[:, :2]), sim.arm, tmp_path / "out.gif")
    with pytest.raises(InputError, match="different ticks"):
        record([sim.log, replace(sim.log, dt=1.0)], sim.arm, tmp_path / "out.gif")


@draws
def test_the_command_line_films(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["reach", BUNDLED, "--out", str(tmp_path / "out.gif")]) == 0
    assert "out.gif" in capsys.readouterr().err
    assert len(decoded(tmp_path / "out.gif")) > 5


def test_a_film_needs_a_known_ending_before_anything_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["reach", BUNDLED, "--out", str(tmp_path / "out.avi")]) == 2
    assert "'out.avi' ends in '.avi', expected " in capsys.readouterr().err


def test_nothing_to_film_is_said(tmp_path: Path):
    with pytest.raises(InputError, match="nothing has run yet"):
        Simulation(arm_of(BUNDLED)).record(tmp_path / "out.gif")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"size": (321, 240)}, "expected even numbers"),
        ({"quality": "best"}, "expected one of fast, full"),
        ({"size": (8, 8)}, "width: expected a number in .16, 8192., got 8"),
        ({"quality": ["fast"]}, "quality: expected one of fast, full, got .*"),
        ({"speed": 0.0}, "speed: expected .*got 0"),
        ({"speed": "1"}, "speed: '1' is not a number"),
        ({"size": (320, 1e308)}, "height: expected a number in .16, 8192., got 1e[+]308"),
        ({"size": (320, 0)}, "height: expected a number in"),
        ({"size": ("x", 240)}, "width: 'x' is not a number"),
        ({"size": (100000, 240)}, "width: expected .*got 100000"),
        ({"size": 320}, "size: expected width and height in pixels"),
        ({"size": (320.5, 240)}, "width: expected a whole number .* got 320.5"),
    ],
)
def test_a_wrong_option_is_one_sentence(sim: Simulation, tmp_path: Path, options: dict, sentence: str):
    with pytest.raises(InputError, match=sentence):
        sim.record(tmp_path / "out.gif", **options)


def test_a_log_of_another_arm_is_refused(sim: Simulation, tmp_path: Path):
    assert sim.log is not None
    with pytest.raises(InputError, match="it is of robot_arm_3dof with 3 joints"):
        record(sim.log, arm_of("planar"), tmp_path / "out.gif")


@pytest.mark.parametrize("backend", ["egl", "nonsense"])
def test_no_opengl_is_one_sentence_that_says_what_to_install(monkeypatch: pytest.MonkeyPatch, backend: str):
    monkeypatch.setenv("MUJOCO_GL", backend)
    monkeypatch.setattr("mujoco.egl.GLContext", None, raising=False)
    with pytest.raises(NotInstalledError, match="apt-get install"):
        gl_context(64, 64)


def test_the_camera_has_the_whole_arm_and_the_target_in_its_picture(arm: armctl.Arm):
    model, aspect = arm.model, 4 / 3
    poses = []
    for q in (arm.home, arm.limits.clamp(arm.home + 0.4)):
        data = mujoco.MjData(model)
        data.qpos[:] = arm.qpos(q)
        mujoco.mj_forward(model, data)
        poses.append(data)
    target = poses[0].xpos[model.body(TARGET).id]
    way = np.array([arm.fk(arm.home).position, target])
    camera = fitted_camera(arm, poses, way, aspect)
    forward, right, up = axes(*np.radians([camera.azimuth, camera.elevation]))
    seen = np.concatenate([box_corners(arm, data) for data in poses] + [way]) - (camera.lookat - camera.distance * forward)
    depth, tan = seen @ forward, np.tan(np.radians(model.vis.global_.fovy) / 2)
    assert (depth > 0).all()
    x, y = seen @ right / (depth * tan * aspect), seen @ up / (depth * tan)
    assert np.abs([x, y]).max() < 1.0
    assert max(np.ptp(x), np.ptp(y)) > 1.4  # and it is not a speck in the middle of it


def test_the_camera_turns_until_it_sees_a_path_from_the_side(bundled: armctl.Arm):
    data = mujoco.MjData(bundled.model)
    data.qpos[:] = bundled.qpos(bundled.home)
    mujoco.mj_forward(bundled.model, data)
    azimuth = np.radians(bundled.model.vis.global_.azimuth)
    for turn in np.radians([0.0, 30.0, -60.0]):  # of the path, from the direction in which the model's own camera looks
        along = np.array([np.cos(azimuth + turn), np.sin(azimuth + turn), 0.0])
        path = np.array([0.0, 0.0, 2.0]) + np.linspace(-0.2, 0.2, 50)[:, None] * along  # above everything: nothing hides it
        camera = fitted_camera(bundled, [data], path, 4 / 3)
        forward = axes(*np.radians([camera.azimuth, camera.elevation])).forward
        assert abs(forward @ along) < 0.1


def test_a_thinned_line_keeps_its_ends_and_its_shape():
    angle = np.linspace(0, np.pi, 5000)
    line = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    thin = thinned(line, 100)
    assert len(thin) <= 101
    assert (thin[[0, -1]] == line[[0, -1]]).all()
    assert np.linalg.norm(np.diff(thin, axis=0), axis=1).max() < 0.035
    assert len(thinned(np.zeros((10, 3)), 100)) == 1
