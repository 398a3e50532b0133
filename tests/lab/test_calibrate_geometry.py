"""Joint offsets, lengths, axes and frames are found from measured poses of an arm that MuJoCo moves."""

from dataclasses import replace
from itertools import combinations

import mujoco
import numpy as np
import pytest
from arms import arm_of
from scipy.spatial.transform import Rotation
from synthetic import BENT, SHAPES, serial_arm

import armctl
from armctl.lab.identification.calibration_poses import exchanged
from armctl.model.collision.checkers import collision_checker

NOISE = 1e-4  # m
SHIFT = np.array([0.004, -0.003, 0.002])
ERRORS = {
    "j1 offset": ("j1", 0.006),
    "j2 offset": ("j2", -0.004),
    "j1 x": ("j1", SHIFT[0]),
    "j2 x": ("j2", SHIFT[1]),
    "tool x": ("tip", 0.005),
}
ARMS = {"six joints": BENT["six joints"], "redundant": BENT["redundant"], "sliding": SHAPES["sliding"]}


@pytest.fixture(scope="module", params=ARMS)
def pair(request, tmp_path_factory):
    """An arm, and the real one: its file with errors that only MuJoCo's compiler applies."""
    shape = replace(ARMS[request.param], range="-1.5 1.5")
    arm = serial_arm(tmp_path_factory.mktemp("file"), shape)
    folder = tmp_path_factory.mktemp("real")
    serial_arm(folder, shape)
    spec = mujoco.MjSpec.from_file(str(folder / "serial.xml"))
    for name, (where, value) in ERRORS.items():
        if name == "tool x":
            spec.site("tip").pos += [value, 0, 0]
            continue
        joint = spec.joint(where)
        if name.endswith("x"):
            joint.parent.pos += [value, 0, 0]
        elif joint.type == mujoco.mjtJoint.mjJNT_SLIDE:
            joint.parent.pos += value * np.asarray(joint.axis)
        else:
            joint.parent.quat = Rotation.from_rotvec(value * np.asarray(joint.axis)).as_quat(scalar_first=True)
    return arm, spec.compile()


def poses_of(model, q):
    """The tip at configurations, by MuJoCo: positions and rotations."""
    data = mujoco.MjData(model)
    tips = []
    for row in q:
        data.qpos[: len(row)] = row
        mujoco.mj_kinematics(model, data)
        tips.append((data.site("tip").xpos.copy(), data.site("tip").xmat.reshape(3, 3).copy()))
    return np.array([p for p, _ in tips]), np.array([R for _, R in tips])


def configurations(arm, count, seed=0):
    return np.random.default_rng(seed).uniform(0.8 * arm.limits.q_min, 0.8 * arm.limits.q_max, (count, arm.n))


def noisy(positions, seed=1):
    return positions + NOISE * np.random.default_rng(seed).standard_normal(positions.shape)


def fixed_pose(seed):
    rng = np.random.default_rng(seed)
    return armctl.Pose(rng.uniform(-1, 1, 3), rng.standard_normal(4))


def test_errors_of_a_file_are_found_within_their_intervals(pair):
    arm, real = pair
    q = configurations(arm, 40)
    found = armctl.calibrate_geometry(arm, q, noisy(poses_of(real, q)[0]), parameters=list(ERRORS))
    assert found, found.reason
    kept = dict(zip(found.names, zip(found.values, found.errors, strict=True), strict=True))
    assert len(kept) + len(found.inseparable) == len(ERRORS)
    for name, (value, error) in kept.items():
        if found.inseparable:  # a slide's offset and shift are one error
            continue
        assert abs(value - ERRORS[name][1]) < 4 * error, name
        assert error < 5e-4
    assert found.noise[0] == pytest.approx(NOISE, rel=0.25)
    fresh = configurations(arm, 100, seed=9)
    apart = np.linalg.norm(found.applied_to(arm).fk_many(fresh)[0] - poses_of(real, fresh)[0], axis=1)
    assert np.sqrt(np.mean(apart**2)) < NOISE
    assert found.accuracy_after < 0.2 * found.accuracy_before


def test_all_parameters_together_predict_other_poses(pair):
    arm, real = pair
    q = configurations(arm, 40)
    found = armctl.calibrate_geometry(arm, q, noisy(poses_of(real, q)[0]))
    assert found, found.reason
    assert any("no pose separates it from" in sentence for sentence in found.inseparable)
    fresh = configurations(arm, 100, seed=9)
    apart = np.linalg.norm(found.applied_to(arm).fk_many(fresh)[0] - poses_of(real, fresh)[0], axis=1)
    assert np.sqrt(np.mean(apart**2)) < 2 * NOISE


