"""How objects show themselves at a prompt, and signatures with the names of all arguments."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Mapping
from types import FunctionType
from typing import Any, TypeVar

import numpy as np

_MAX_NUMBERS = 8  # of an array that is shown in full
_MAX_CHARACTERS = 120  # of any other value

_Class = TypeVar("_Class")
_Function = TypeVar("_Function", bound=Callable[..., Any])


def value_text(value: object) -> str:
    """A value in a few characters: numbers in four digits, an array of equal numbers as one."""
    if isinstance(value, (bool, np.bool_, str)) or value is None:
        return repr(value)
    if isinstance(value, (int, float, np.number)):
        return f"{value:.4g}"
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        if value.size and (value == value.flat[0]).all():
            return f"{value.flat[0]:.4g}"
        if value.ndim == 1 and value.size <= _MAX_NUMBERS:
            return f"[{', '.join(f'{x:.4g}' for x in value)}]"
        return f"array of {' x '.join(map(str, value.shape))}"
    if inspect.isroutine(value) or type(value).__repr__ is object.__repr__:
        return str(getattr(value, "__name__", type(value).__name__))
    text = " ".join(repr(value).split())
    return text if len(text) <= _MAX_CHARACTERS else f"{text[: _MAX_CHARACTERS - 3]}..."


def face(thing: object, *values: str, **named: object) -> str:
    """The repr of an object in one line: its class, words, and named values."""
    return f"{type(thing).__name__}({', '.join([*values, *(f'{name}={value_text(each)}' for name, each in named.items())])})"


def gains_of(controller: object) -> dict[str, object]:
    """The arguments of a controller's constructor that it keeps as attributes of the same names, without what is None."""
    gains: dict[str, object] = {}
    for name in inspect.signature(type(controller).__init__).parameters:
        is_property = isinstance(getattr(type(controller), name, None), property)
        value = getattr(controller, name) if is_property else vars(controller).get(name)
        if value is not None:
            gains[name] = value
    return gains


def show_arguments(cls: type) -> None:
    """Lets `inspect.signature` of a class show the arguments of its constructor, where `__new__` hides them."""
    signature = inspect.signature(cls.__init__)
    arguments = list(signature.parameters.values())[1:]
    cls.__signature__ = signature.replace(parameters=arguments)  # type: ignore[attr-defined]


def with_options(options: type, defaults: Mapping[str, object]) -> Callable[[_Function], _Function]:
    """Decorates a function whose last argument is `**options`: `inspect.signature` then shows each of them.

    Args:
        options: The TypedDict of the options.
        defaults: The value of each that is left out.
    """

    def decorated(function: _Function) -> _Function:
        signature = inspect.signature(function)
        named = [each for each in signature.parameters.values() if each.kind is not each.VAR_KEYWORD]
        shown = [*named, *_keywords(options, defaults)]
        function.__signature__ = signature.replace(parameters=shown)  # type: ignore[attr-defined]
        return function

    return decorated


def named_after_itself(cls: type[_Class]) -> type[_Class]:
    """Decorates a public class: the methods that it inherits bear its name in the errors of wrong calls."""
    for base in cls.__mro__[1:-1]:
        for name, method in vars(base).items():
            if inspect.isfunction(method) and not name.startswith("_") and getattr(cls, name) is method:
                own = FunctionType(
                    method.__code__, method.__globals__, method.__name__, method.__defaults__, method.__closure__
                )
                functools.update_wrapper(own, method)
                del own.__wrapped__  # type: ignore[attr-defined]
                own.__kwdefaults__ = method.__kwdefaults__
                own.__qualname__ = f"{cls.__qualname__}.{name}"
                setattr(cls, name, own)
    return cls


def _keywords(options: type, defaults: Mapping[str, object]) -> Iterable[inspect.Parameter]:
    annotations = {name: text for base in reversed(options.__mro__) for name, text in _annotations(base).items()}
    for name, default in defaults.items():
        annotation = annotations.get(name, inspect.Parameter.empty)
        yield inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _annotations(base: type) -> dict[str, Any]:
    found = vars(base).get("__annotations__", {})
    return {name: getattr(each, "__forward_arg__", each) for name, each in found.items()}
