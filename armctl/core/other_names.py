"""Hints for names that other libraries use: what armctl calls the same thing."""

import inspect
from collections.abc import Callable, Mapping
from typing import Any

# Keyword arguments by the names that textbooks and other libraries give them.
_KEYWORDS = {
    "kp": "stiffness",
    "p": "stiffness",
    "kd": "damping",
    "d": "damping",
    "ki": "integral_gain",
    "zeta": "damping_ratio",
    "omega": "bandwidth",
    "wn": "bandwidth",
    "load": "payload",
    "mass": "payload",
    "friction": "coulomb_friction",
    "dt": "timestep",
    "noise": "encoder_noise",
    "latency": "delay",
}


def with_hints(hints: Mapping[str, str]) -> Callable[[object, str], Any]:
    """The `__getattr__` of a class: its AttributeError says what to write instead of another library's name."""

    def get_missing(self: object, name: str) -> Any:
        hint = f"; use {hints[name]}" if name in hints else ""
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}{hint}", name=name, obj=self)

    return get_missing


def check_keywords(cls: type, keywords: Mapping[str, object]) -> None:
    """Raises a TypeError if a class takes no argument of such a name; the message says which names it takes."""
    if not keywords:
        return
    parameters = inspect.signature(cls.__init__).parameters
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
        return
    known = [name for name in parameters if name != "self"]
    for name in keywords:
        if name not in known:
            other = _KEYWORDS.get(name.lower(), "")
            hint = f"did you mean {other!r}?" if other in known else f"it takes {', '.join(known)}"
            raise TypeError(f"{cls.__name__} takes no argument {name!r}; {hint}")
