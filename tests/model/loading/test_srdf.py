"""SRDFs beside a URDF: pairs of links that may touch, home, groups; and what happens without one."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from synthetic import FIRST, INERTIA, JOINT, LIMIT, LINK, SECOND, TOOL, urdf

import armctl

BALL = '<collision><geometry><sphere radius="0.4"/></geometry></collision>'
THIRD = JOINT.format("j3", "revolute", "two", "three", LIMIT)
# Links one and three, which are no neighbours, overlap in every configuration.
ROBOT = urdf(FIRST, SECOND, THIRD, TOOL, shapes=BALL).replace(
    LINK.format("three", INERTIA, ""), LINK.format("three", INERTIA, BALL)
)
PAIRS = '<disable_collisions link1="three" link2="one" reason="Adjacent"/>'
STATE = '<group_state name="Home" group="arm"><joint name="j1" value="0.3"/><joint name="j2" value="-0.4"/></group_state>'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "urdf"
    path.mkdir()
    return path


@pytest.fixture
def load(folder: Path):
    def loaded(content: str = "", name: str = "r.srdf", **keywords: object) -> armctl.Arm:
        (folder / "r.urdf").write_text(ROBOT)
        if content:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(f'<robot name="r">{content}</robot>')
        return armctl.load(folder / "r.urdf", **keywords)

    return loaded


def contacts_at_home(arm: armctl.Arm) -> int:
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.home_qpos
    mujoco.mj_forward(arm.model, data)
    return data.ncon


@pytest.mark.parametrize("name", ["r.srdf", "../srdf/r.srdf", "another.srdf"])
def test_pairs_that_an_srdf_disables_do_not_touch(load, name: str):
    arm = load(PAIRS, name)
    assert contacts_at_home(arm) == 0
    assert any("contacts of 1 pairs of links left out" in note for note in arm.notes)


def test_without_an_srdf_links_that_touch_at_home_may_touch_with_a_warning(load):
    with pytest.warns(armctl.ArmctlWarning, match=r"contacts of 1 pair of links left out.*\(one with three\); srdf= can give"):
        arm = load()
    assert contacts_at_home(arm) == 0
    assert armctl.Simulation(arm, "computed-torque").move_j(arm.home + 0.2).ok


def test_an_srdf_with_other_pairs_leaves_the_contact(load):
    assert contacts_at_home(load('<disable_collisions link1="two" link2="three"/>')) > 0


def test_an_srdf_of_another_file_name_can_be_of_a_variant_so_links_that_touch_are_excluded_too(load):
    with pytest.warns(armctl.ArmctlWarning, match="contacts of 1 pair of links left out"):
        arm = load('<disable_collisions link1="two" link2="three"/>', "variant.srdf")
    assert contacts_at_home(arm) == 0


def test_an_object_of_the_scene_that_touches_the_robot_still_touches_it(load):
    scene = armctl.World().add("crate", armctl.Box([0.4, 0.4, 0.4]), [0.0, 0.0, 0.3])
    with pytest.warns(armctl.ArmctlWarning, match="contacts of 1 pair of links"):
        arm = load(scene=scene)
    assert contacts_at_home(arm) > 0


def test_home_is_the_state_of_that_name(load):
    arm = load(PAIRS + STATE)
    np.testing.assert_array_equal(arm.home, [0.3, -0.4, 0.0])


def test_home_of_several_groups_is_merged_and_kept_inside_the_limits(load):
    other = '<group_state name="home" group="wrist"><joint name="j3" value="9"/></group_state>'
    np.testing.assert_array_equal(load(PAIRS + STATE + other).home, [0.3, -0.4, 1.5])


def test_home_survives_a_scene_with_loose_objects(load):
    scene = armctl.World().add("crate", armctl.Box([0.1, 0.1, 0.1]), [2.0, 0.0, 0.3], mass=1.0)
    np.testing.assert_array_equal(load(PAIRS + STATE, scene=scene).home, [0.3, -0.4, 0.0])


def test_a_group_names_base_and_tip(load):
    arm = load(PAIRS + '<group name="wrist"><chain base_link="one" tip_link="three"/></group>', tip="wrist")
    assert (arm.joint_names, arm.tip) == (("j2", "j3"), "three")


def test_groups_name_the_tips_of_an_arm_with_several(load):
    groups = '<group name="wrist"><chain base_link="one" tip_link="three"/></group>'
    groups += '<group name="elbow"><chain base_link="base" tip_link="two"/></group>'
    arm = load(PAIRS + groups, tips=["wrist", "elbow"])
    assert arm.tips == ("three", "two")
    assert arm.joint_names == load(PAIRS, tip="three").joint_names


def test_an_srdf_can_be_given_by_its_path(load, tmp_path: Path):
    elsewhere = tmp_path / "deep" / "pairs.srdf"
    elsewhere.parent.mkdir()
    elsewhere.write_text(f'<robot name="other">{PAIRS}</robot>')
    assert contacts_at_home(load(srdf=elsewhere)) == 0


def test_of_several_srdfs_with_the_name_of_the_robot_none_is_guessed(load, folder: Path):
    for name in ("a.srdf", "b.srdf"):
        (folder / name).write_text(f'<robot name="r">{PAIRS}</robot>')
    with pytest.warns(armctl.ArmctlWarning, match="srdf= can give the right pairs"):
        load()


BROKEN = {
    "no number": (STATE.replace("0.3", "up"), "joint 'j1': its position 'up' is not a finite number"),
    "not finite": (STATE.replace("0.3", "nan"), "its position 'nan' is not a finite number"),
    "no XML": ("<group", "no well-formed XML"),
}


@pytest.mark.parametrize(("text", "reason"), BROKEN.values(), ids=BROKEN)
def test_a_broken_srdf_is_one_clear_sentence(load, text: str, reason: str):
    with pytest.raises(armctl.ModelError, match=reason):
        load(text)


def test_an_srdf_that_does_not_exist_or_is_none_is_one_clear_sentence(load, tmp_path: Path):
    with pytest.raises(armctl.ModelError, match=r"absent.srdf: cannot be read: No such file"):
        load(srdf=tmp_path / "absent.srdf")
    (tmp_path / "x.srdf").write_text("<mujoco/>")
    with pytest.raises(armctl.ModelError, match="no SRDF: its first element is <mujoco>"):
        load(srdf=tmp_path / "x.srdf")
    with pytest.raises(armctl.InputError, match="srdf: expected str or PathLike, got 3"):
        load(srdf=3)


@pytest.mark.filterwarnings("ignore:r. contacts of")
def test_a_compiled_model_takes_no_srdf(load):
    with pytest.raises(armctl.InputError, match="srdf: a compiled MjModel cannot be changed in this way"):
        armctl.load(load().model, srdf="r.srdf")
