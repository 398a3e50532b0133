"""Damaged models: each is refused with a `ModelError` or an `InputError`, or gives an arm that works."""

import re
import signal
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from synthetic import FIRST, SECOND, THIRD, TOOL, limb, mjcf, motors, urdf

import armctl

MODELS_IN_SUITE = 200
MAX_MESSAGE_CHARACTERS = 400
MAX_LOAD_S = 60

SOURCES = {
    ".xml": [
        mjcf(limb("a b c", '<site name="tip" pos="0 0 0.1"/>'), motors("a b c")),
        mjcf(limb("a b c", joint='damping="0.5" armature="0.01"'), motors("a b c", c='<position joint="c" kp="50"/>')),
    ],
    ".urdf": [urdf(FIRST, SECOND, THIRD, TOOL)],
}
NUMBERS = ["0", "-1", "nan", "inf", "-inf", "1e308", "1e-320", "1e21", "", "x", "1 2", "0x10", "1,5", "9" * 400]
TEXTS = ["", "a", "a b", "../../x", "&amp;", "\u00e9", "a" * 5000, "0", "true", "none"]


def damaged(text: str, rng: np.random.Generator) -> str:
    """The text of a model after one to three changes."""
    for _ in range(rng.integers(1, 4)):
        text = CHANGES[rng.integers(len(CHANGES))](text, rng)
    return text


def any_match(pattern: str, text: str, rng: np.random.Generator) -> re.Match[str] | None:
    found = list(re.finditer(pattern, text))
    return found[rng.integers(len(found))] if found else None


def replaced(text: str, match: re.Match[str] | None, new: str, group: int = 0) -> str:
    return text if match is None else text[: match.start(group)] + new + text[match.end(group) :]


def change_number(text: str, rng: np.random.Generator) -> str:
    return replaced(text, any_match(r"(?<=[ \"])-?\d+\.?\d*(?=[ \"])", text, rng), NUMBERS[rng.integers(len(NUMBERS))])


def change_value(text: str, rng: np.random.Generator) -> str:
    return replaced(text, any_match(r'="([^"]*)"', text, rng), TEXTS[rng.integers(len(TEXTS))], 1)


def delete_attribute(text: str, rng: np.random.Generator) -> str:
    return replaced(text, any_match(r' \w+="[^"]*"', text, rng), "")


def rename_attribute(text: str, rng: np.random.Generator) -> str:
    return replaced(text, any_match(r' (\w+)="', text, rng), "mass", 1)


def delete_element(text: str, rng: np.random.Generator) -> str:
    return replaced(text, any_match(r"<[^<>]*/>", text, rng), "")


def repeat_element(text: str, rng: np.random.Generator) -> str:
    match = any_match(r"<[^<>]*/>", text, rng)
    return text if match is None else replaced(text, match, 2 * match[0])


def delete_tag(text: str, rng: np.random.Generator) -> str:
    return replaced(text, any_match(r"<[^<>]*>", text, rng), "")


def cut(text: str, rng: np.random.Generator) -> str:
    return text[: rng.integers(len(text) + 1)]


def insert_characters(text: str, rng: np.random.Generator) -> str:
    place = int(rng.integers(len(text) + 1))
    return text[:place] + ["<", ">", '"', "\x00", "&x;", "<!--", "]]>", "\u2028", "<a>"][rng.integers(9)] + text[place:]


CHANGES = [
    change_number,
    change_number,
    change_number,
    change_value,
    delete_attribute,
    rename_attribute,
    delete_element,
    repeat_element,
    delete_tag,
    cut,
    insert_characters,
]


def assert_works(arm: armctl.Arm) -> None:
    """An arm that was loaded has a finite tip, finite limits where needed, and holds its home position."""
    assert np.isfinite(arm.fk(arm.home).position).all()
    assert np.isfinite(arm.limits.v_max).all()
    log = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, arm.home, arm.home))
    assert np.isfinite(log.q).all()


def fault_of(path: Path) -> str:
    """What is wrong with how a model is loaded and used, "" if nothing is."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert_works(armctl.load(path))
    except armctl.ArmctlError as error:
        if len(str(error)) > MAX_MESSAGE_CHARACTERS:
            return f"a message of {len(str(error))} characters: {error!s:.100}"
    except Exception as error:
        return f"{type(error).__name__}: {error!s:.200}"
    return ""


@pytest.fixture
def load_limit() -> Iterator[None]:
    """SIGALRM ends a load that takes longer than MAX_LOAD_S with an error; the timer is set anew for each model."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"longer than {MAX_LOAD_S} s")

    before = signal.signal(signal.SIGALRM, stop)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures("load_limit")
@pytest.mark.parametrize("ending", SOURCES)
def test_a_damaged_model_is_refused_or_gives_an_arm_that_works(
    ending: str, fuzz_cases: Callable[[int], Iterator[np.random.Generator]], tmp_path: Path
):
    faults: dict[str, str] = {}
    for case, rng in enumerate(fuzz_cases(MODELS_IN_SUITE)):
        text = damaged(SOURCES[ending][case % len(SOURCES[ending])], rng)
        path = tmp_path / f"model{ending}"
        path.write_bytes(text.encode("utf-8"))
        signal.setitimer(signal.ITIMER_REAL, MAX_LOAD_S)
        fault = fault_of(path)
        if fault:
            faults.setdefault(fault, text)
    assert not faults, "\n".join(f"{fault}\n    {text}" for fault, text in faults.items())


@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
@pytest.mark.parametrize(("ending", "text"), [(ending, text) for ending, texts in SOURCES.items() for text in texts])
def test_the_undamaged_models_work(ending: str, text: str, tmp_path: Path):
    path = tmp_path / f"model{ending}"
    path.write_text(text, encoding="utf-8")
    assert_works(armctl.load(path))
