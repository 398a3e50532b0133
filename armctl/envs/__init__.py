"""Gymnasium environments: any arm, armctl's controllers as action spaces, many arms at once in the compiled loop.

Gymnasium knows them when this package is imported, also by the name: `gymnasium.make("armctl.envs:armctl/Reach-v0")`.
Its names are not names of `armctl`, which works without gymnasium. `armctl.jax` is below it, and needs JAX instead.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

import lazy_loader

from armctl.core.errors import NotInstalledError

_public, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
_HAS_GYMNASIUM = find_spec("gymnasium") is not None


def __getattr__(name: str) -> Any:
    if name == "jax":
        return import_module("armctl.envs.jax")
    if name in __all__ and not _HAS_GYMNASIUM:
        raise NotInstalledError.from_extra("environments need gymnasium", "envs")
    return _public(name)


if _HAS_GYMNASIUM:
    from armctl.envs.tasks import register

    register()
