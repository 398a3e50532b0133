"""Cameras: points lie on what is seen, wherever the camera is."""

import numpy as np
import pytest

import armctl
from armctl.report.render.renderer import INSTALL, gl_context

SIZE = (96, 64)


def _can_draw() -> bool:
    try:
        gl_context(16, 16).free()
    except armctl.NotInstalledError:
        return False
    return True


draws = pytest.mark.skipif(not _can_draw(), reason=f"no OpenGL without a screen: {INSTALL}")


@pytest.fixture(scope="module")
def sim() -> armctl.Simulation:
    scene = (
        armctl.World().add("box", armctl.Box([0.2, 0.1, 0.3]), [0.5, 0.3, 0.15]).add("ball", armctl.Ball(0.1), [-0.4, 0.2, 0.4])
    )
    return armctl.Simulation(armctl.load("robot_arm_3dof", scene=scene))


def looking(eye: np.ndarray, at: np.ndarray) -> armctl.Pose:
    forward = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return armctl.Pose.from_rotation(eye, np.column_stack([right, np.cross(forward, right), forward]))


@draws
@pytest.mark.parametrize("eye", [[1.2, 0.9, 0.8], [-0.6, 1.4, 0.5], [0.5, -0.9, 1.4]])
@pytest.mark.parametrize("fovy", [0.5, 1.2])
def test_the_points_of_a_ball_lie_on_it_and_those_of_the_floor_on_the_floor(sim, eye, fovy):
    center = np.array([-0.4, 0.2, 0.4])
    seen = sim.camera(armctl.Camera(looking(np.array(eye), center), fovy=fovy), SIZE)
    assert seen.colour.shape == (64, 96, 3)
    assert len(seen.points) == seen.is_seen.sum()
    distances = np.linalg.norm(seen.points - center, axis=1)
    on_ball = distances < 0.12
    assert on_ball.sum() > 20
    assert distances[on_ball] == pytest.approx(0.1, abs=4e-3)
    floor = sim.data.geom("floor").xpos[2]
    assert seen.points[:, 2].min() > floor - 4e-3
    assert (np.abs(seen.points[:, 2] - floor) < 4e-3).sum() > 50


@draws
def test_a_camera_at_the_wrist_moves_with_the_arm(sim):
    body = sim.arm.model.body(sim.arm.tip_body).name
    camera = armctl.Camera(armctl.Pose([0.0, 0.0, 0.2]), on=body)
    before = sim.camera(camera, SIZE).T_world_camera.position
    sim.move_to([0.2, 0.3, 0.3])
    after = sim.camera(camera, SIZE).T_world_camera.position
    assert np.linalg.norm(after - before) > 0.05


def test_intrinsics_and_the_angle_of_view_give_the_same_points():
    depth = np.random.default_rng(0).uniform(0.5, 2.0, (48, 64))
    focal = 24.0 / np.tan(0.5)
    matrix = [[focal, 0.0, 31.5], [0.0, focal, 23.5], [0.0, 0.0, 1.0]]
    pose = armctl.Pose([0.1, 0.2, 0.3], rpy=[0.3, -0.4, 0.5])
    first = armctl.points_from_depth(depth, fovy=1.0, T_world_camera=pose)
    assert armctl.points_from_depth(depth, intrinsics=matrix, T_world_camera=pose) == pytest.approx(first, abs=1e-12)
    in_camera = (first - pose.position) @ pose.rotation
    assert in_camera[:, 2] == pytest.approx(depth.ravel(), abs=1e-12)


def test_pixels_without_a_depth_are_left_out():
    assert len(armctl.points_from_depth([[0.0, np.nan], [np.inf, 1.0]], fovy=1.0)) == 1


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: armctl.points_from_depth([1.0, 2.0], fovy=1.0), armctl.InputError, "depth: expected shape"),
        (lambda: armctl.points_from_depth([["a"]], fovy=1.0), armctl.InputError, "depth: .* not a picture"),
        (lambda: armctl.points_from_depth([[1.0]]), armctl.InputError, "either fovy, rad, or intrinsics"),
        (lambda: armctl.points_from_depth([[1.0]], fovy=60.0), armctl.InputError, "fovy: .* in .0.01, 3., got 60"),
        (lambda: armctl.points_from_depth([[1.0]], intrinsics=np.zeros((3, 3))), armctl.InputError, "intrinsics: expected"),
        (lambda: armctl.Camera([0, 0, 1]), armctl.InputError, "at: expected Pose"),  # type: ignore
    ],
)
def test_a_wrong_call_is_one_sentence(call, error, message):
    with pytest.raises(error, match=message):
        call()


@pytest.mark.parametrize(
    ("camera", "message"),
    [("wrist", "camera"), (armctl.Camera(armctl.Pose([0, 0, 1]), on="hnad"), "body or site of the camera")],
)
def test_a_camera_that_is_nowhere_is_an_unknown_name(sim, camera, message):
    with pytest.raises(armctl.UnknownNameError, match=message):
        sim.camera(camera, SIZE)


def test_without_opengl_the_error_says_what_to_install(sim, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "nothing")
    with pytest.raises(armctl.NotInstalledError, match="OpenGL by nothing produces no picture"):
        sim.camera(armctl.Camera(armctl.Pose([0, 0, 1])), (48, 32))
