"""Actuation: the joints, motors and limits of an arm."""

from dataclasses import replace

import numpy as np
import pytest

import armctl


def test_an_arm_with_other_limits_keeps_everything_else(bundled: armctl.Arm):
    slow = bundled.with_limits(replace(bundled.limits, v_max=0.5 * bundled.limits.v_max))
    assert np.array_equal(slow.limits.v_max, 0.5 * bundled.limits.v_max)
    assert slow.actuation.joint_map is bundled.joint_map
    assert slow.model is bundled.model
    assert np.array_equal(slow.fk(slow.home).position, bundled.fk(bundled.home).position)


def test_limits_of_another_arm_are_refused(bundled: armctl.Arm):
    with pytest.raises(armctl.InputError, match=r"expected 3 joints .*, got 2"):
        bundled.with_limits(armctl.Limits(*(np.ones(2) * scale for scale in (-1, 1, 1, 1, 1, 1))))
    with pytest.raises(armctl.InputError, match="expected Limits"):
        bundled.with_limits(3)  # pyright: ignore[reportArgumentType]
