"""The points of a study follow from its factors: grids, distributions, and designs of known properties."""

import numpy as np
import pytest

import armctl
from armctl.lab.study.factors import design_points, factor_table, read_factor


def points(samples=64, sampling="sobol", seed=0, **factors):
    return design_points({name: read_factor(name, value) for name, value in factors.items()}, samples, sampling, seed)


def test_lists_give_every_combination_at_every_sample():
    found = points(4, delay=[0, 2], payload=armctl.Range(0, 1), friction=0.01)
    assert len(found) == 8
    assert {each["friction"] for each in found} == {0.01}
    by_payload = {}
    for each in found:
        by_payload.setdefault(each["payload"], set()).add(each["delay"])
    assert list(by_payload.values()) == [{0, 2}] * 4


def test_more_samples_of_a_sobol_sequence_keep_the_first_ones():
    assert points(64, payload=armctl.Range(0, 1), friction=armctl.Range(0, 0.1))[:16] == points(
        16, payload=armctl.Range(0, 1), friction=armctl.Range(0, 0.1)
    )


@pytest.mark.parametrize("sampling", ["sobol", "lhs"])
def test_each_sixteenth_of_a_range_is_sampled_once(sampling):
    values = np.array([each["payload"] for each in points(16, sampling, payload=armctl.Range(2, 4), noise=armctl.Range(0, 1))])
    assert sorted((8 * (values - 2)).astype(int).tolist()) == list(range(16))


def test_the_distributions_are_what_they_say():
    found = points(
        1024,
        payload=armctl.Normal(1.0, 0.2, low=0.5),
        friction=armctl.Range(1e-4, 1e-1, log=True),
        delay=armctl.Range(0, 3),
        continuous=armctl.Choice([False, True]),
    )
    payload = np.array([each["payload"] for each in found])
    assert payload.min() >= 0.5
    assert np.median(payload) == pytest.approx(1.0, abs=0.01)
    assert np.quantile(payload, 0.8413) == pytest.approx(1.2, abs=0.01)
    assert np.median([each["friction"] for each in found]) == pytest.approx(10**-2.5, rel=0.05)
    assert {type(each["delay"]) for each in found} == {int}
    assert np.bincount([each["delay"] for each in found]) == pytest.approx(256, abs=3)
    assert sum(each["continuous"] for each in found) == pytest.approx(512, abs=3)


def test_saltelli_points_are_two_matrices_and_their_mixtures():
    a, b, first, second = np.split(
        np.array([list(each.values()) for each in points(8, "saltelli", payload=armctl.Range(0, 1), noise=armctl.Range(0, 1))]),
        4,
    )
    assert (first == np.column_stack([b[:, 0], a[:, 1]])).all()
    assert (second == np.column_stack([a[:, 0], b[:, 1]])).all()


@pytest.mark.parametrize(
    "factor",
    [armctl.Range(1, 2, log=True), armctl.Normal(0.0, 1.0), armctl.Normal(0.0, 1.0, low=-1.0), armctl.Choice([1, True])],
)
def test_a_factor_is_the_same_after_plain_data(factor):
    assert read_factor("payload", factor_table(factor)) == factor


WRONG = {
    "no power of two": (
        lambda: points(100, payload=armctl.Range(0, 1)),
        "samples: expected a power of 2 such as 128, got 100",
    ),
    "reversed": (lambda: armctl.Range(2, 1), "high: expected a number above low = 2, got 1"),
    "log of nothing": (lambda: armctl.Range(0, 1, log=True), "low: expected a number above 0"),
    "mean outside": (lambda: armctl.Normal(0, 1, low=1), "mean: expected .*got 0"),
    "no values": (lambda: armctl.Choice([]), "values: no values given"),
    "half a delay": (lambda: points(4, delay=armctl.Range(0.5, 2)), "delay: low: expected a whole number"),
    "an unknown table": (lambda: points(payload={"from": 0, "to": 1}), "factors: payload: expected .*got"),
    "a list for sobol indices": (
        lambda: points(4, "saltelli", payload=armctl.Range(0, 1), delay=[0, 1]),
        "'saltelli' needs two",
    ),
    "too many": (lambda: points(2**20, payload=armctl.Range(0, 1), delay=list(range(100))), "more than 10000000 points"),
}


@pytest.mark.parametrize(("call", "reason"), WRONG.values(), ids=WRONG)
def test_a_wrong_factor_is_one_sentence(call, reason: str):
    with pytest.raises(armctl.InputError, match=reason):
        call()
