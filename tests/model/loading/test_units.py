"""Files in other units than their reader takes: load warns, doctor finds an error, and no file of usual units is doubted."""

import math
import warnings

import mujoco
import pytest
from synthetic import limb, mjcf, motors

import armctl
from armctl.core.errors import MissingShapeWarning


def of_ranges(*ranges: str, angle: str = "radian") -> str:
    """A limb with these ranges of its joints."""
    names = "a b c d e f"[: 2 * len(ranges) - 1]
    text = mjcf(limb(names), motors(names)).replace('angle="radian"', f'angle="{angle}"')
    for given in ranges:
        text = text.replace('range="-2 2"', f'range="{given}"', 1)
    return text


def of_urdf(length: float, upper: float = 2.0) -> str:
    inertial = '<inertial><mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>'
    links = "".join(f'<link name="l{i}">{inertial}</link>' for i in range(4)) + '<link name="tool"/>'
    joints = "".join(
        f'<joint name="j{i}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/><origin xyz="0 0 {length}"/>'
        f'<axis xyz="0 1 0"/><limit lower="{-upper}" upper="{upper}" effort="1e7" velocity="2"/></joint>'
        for i in range(3)
    )
    joints += f'<joint name="end" type="fixed"><parent link="l3"/><child link="tool"/><origin xyz="0 0 {length}"/></joint>'
    return f'<robot name="arm">{links}{joints}</robot>'


DEGREES = {
    "half turns": ("-180 180", "-180 180", "-90 90"),
    "one joint": ("-2 2", "-170 170"),
    "small numbers of degrees": ("-2 2", "0 45"),
    "one sided": ("-3 3", "0 150", "-3 3"),
    "many turns": ("-360 360", "-2 2"),
}
USUAL = {
    "two turns": ("-6.2832 6.2832", "-12.566 12.566"),
    "ten turns, rounded": ("-62.8 62.8", "-31.4159 31.4159"),
    "no limit, as a number": ("-1e6 1e6", "-9999 9999"),
    "one narrow joint": ("-2 2", "-0.05 0.05"),
    "narrow but not as narrow": ("-0.5 0.5", "-0.4 0.4"),
}


@pytest.mark.parametrize("form", DEGREES)
def test_degrees_taken_as_radians_are_doubted(form: str):
    text = of_ranges(*DEGREES[form])
    with pytest.warns(armctl.ArmctlWarning, match="are these degrees\\?"):
        armctl.load(mujoco.MjSpec.from_string(text))
    found = armctl.diagnose(mujoco.MjSpec.from_string(text))
    assert not found.ok
    assert "degrees" in found.reason
    assert "radians" in found.reason
    assert len(found.reason) <= 400


@pytest.mark.parametrize("ranges", [("-3.14 3.14", "-2 2", "-1.57 1.57"), ("-6.28 6.28", "-6.28 6.28"), ("-2.9 2.9",)])
def test_radians_taken_as_degrees_are_doubted(ranges: tuple[str, ...]):
    text = of_ranges(*ranges, angle="degree")
    with pytest.warns(armctl.ArmctlWarning, match='are these numbers radians\\? write <compiler angle="radian"/>'):
        arm = armctl.load(mujoco.MjSpec.from_string(text))
    assert arm.limits.q_max[0] == pytest.approx(math.radians(float(ranges[0].split()[1])))
    assert not armctl.diagnose(mujoco.MjSpec.from_string(text)).ok


@pytest.mark.parametrize("form", USUAL)
def test_usual_ranges_are_not_doubted(form: str):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", MissingShapeWarning)
        armctl.load(mujoco.MjSpec.from_string(of_ranges(*USUAL[form])))


@pytest.mark.parametrize(
    ("length", "upper", "unit"), [(300.0, 2.0, "millimetres"), (0.3, 360.0, "degrees"), (0.3, 120.0, "degrees")]
)
def test_a_urdf_in_degrees_or_millimetres_is_doubted(tmp_path, length: float, upper: float, unit: str):
    path = tmp_path / "arm.urdf"
    path.write_text(of_urdf(length, upper))
    with pytest.warns(armctl.ArmctlWarning, match=unit):
        armctl.load(path)
    assert not armctl.diagnose(path).ok
    path.write_text(of_urdf(0.3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", MissingShapeWarning)
        armctl.load(path)
