"""URDFs as they are found in the wild: transmissions, half of the limits, impossible inertias, meshes that nothing reads."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from synthetic import FIRST, INERTIA, JOINT, LIMIT, LINK, MESH, SECOND, THIRD, TOOL, urdf

import armctl
from armctl.model.arm.parity import PARITY_TOLERANCE, check_parity
from armctl.model.loading.inertias import MIN_INERTIA_KG_M2, MIN_MASS_KG, nearest_inertia

TRANSMISSIONS = "".join(f'<transmission name="t{j}"><joint name="{j}"/></transmission>' for j in ("j1", "j2"))


@pytest.fixture
def load(tmp_path: Path):
    def loaded(text: str) -> armctl.Arm:
        path = tmp_path / "r.urdf"
        path.write_text(text)
        return armctl.load(path)

    return loaded


def with_inertia(inertia: str) -> str:
    return urdf(FIRST, SECOND, THIRD, TOOL).replace(INERTIA, inertia, 1)


def test_a_transmission_that_names_a_joint_does_not_hide_its_speed_limit(load):
    arm = load(urdf(FIRST, SECOND, THIRD, TOOL, TRANSMISSIONS))
    assert arm.limits.v_max == pytest.approx([2.5, 2.5])
    assert arm.sources["v_max"] == "URDF"


def test_a_joint_without_a_speed_limit_takes_the_default_and_the_others_keep_theirs(load):
    slow = JOINT.format("j2", "revolute", "one", "two", LIMIT.replace(' velocity="2.5"', ""))
    arm = load(urdf(FIRST, slow, THIRD, TOOL))
    assert arm.limits.v_max == pytest.approx([2.5, 2.0])
    assert arm.sources["v_max"] == "URDF; default for j2"


def test_a_speed_limit_that_is_no_number_is_one_clear_sentence(load):
    with pytest.raises(armctl.ModelError, match="joint 'j1': its velocity limit 'fast' is not a number"):
        load(urdf(FIRST.replace('velocity="2.5"', 'velocity="fast"'), SECOND, THIRD, TOOL))


def test_velocity_limits_near_the_ends_of_ranges_are_read(load):
    near_ends = '<position_based_velocity_limits deceleration_limit="6.0" velocity_offset="0.30"/></joint>'
    limits = load(urdf(FIRST.replace("</joint>", near_ends), SECOND, THIRD, TOOL)).limits
    assert limits.deceleration_limit.tolist() == [6.0, np.inf]
    assert limits.velocity_offset.tolist() == [0.3, 0.0]
    for wrong, sentence in {"0.0": "deceleration_limit 0 must be a positive", "x": "deceleration_limit 'x' is not a n"}.items():
        with pytest.raises(armctl.ModelError, match=f"joint 'j1': its {sentence}"):
            load(urdf(FIRST.replace("</joint>", near_ends.replace("6.0", wrong)), SECOND, THIRD, TOOL))


def test_blanks_before_the_declaration_do_no_harm(load):
    assert load('\n  <?xml version="1.0"?>\n' + urdf(FIRST, SECOND, THIRD, TOOL)).n == 2


def test_what_mujoco_forgives_but_xml_does_not_is_one_clear_sentence(load):
    with pytest.raises(armctl.ModelError, match=r"no well-formed XML: .*line 1"):
        load(urdf(FIRST, SECOND, THIRD, TOOL) + "\0")


IMPOSSIBLE = {
    "two moments below the third": '<inertia ixx="0.001" iyy="0.001" izz="0.05" ixy="0" ixz="0" iyz="0"/>',
    "a negative one": '<inertia ixx="-0.001" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>',
    "a rod without width": '<inertia ixx="0.01" iyy="0.01" izz="0" ixy="0" ixz="0" iyz="0"/>',
}


@pytest.mark.parametrize("inertia", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_an_inertia_that_no_body_has_is_mended_aloud(load, inertia: str):
    with pytest.warns(armctl.ArmctlWarning, match="the inertia of one is impossible"):
        arm = load(with_inertia(inertia))
    moments = np.sort(arm.model.body("one").inertia)
    assert moments[0] > 0
    assert moments[0] + moments[1] >= moments[2]
    assert check_parity(arm) <= PARITY_TOLERANCE


@given(st.lists(st.floats(-1, 1), min_size=6, max_size=6))
def test_the_nearest_inertia_is_possible_and_a_possible_one_stays(numbers: list[float]):
    xx, yy, zz, xy, xz, yz = numbers
    mended = nearest_inertia(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    moments = np.linalg.eigvalsh(mended)
    assert moments[0] >= 0
    assert moments[0] + moments[1] >= moments[2] * (1 - 1e-12)
    ball = np.eye(3) * (1.1 + abs(xx))
    assert nearest_inertia(ball) is ball


def test_links_without_mass_or_shape_get_a_small_mass_aloud(load):
    text = urdf(FIRST, SECOND, THIRD, TOOL)
    for name in ("one", "two", "three"):
        text = text.replace(LINK.format(name, INERTIA, ""), f'<link name="{name}"/>')
    with pytest.warns(armctl.ArmctlWarning, match="no mass or inertia given for one, two: 0.001 kg and 1e-06 kg m"):
        arm = load(text)
    assert arm.model.body("one").mass == pytest.approx(MIN_MASS_KG)
    assert arm.model.body("two").inertia == pytest.approx(np.full(3, MIN_INERTIA_KG_M2))
    assert armctl.solve_ik(arm, arm.fk([0.3, 0.4]).position).ok


def test_a_mass_that_its_shapes_gave_is_said(load):
    ball = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'
    text = urdf(FIRST, SECOND, THIRD, TOOL).replace(LINK.format("two", INERTIA, ""), f'<link name="two">{ball}</link>')
    with pytest.warns(
        armctl.ArmctlWarning, match="no inertial given for two: mass and inertia are those of the collision shapes"
    ):
        arm = load(text)
    assert arm.model.body("two").mass == pytest.approx(4 / 3 * np.pi * 0.1**3 * 1000)


def test_a_massless_link_with_an_inertia_counts_as_in_mujoco(load):
    wheel = '<link name="tool0"><inertial><mass value="0"/>' + INERTIA + "</inertial></link>"
    arm = load(urdf(FIRST, SECOND, THIRD, TOOL).replace('<link name="tool0"/>', wheel))
    assert check_parity(arm) <= PARITY_TOLERANCE
    assert arm.with_payload(0.5).n == 2  # and a payload on it is a point


@pytest.mark.parametrize("effort", ["40", "0"])
@pytest.mark.filterwarnings("ignore:r. no torque limit")
def test_a_range_that_ends_below_its_start_counts_as_unlimited_aloud(load, effort: str):
    backward = LIMIT.replace('lower="-1" upper="1.5"', 'lower="1" upper="-1"').replace("40", effort)
    with pytest.warns(armctl.ArmctlWarning, match="the range of j1 ends below its start, so it counts as unlimited"):
        arm = load(urdf(JOINT.format("j1", "revolute", "base", "one", backward), SECOND, THIRD, TOOL))
    assert np.isinf(arm.limits.q_max[0])


ASCII = "solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid x\n"


@pytest.mark.parametrize(("content", "why"), [(ASCII, "perhaps this is an ASCII file"), ("", "is empty")])
def test_a_mesh_that_mujoco_refuses_is_left_out_aloud(load, tmp_path: Path, content: str, why: str):
    (tmp_path / "one.stl").write_text(content)
    with pytest.warns(armctl.ArmctlWarning, match=f"collision mesh 'one.stl' left out: .*{why}"):
        arm = load(urdf(FIRST, SECOND, THIRD, TOOL, shapes=MESH.format("one.stl")))
    assert arm.model.nmesh == 0


def test_meshes_left_out_for_the_same_reason_are_one_sentence(load):
    shapes = MESH.format("a.dae") + MESH.format("b.dae")
    with pytest.warns(armctl.ArmctlWarning, match="collision meshes 'a.dae', 'b.dae' left out: not found"):
        load(urdf(FIRST, SECOND, THIRD, TOOL, shapes=shapes))


def test_gravity_switched_off_by_a_flag_is_no_gravity(tmp_path: Path):
    path = tmp_path / "r.xml"
    path.write_text(
        '<mujoco><option><flag gravity="disable"/></option><worldbody><body gravcomp="1"><joint name="a" axis="0 1 0"/>'
        '<geom size="0.1" pos="0.3 0 0"/></body></worldbody><actuator><motor joint="a" ctrlrange="-9 9"/></actuator></mujoco>'
    )
    arm = armctl.load(path)
    assert arm.model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    log = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, [0.0], [0.5]))
    assert np.abs(log.q - log.q_ref).max() < 1e-12


def test_the_nearest_inertia_keeps_the_axes_and_every_moment_that_is_possible():
    """Principal moments of 1, 2 and 4 kg m^2 are no body's; the nearest by their second moments has the third as 3 kg m^2."""
    turn = Rotation.from_euler("xyz", [0.3, -0.8, 1.2]).as_matrix()
    second_moments = 0.5 * (1 + 2 + 4) - np.array([1.0, 2.0, 4.0])  # of which the last one is below 0
    kept = np.maximum(second_moments, 1e-7 * second_moments.max())
    found = nearest_inertia(turn @ np.diag([1.0, 2.0, 4.0]) @ turn.T)
    assert found == pytest.approx(turn @ np.diag(kept.sum() - kept) @ turn.T, abs=1e-9)
    possible = turn @ np.diag([1.0, 2.0, 2.9]) @ turn.T
    assert nearest_inertia(possible) is possible


TWO_LINKS = (
    f'<robot name="r"><link name="base"/>{"".join(LINK.format(k, INERTIA, "") for k in ("one", "two"))}{FIRST}{SECOND}</robot>'
)


def test_a_tip_that_the_last_joint_cannot_move_is_said(load):
    with pytest.warns(armctl.ArmctlWarning, match="joint 'j2' cannot move the tip 'two'; pass tip= or"):
        arm = load(TWO_LINKS)
    assert not arm.jacobian(arm.home)[:3, -1].any()


def test_nothing_is_said_of_a_tip_that_the_last_joint_moves_or_that_was_given(tmp_path: Path, recwarn: pytest.WarningsRecorder):
    path = tmp_path / "r.urdf"
    path.write_text(TWO_LINKS)
    armctl.load(path, tip="two")
    armctl.load(path, tip_offset=armctl.Pose([0.1, 0.0, 0.0]))
    path.write_text(urdf(FIRST, SECOND, THIRD, TOOL))
    armctl.load(path)
    assert not [each for each in recwarn if "cannot move" in str(each.message)]
