"""Tuned gains satisfy the bounds that were asked for, and the next higher ones do not."""

from dataclasses import replace

import numpy as np
import pytest
from arms import arm_of
from synthetic import BENT, serial_arm

import armctl

PLANT = armctl.Plant(timestep=0.002)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return serial_arm(tmp_path_factory.mktemp("planar"), BENT["planar"])


@pytest.mark.parametrize("law", ["pd", "computed-torque-observer", "qp"])
def test_tuned_gains_satisfy_the_bounds(arm, law):
    found = armctl.tune(arm, law, delay_margin=8e-3, peak_sensitivity=1.65, poses=3, plants=[PLANT])
    assert found, found.reason
    margins = armctl.margins(arm, found.controller, 3, [PLANT])
    assert margins.delay.value == found.after.delay_margin >= 8e-3
    assert margins.peak_sensitivity.value == pytest.approx(found.after.peak_sensitivity)
    assert found.after.peak_sensitivity <= 1.65
    # At configurations that neither the design nor the judge knew.
    fresh = arm.limits.random(arm.home, 40, np.random.default_rng(5))
    assert armctl.margins(arm, found.controller, fresh, [PLANT]).delay.value >= 8e-3
    assert set(found.active) <= {"delay margin", "peak sensitivity", "none"}
    assert found.to_dict()["ok"] is True
    assert "active bound" in str(found)


def test_a_bound_on_torque_noise_is_active(arm):
    free = armctl.tune(arm, "computed-torque", poses=2, plants=[PLANT])
    bounded = armctl.tune(arm, "computed-torque", chatter=0.5 * free.after.chatter, poses=2, plants=[PLANT])
    assert bounded.active == ("chatter",)
    assert bounded.after.chatter <= 0.5 * free.after.chatter
    assert bounded.after.compliance > free.after.compliance


def test_default_gains_that_violate_a_bound_are_raised_if_higher_ones_satisfy_it():
    arm = arm_of("panda")
    assert armctl.margins(arm, "impedance", 4, [PLANT]).peak_sensitivity.value > 3.0
    found = armctl.tune(arm, "impedance", peak_sensitivity=3.0, poses=4, plants=[PLANT])
    assert found, found.reason
    assert found.gains["bandwidth"] > 40.0
    assert found.after.peak_sensitivity <= 3.0


def test_pd_of_a_damped_arm_is_much_stiffer_than_by_default(tmp_path):
    arm = serial_arm(tmp_path, replace(BENT["planar"], joint='damping="60"'))
    found = armctl.tune(arm, "pd-gravity", poses=3, plants=[PLANT])
    assert found, found.reason
    assert found.after.compliance < 0.2 * found.before.compliance


def test_bounds_that_no_gains_satisfy_are_a_result(arm):
    found = armctl.tune(arm, "pd", delay_margin=5.0, poses=2, plants=[PLANT])
    assert not found
    assert "no gains of pd satisfy" in str(found)


@pytest.mark.parametrize(
    ("call", "error"),
    [
        (lambda arm: armctl.tune(arm, "pdd"), armctl.UnknownNameError),
        (lambda arm: armctl.tune(arm, "computed-torque-textbook"), armctl.UnknownNameError),
        (lambda arm: armctl.tune(arm, "pd", peak_sensitivity=0.5), armctl.InputError),
        (lambda arm: armctl.tune(arm, "pd", plants=PLANT), armctl.InputError),
        (lambda arm: armctl.tune(arm, "pd", plants=[PLANT, armctl.Plant(timestep=0.001)]), armctl.InputError),
    ],
)
def test_a_wrong_call_is_an_error(arm, call, error):
    with pytest.raises(error):
        call(arm)
