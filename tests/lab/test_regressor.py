"""The regressor of an arm: its parameters times the model's values are MuJoCo's torques."""

import mujoco
import numpy as np
import pytest
from synthetic import limb, motors

from armctl.lab.identification.regressor import ArmRegressor, FrictionShape


@pytest.mark.parametrize("gravcomp", [0.0, 0.6, 1.0])
def test_the_model_s_parameters_give_mujocos_torques_also_with_gravity_compensation(load, gravcomp):
    bodies = limb("a b c", joint='armature="0.05"').replace("<body name", f'<body gravcomp="{gravcomp}" name')
    arm = load(bodies, motors("a b c"))
    regressor = ArmRegressor(arm, "none")
    rng = np.random.default_rng(0)
    q = rng.uniform(-2, 2, (30, 3))
    v = rng.normal(size=(30, 3))
    a = rng.normal(size=(30, 3))
    data = mujoco.MjData(arm.model)
    expected = []
    for row in zip(q, v, a, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = row
        mujoco.mj_inverse(arm.model, data)
        expected.append(data.qfrc_inverse.copy())
    torques = regressor.rows(q, v, a, FrictionShape(0.01, 0.1)) @ regressor.model_values
    assert torques == pytest.approx(np.array(expected), abs=1e-9)
