"""Home and DC motors of robots that were attached to another model under a prefix or a suffix."""

import mujoco
import numpy as np
import pytest
from synthetic import FAST, limb, mjcf, motors

import armctl

KEY = '<keyframe><key name="home" qpos="0.3 -0.7" ctrl="0.1 0.2"/></keyframe>'
DC = '<dcmotor name="m_b" joint="b" nominal="24 1.5 300" gear="50"/>'


def child(key: str = KEY) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(mjcf(limb("a b"), motors("a b") + key))


def pair(first: str, second: str, *, suffix: bool = False) -> mujoco.MjSpec:
    """Two arms beside each other; the second one's home is the negative of the first."""
    spec = mujoco.MjSpec()
    opposite = KEY.replace("0.3 -0.7", "-0.3 0.7")
    for y, name, key in ((0.0, first, KEY), (2.0, second, opposite)):
        affix = {"suffix": name} if suffix else {"prefix": name}
        spec.attach(child(key), frame=spec.worldbody.add_frame(pos=[0, y, 0]), **affix)
    return spec


def test_two_nominal_voltages_that_give_different_torques_compile_to_the_same_numbers():
    """So a specification or a model does not tell the torque of a motor without a range of its voltage."""
    specs = [
        mujoco.MjSpec.from_string(mjcf(limb("a b"), motors("a b", b=DC.replace("24 1.5 300", nominal))))
        for nominal in ("24 1.5 300", "48 3 600")
    ]
    assert specs[0].to_xml() == specs[1].to_xml()
    models = [spec.compile() for spec in specs]
    assert np.array_equal(models[0].actuator_gainprm, models[1].actuator_gainprm)
    for given in (*specs, *models):
        with pytest.raises(armctl.ModelError, match=r"m_b' has no voltage, so its torque is unknown.*load the file itself"):
            armctl.load(given, tip="B")


@pytest.mark.parametrize(("first", "second"), [("left/", "right/"), ("l_", "r_"), ("arm", "arm2")])
def test_each_attached_arm_starts_in_its_own_keyframe(first: str, second: str):
    both = armctl.load(pair(first, second), tips=[f"{first}B", f"{second}B"])
    assert both.home.tolist() == [0.3, -0.7, -0.3, 0.7]
    alone = armctl.load(pair(first, second), tip=f"{second}B")
    assert alone.home.tolist() == [-0.3, 0.7]


def test_a_suffix_serves_as_a_prefix():
    both = armctl.load(pair("_l", "_r", suffix=True), tips=["/B_l", "/B_r"])
    assert both.home.tolist() == [0.3, -0.7, -0.3, 0.7]


def test_an_arm_on_a_pedestal_is_at_its_own_home():
    pedestal = mujoco.MjSpec.from_string(mjcf('<body name="post"><geom type="box" size="0.1 0.1 0.1" pos="0 3 0"/></body>'))
    pedestal.attach(child(), prefix="arm/", frame=pedestal.body("post").add_frame(pos=[0, 0, 0.5]))
    assert armctl.load(pedestal).home.tolist() == [0.3, -0.7]


def test_the_home_of_the_whole_model_comes_before_that_of_a_part():
    spec = pair("left/", "right/")
    spec.compile()
    spec.add_key(name="home", qpos=[0.5, 0.6, 0.7, 0.8])
    assert armctl.load(spec, tips=["left/B", "right/B"]).home.tolist() == [0.5, 0.6, 0.7, 0.8]


def test_a_dc_motor_of_a_specification_has_the_curve_of_its_file(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(mjcf(limb("a b"), FAST + motors("a b", b=DC)))
    from_file = armctl.load(path)
    from_spec = armctl.load(mujoco.MjSpec.from_file(str(path)))
    assert from_spec.limits.stall_torque[1] == pytest.approx(75.0)
    assert from_spec.limits.no_load_speed[1] == pytest.approx(6.0)
    assert from_spec.limits.tau_max.tolist() == from_file.limits.tau_max.tolist()


@pytest.mark.parametrize("how", ["text", "prefix", "model"])
def test_a_dc_motor_whose_voltage_is_lost_is_refused_unless_it_is_given(how: str):
    def robot(motor: str) -> mujoco.MjSpec | mujoco.MjModel:
        spec = mujoco.MjSpec.from_string(mjcf(limb("a b"), motors("a b", b=motor)))
        if how == "model":
            return spec.compile()
        if how == "text":
            return spec
        parent = mujoco.MjSpec()
        parent.attach(spec, prefix="p/", frame=parent.worldbody.add_frame())
        return parent

    with pytest.raises(armctl.ModelError, match=r"m_b' has no voltage, .* write ctrlrange=.* saturation=") as caught:
        armctl.load(robot(DC))
    assert len(str(caught.value)) <= 400
    arm = armctl.load(robot(DC.replace("/>", ' ctrlrange="-24 24"/>')))
    assert arm.limits.stall_torque[1] == pytest.approx(75.0)
    limited = armctl.load(robot(DC.replace("/>", ' saturation="1.5 0 0"/>')))
    assert limited.limits.tau_max[1] == pytest.approx(75.0)
