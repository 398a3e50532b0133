"""Checks of arguments: what is converted, what is rejected, and how long a message may be."""

from fractions import Fraction

import numpy as np
import pytest

import armctl
from armctl import InputError
from armctl.core.errors import MAX_MESSAGE_CHARACTERS
from armctl.core.validation import array, choice, instance, integer, number, shown, vector


class Hostile:
    """Raises whenever it is looked at."""

    def __repr__(self):
        raise RuntimeError("no repr")

    def __float__(self):
        raise RuntimeError("no float")

    def __array__(self, *args, **kwargs):
        raise RuntimeError("no array")


@pytest.mark.parametrize("value", [3, 3.0, np.float32(3), np.int8(3), np.array(3.0), Fraction(3)])
def test_a_number_is_returned_as_a_float(value):
    assert type(number("x", value)) is float
    assert number("x", value, 3, 3) == 3.0


@pytest.mark.parametrize("value", ["3", b"3", True, np.True_, None, [3.0], 3 + 0j, np.complex64(3), np.array([3.0]), Hostile()])
def test_what_is_no_number_is_rejected_even_if_python_would_convert_it(value):
    with pytest.raises(InputError, match=r"^x: .* is not a number$"):
        number("x", value)
    with pytest.raises(InputError, match=r"^x: .* is not a number$"):
        integer("x", value)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_number_must_be_finite(value):
    with pytest.raises(InputError, match="expected a finite number"):
        number("x", value)


def test_a_number_keeps_its_bounds():
    with pytest.raises(InputError, match=r"^x: expected a number at least 0, got -1$"):
        number("x", -1, 0.0)
    with pytest.raises(InputError, match=r"^x: expected a number in \[0, 1\], got 2$"):
        number("x", 2, 0.0, 1.0)
    with pytest.raises(InputError, match=r"^x: expected a number at most 1, got 2$"):
        number("x", 2, high=1.0)


def test_a_whole_number_is_returned_as_an_int():
    assert integer("x", 3.0) == 3
    assert type(integer("x", 3.0)) is int
    assert integer("x", 2**60 + 1) == 2**60 + 1
    with pytest.raises(InputError, match=r"^x: expected a whole number at least 0, got 1.5$"):
        integer("x", 1.5, 0)


@pytest.mark.parametrize(
    "value",
    ["12", ["1", "2"], [True, False], [1j, 2], [None, 1.0], [[1.0], [2.0, 3.0]], Hostile(), [10**400], np.array(["1"], object)],
)
def test_what_is_no_array_of_numbers_is_rejected_even_if_numpy_would_convert_it(value):
    with pytest.raises(InputError, match=r"^x: .* is not an array of numbers$"):
        array("x", value, 1)


def test_an_array_is_copied_and_read_only():
    given = np.array([1, 2])
    out = vector("x", given, 2)
    given[0] = 5
    assert out.tolist() == [1.0, 2.0]
    assert out.dtype == np.float64
    assert not out.flags.writeable
    assert vector("x", [Fraction(1, 2), 2]).tolist() == [0.5, 2.0]


@pytest.mark.parametrize("value", ["x" * 5000, list(range(5000)), np.full((50, 50), "abc"), {"a": "b" * 5000}])
def test_a_message_shows_a_long_value_in_one_short_line(value):
    for check in (array, number):
        arguments = ("name", value, 1) if check is array else ("name", value)
        if check is array and isinstance(value, list):
            continue
        with pytest.raises(InputError) as error:
            check(*arguments)
        assert len(str(error.value)) < 130
        assert "\n" not in str(error.value)
    with pytest.raises(InputError) as error:
        instance("name", value, armctl.Arm, "armctl.load returns one")
    assert len(str(error.value)) < 160
    assert len(shown(value)) <= 80


def test_a_message_of_any_error_has_one_line_and_at_most_400_characters():
    for kind in (armctl.ArmctlError, InputError, armctl.ModelError, armctl.PlanError, armctl.SimulationError):
        text = str(kind(f"mesh {'m' * 5000}:\nnot found; name another file"))
        assert len(text) <= MAX_MESSAGE_CHARACTERS == 400
        assert text.startswith("mesh mmm")
        assert text.endswith("name another file")
        assert "\n" not in text
    assert str(InputError("short")) == "short"
    assert len(str(armctl.UnknownNameError.from_known("robot", "r" * 5000, ["panda"]))) < 200


def test_a_choice_is_one_of_its_words():
    assert choice("quality", "fast", ("fast", "full")) == "fast"
    for wrong in ("best", 3, ["fast"], None):
        with pytest.raises(InputError, match=r"^quality: expected one of fast, full, got .*$"):
            choice("quality", wrong, ("fast", "full"))
