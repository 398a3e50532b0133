"""Actuation: the joints, motors and limits of one arm, or of several arms of one model."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import limb, mjcf, motors

import armctl
from armctl.model.arm.actuation import Actuation

TWO_ARMS = limb("a b c") + limb("d e")
TIED_PAIRS = limb("a b c") + limb("d e f")
TIES = (
    '<equality><joint joint1="c" joint2="b" polycoef="0.1 -0.5 0 0 0"/>'
    '<joint joint1="f" joint2="d" polycoef="0 2 0 0 0"/></equality>'
)


@pytest.fixture
def load_arms(tmp_path):
    def loaded(bodies: str, rest: str, tips: list[str]) -> tuple[armctl.Arm, ...]:
        path = tmp_path / "two.xml"
        path.write_text(mjcf(bodies, rest))
        return armctl.load_arms(path, tips)

    return loaded


def test_concatenated_joints_stand_in_the_order_of_the_arms(load_arms):
    arms = load_arms(TWO_ARMS, motors("a b c d e"), ["C", "E"])
    both = Actuation.concatenated([arm.actuation for arm in arms])
    assert both.n == 5
    assert both.joint_names == ("a", "b", "c", "d", "e")
    assert both.units == ("rad",) * 5
    assert both.torque_units == ("N m",) * 5
    for name in ("qpos_adr", "dof_adr", "ctrl_adr", "motor_adr", "gear"):
        column = getattr(both, name)
        assert np.array_equal(column, np.concatenate([getattr(arm.actuation, name) for arm in arms])), name
        assert not column.flags.writeable, name
    assert np.array_equal(both.limits.tau_max, [20.0] * 5)


def test_concatenated_couplings_move_each_arm_as_it_moves_alone(load_arms):
    arms = load_arms(TIED_PAIRS, TIES + motors("a b d e"), ["C", "F"])
    both = Actuation.concatenated([arm.actuation for arm in arms])
    q = np.array([0.1, 0.2, 0.3, 0.4])
    together = arms[0].home_qpos.copy()
    both.joint_map.set_positions(together, q)
    alone = arms[0].home_qpos.copy()
    arms[0].joint_map.set_positions(alone, q[:2])
    arms[1].joint_map.set_positions(alone, q[2:])
    assert np.array_equal(together, alone)
    assert together == pytest.approx([0.1, 0.2, 0.1 - 0.5 * 0.2, 0.3, 0.4, 2 * 0.3])
    force = np.arange(6.0)
    each = np.concatenate([arm.joint_map.reduced(force) for arm in arms])
    assert both.joint_map.reduced(force) == pytest.approx(each)


def test_arms_that_share_a_joint_are_refused(bundled: armctl.Arm):
    with pytest.raises(armctl.InputError, match="two of them move the same joint"):
        Actuation.concatenated([bundled.actuation, bundled.actuation])


def test_no_arms_are_refused():
    with pytest.raises(armctl.InputError, match="at least one"):
        Actuation.concatenated([])


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