@pytest.mark.parametrize("sensor", ["fixed", "hand"])
@pytest.mark.parametrize("positions_only", [False, True])
def test_hand_eye_transforms_are_exact_without_noise(pair, sensor, positions_only):
    arm, _ = pair
    q = configurations(arm, 15)
    mount, marker = fixed_pose(1), fixed_pose(2)
    tips = [arm.fk(row) for row in q]
    fixed = [mount.inverse() @ T @ marker for T in tips]
    on_hand = [(T @ mount).inverse() @ marker for T in tips]
    seen = fixed if sensor == "fixed" else on_hand
    measured = np.array([T.position for T in seen]) if positions_only else seen
    found = armctl.calibrate_geometry(arm, q, measured, sensor=sensor, parameters=["sensor", "marker"])
    assert found, found.reason
    assert np.allclose(found.sensor.matrix, mount.matrix, atol=1e-7)
    assert np.allclose(found.marker.position, marker.position, atol=1e-7)
    assert np.allclose(found.applied_to(arm).fk(arm.home).matrix, arm.fk(arm.home).matrix)


def test_files_have_the_calibrated_geometry(pair, tmp_path):
    arm, real = pair
    q = configurations(arm, 40)
    measured = [armctl.Pose.from_rotation(*T) for T in zip(*poses_of(real, q), strict=True)]
    found = armctl.calibrate_geometry(arm, q, measured)
    text = mujoco.MjSpec.from_file(str(found.to_mjcf(tmp_path / "arm.xml", source=_file_of(arm, tmp_path)))).compile()
    positions, rotations = poses_of(text, q)
    assert np.abs(positions - poses_of(real, q)[0]).max() < 2e-5  # a file has six digits
    assert np.abs(rotations - poses_of(real, q)[1]).max() < 2e-5
    chain = armctl.load(found.to_urdf(tmp_path / "arm.urdf"), tip="tip")
    assert np.abs(chain.fk_many(q)[0] - poses_of(real, q)[0]).max() < 1e-6
    assert np.allclose(found.applied_to(arm).model.site("tip").pos, real.site("tip").pos, atol=1e-6)


def _file_of(arm, folder):
    shape = next(replace(shape, range="-1.5 1.5") for shape in ARMS.values() if shape.joints == arm.n and _slides(shape, arm))
    serial_arm(folder, shape)
    return folder / "serial.xml"


def _slides(shape, arm):
    return shape.slides == int(arm.pinocchio_model.is_slide.sum())


def test_a_file_with_frames_and_angles_is_corrected(tmp_path):
    text = """<mujoco><compiler angle="radian"/><worldbody><body name="stand" pos="0 0 1" euler="0 0 0.3"><geom size="0.01"/>
    <frame pos="0.1 0 0" euler="0 0.2 0"><body name="A" euler="0.1 0 0"><joint name="a" axis="0 0 1" range="-2 2"/>
    <geom size="0.02" contype="0"/><body name="B" pos="0.2 0 0.1"><joint name="b" axis="0 1 0" range="-2 2"/>
    <geom size="0.02" contype="0"/><body name="hand" pos="0.2 0 0"/></body></body></frame></body></worldbody>
    <actuator><motor joint="a" ctrlrange="-9 9"/><motor joint="b" ctrlrange="-9 9"/></actuator></mujoco>"""
    path = tmp_path / "framed.xml"
    path.write_text(text)
    arm = armctl.load(path, tip="hand")
    q = configurations(arm, 20)
    shift = armctl.Pose([0.01, 0.02, 0.0], rpy=[0.0, 0.01, 0.0])
    measured = [shift @ arm.fk(row) @ shift for row in q]
    found = armctl.calibrate_geometry(arm, q, measured)
    assert found, found.reason
    again = armctl.load(found.to_mjcf(tmp_path / "new.xml", source=path), tip="calibrated_tip")
    assert max(np.abs(again.fk(row).matrix - T.matrix).max() for row, T in zip(q, measured, strict=True)) < 2e-5


def test_what_the_poses_do_not_show_is_named_and_rejected(pair):
    arm, real = pair
    q = configurations(arm, 40)
    q[:, 2:] = 0.3
    found = armctl.calibrate_geometry(arm, q, noisy(poses_of(real, q)[0]))
    assert not found
    assert found.unseen
    assert "the poses do not show " in found.reason
    with pytest.raises(armctl.InputError, match="not calibrated"):
        found.applied_to(arm)


