"""Compares what a command prints with its committed output under docs/outputs.

Words must be equal, numbers nearly. Clock times and what follows from them belong to a machine and are left out. Numbers may
differ by 2 % or by two units of their last printed digit: rounding of another processor or compiler decides which of two equal
configurations a search keeps. What is smaller than 1e-9 in its unit is rounding.
"""

import re

_CLOCK = re.compile(r"\S+ times real time|real-time factor \S+|(?<=solved in )\S+ s|\S+ s of CPU time")
_NUMBER = re.compile(r"<?(?<![\w.])-?\d+(?:\.\d*)?(?:e[+-]?\d+)?")
_RULES = re.compile(r"[-=]{2,}")  # below the heads of tables, as wide as their columns
_OF_MJX = re.compile(r"Failed to import \w*warp: .*\n")  # which MJX prints where its other backend is not installed
_SHARE = 0.02
_DIGITS = 2.0
_ROUNDING = 1e-9


def difference(committed: str, printed: str, *, numbers: bool = True) -> str:
    """The first difference of two outputs; empty if they agree.

    Args:
        committed: The output in the repository.
        printed: What the command prints now.
        numbers: Whether numbers must agree, too.

    Returns:
        Both lines, or an empty text.
    """
    old = _lines(committed)
    new = _lines(printed)
    for before, after in zip(old, new, strict=False):
        if not _agree(before, after, numbers):
            return f"committed: {before}\nprinted:   {after}"
    return "" if len(old) == len(new) else f"committed: {len(old)} lines\nprinted:   {len(new)} lines"


def own_words(text: str) -> str:
    """What a command of armctl prints, without folders of the machine and what another package prints."""
    return re.sub(r"/\S+/", "", _OF_MJX.sub("", text))


def _lines(text: str) -> list[str]:
    return [" ".join(_RULES.sub("-", _CLOCK.sub("", line)).split()) for line in own_words(text).splitlines()]


def _agree(a: str, b: str, numbers: bool) -> bool:
    words = [" ".join(_NUMBER.sub("#", line).replace("[ ", "[").split()) for line in (a, b)]
    pairs = zip(_NUMBER.findall(a), _NUMBER.findall(b), strict=False)
    return words[0] == words[1] and (not numbers or all(_close(*pair) for pair in pairs))


def _close(a: str, b: str) -> bool:
    values = [abs(float(each.removeprefix("<"))) if each.startswith("<") else float(each) for each in (a, b)]
    if max(map(abs, values)) < _ROUNDING:
        return True
    unit = max(_last_digit(a), _last_digit(b))
    return abs(values[0] - values[1]) <= max(_SHARE * max(map(abs, values)), (_DIGITS + 1e-6) * unit)


def _last_digit(number: str) -> float:
    mantissa, _, exponent = number.partition("e")
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
