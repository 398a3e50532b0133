"""What an episode draws: numbers within their ranges, and whole numbers with equal probability."""

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="pip install -e '.[envs]'")

import armctl
from armctl.envs.randomization import Randomization

DRAWS = 3000


def test_each_whole_number_of_a_range_is_drawn_as_often_as_the_others():
    found = Randomization.read({"delay": armctl.Range(1, 3)}, has_object=False)
    rng = np.random.default_rng(0)
    delays = [found.draw_plant(rng).delay for _ in range(DRAWS)]
    assert set(delays) == {1, 2, 3}
    assert np.bincount(delays)[1:] / DRAWS == pytest.approx([1 / 3] * 3, abs=0.03)
    assert found.max_delay == 3


def test_other_numbers_are_even_over_their_range():
    found = Randomization.read({"payload": armctl.Range(0.5, 2.0)}, has_object=False)
    rng = np.random.default_rng(0)
    payloads = np.array([found.draw_plant(rng).payload for _ in range(DRAWS)])
    assert payloads.min() >= 0.5
    assert payloads.max() <= 2.0
    assert np.histogram(payloads, 3, (0.5, 2.0))[0] / DRAWS == pytest.approx([1 / 3] * 3, abs=0.03)
    assert found.max_delay == 0
