"""Target is read once: it checks what people give it, and is not read again."""

import numpy as np
import pytest

from armctl import InputError, Pose
from armctl.core.target import ANGLE_TOLERANCE, TOLERANCE, Target


def test_a_target_that_was_read_is_returned_as_it_is():
    target = Target.read([1.0, 2.0, 3.0], 0.1, 0.2)
    assert Target.read(target) is target
    stricter = Target.read(target, 0.01)
    assert (stricter.tolerance, stricter.angle_tolerance) == (0.01, 0.2)
    assert stricter.position is target.position


def test_a_pose_constrains_the_orientation_and_a_point_does_not():
    pose = Pose([1.0, 2.0, 3.0], rpy=[0.0, 0.0, 0.5])
    tip = Pose([1.0, 2.0, 3.0])
    assert Target.read(pose).distance(tip) == pytest.approx((0.0, 0.5), abs=1e-15)
    assert Target.read(pose.position).distance(tip) == (0.0, 0.0)
    assert Target.read(pose.position).is_reached(tip)
    assert not Target.read(pose).is_reached(tip)


def test_tolerances_default_to_a_millimetre_and_a_hundredth_of_a_radian():
    target = Target.read([0.0, 0.0, 0.0])
    assert (target.tolerance, target.angle_tolerance) == (TOLERANCE, ANGLE_TOLERANCE) == (1e-3, 1e-2)


def test_tolerances_are_converted_to_floats():
    target = Target.read([0.0, 0.0, 0.0], np.float32(0.5), 1)
    assert type(target.tolerance) is float
    assert type(target.angle_tolerance) is float


@pytest.mark.parametrize("name", ["tolerance", "angle_tolerance"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e-3, "0.1"])
def test_a_wrong_tolerance_is_rejected(name: str, value):
    with pytest.raises(InputError, match=f"^{name}: "):
        Target.read([0.0, 0.0, 0.0], **{name: value})


@pytest.mark.parametrize("target", [[1.0, 2.0], [1.0, 2.0, float("nan")], "here", None])
def test_a_wrong_target_is_rejected(target):
    with pytest.raises(InputError, match=r"^target: "):
        Target.read(target)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (([np.nan, 0.0, 0.0], None), r"position: element \[0\] is nan"),
        ((np.zeros(4), None), "position: expected 3 numbers, got 4"),
        ((np.zeros(3), np.eye(4)), "pose: expected Pose"),
        ((np.zeros(3), Pose([1.0, 0.0, 0.0])), "position: .* is not that of the pose"),
        ((np.zeros(3), None, np.nan), "tolerance: expected a finite number"),
        ((np.zeros(3), None, 1e-3, -1.0), "angle_tolerance: expected a number at least 0"),
    ],
)
def test_a_target_that_is_made_directly_is_checked_too(arguments, sentence: str):
    with pytest.raises(InputError, match=sentence):
        Target(*arguments)
