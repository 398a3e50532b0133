"""Names from the package robot_descriptions, which downloads a robot on first use; armctl imports it for such names only."""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
import re
from pathlib import Path

from armctl.core.errors import ModelError, UnknownNameError

_PACKAGE = "robot_descriptions"
_NAME = re.compile(r"\w+_description")
_PATHS = ("MJCF_PATH", "URDF_PATH", "XACRO_PATH")  # an MJCF says most


def is_description_name(name: str) -> bool:
    """Whether a name has the form that names of robot_descriptions have, such as "panda_mj_description"."""
    return _NAME.fullmatch(name) is not None


def description_file(name: str) -> Path:
    """The file of a robot by its name in robot_descriptions; downloaded on first use."""
    package = importlib.util.find_spec(_PACKAGE)
    if package is None:
        raise ModelError(
            f"{name:.80}: a name of the package robot_descriptions, which is not installed: `pip install {_PACKAGE}`"
        )
    known = [
        module.name for module in pkgutil.iter_modules(package.submodule_search_locations) if is_description_name(module.name)
    ]
    if name not in known:
        raise UnknownNameError.of("robot of robot_descriptions", name, known)
    try:
        module = importlib.import_module(f"{_PACKAGE}.{name}")
    except Exception as error:  # importing it clones a repository, which can fail in any way
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ModelError(f"{name}: robot_descriptions cannot provide it: {reason:.200}") from None
    found = [getattr(module, path) for path in _PATHS if hasattr(module, path)]
    if not found:
        raise ModelError(f"{name}: robot_descriptions has neither an MJCF nor a URDF of it")
    path = Path(found[0])
    if not path.is_file():
        raise ModelError(f"{name}: robot_descriptions says that its file is {path}, which does not exist")
    return path