def test_an_exact_file_is_not_made_worse(pair):
    arm, _ = pair
    q = configurations(arm, 14)
    found = armctl.calibrate_geometry(arm, q, noisy(arm.fk_many(q)[0]))
    assert not found
    assert "the file predicts the measured positions better" in found.reason


def test_calibrated_bodies_are_those_of_an_elastic_plant(pair):
    arm, real = pair
    q = configurations(arm, 40)
    corrected = armctl.calibrate_geometry(arm, q, poses_of(real, q)[0], parameters=list(ERRORS)).applied_to(arm)
    model = armctl.Plant(elasticity=1e-3, rotor_inertia=1.0).model(corrected)
    assert np.array_equal(model.body_pos[: corrected.model.nbody], corrected.model.body_pos)


def test_chosen_poses_are_free_and_better_than_random_ones():
    arm = arm_of("robot_arm_3dof")
    found = armctl.calibration_poses(arm, 8)
    again = armctl.calibration_poses(arm, 8)
    assert np.array_equal(found.q, again.q)
    assert found.information > 1.2
    assert found.condition_number < 100
    checker = collision_checker(arm)
    for q in found.q:
        line = np.linspace(found.start, q, 50)
        assert not any(checker.at(row, found.clearance) for row in line)
    high = armctl.calibration_poses(arm, 8, visible=lambda T: T.position[2] > 0.5)
    assert (arm.fk_many(high.q)[0][:, 2] > 0.5).all()


@pytest.mark.parametrize("parameters", [["offsets", "lengths"], ["offsets", "tool"], ["lengths"]])
@pytest.mark.parametrize("positions_only", [True, False])
def test_chosen_poses_show_what_a_calibration_fits_whatever_the_digits_of_a_file(tmp_path, parameters, positions_only):
    """The axes of the second and the third joint are parallel but for 2e-5, as rounded numbers of a file are."""
    serial_arm(tmp_path, BENT["six joints"])
    path = tmp_path / "rounded.xml"
    path.write_text((tmp_path / "serial.xml").read_text().replace('axis="0 1 0"', 'axis="0.00002 1 0"', 1))
    arm = armctl.load(path)
    poses = armctl.calibration_poses(arm, 30, parameters=parameters, positions_only=positions_only, seed=2)
    assert poses.condition_number < 1e3
    rng = np.random.default_rng(4)
    position, rotation = arm.fk_many(poses.q)
    position = position + rng.normal(scale=1e-5, size=position.shape)
    measured = position if positions_only else [armctl.Pose.from_rotation(*row) for row in zip(position, rotation, strict=True)]
    found = armctl.calibrate_geometry(arm, poses.q, measured, parameters=parameters)
    assert not found.unseen
    assert "do not show" not in found.reason


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parameters": ["offsets", "colour"]}, "parameters: expected a list"),
        ({"parameters": "offsets"}, "parameters: expected a list"),
        ({"sensor": "eye"}, "sensor: expected one of world, fixed, hand"),
        ({"measured": np.zeros((5, 2))}, "measured"),
        ({"measured": np.zeros((4, 3))}, "as many as rows of q, got 4 and 5"),
        ({"q": np.zeros((5, 2))}, "q: expected"),
    ],
)
def test_bad_input_is_one_sentence(change, message):
    arm = arm_of("planar")
    arguments = {"q": np.zeros((5, 3)), "measured": np.zeros((5, 3))} | change
    with pytest.raises(armctl.InputError, match=message):
        armctl.calibrate_geometry(arm, arguments.pop("q"), arguments.pop("measured"), **arguments)


def test_poses_that_cannot_be_had_are_one_sentence():
    arm = arm_of("robot_arm_3dof")
    with pytest.raises(armctl.PlanError, match="only 0 of 8000 random poses"):
        armctl.calibration_poses(arm, 8, visible=lambda T: False)
    with pytest.raises(armctl.InputError, match="parameters need at least"):
        armctl.calibration_poses(arm, 4)


def test_the_chosen_poses_are_those_with_the_most_information():
    """Of all triples of ten poses, none has a larger determinant of the information."""
    J = np.random.default_rng(3).normal(size=(10, 3, 4)) * np.geomspace(1.0, 8.0, 10)[:, None, None]

    def information(poses):
        rows = np.concatenate(J[list(poses)])
        return np.linalg.det(rows.T @ rows)

    best = max(combinations(range(10), 3), key=information)
    assert sorted(exchanged(J, 3)) == list(best)
