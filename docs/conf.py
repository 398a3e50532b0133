"""How Sphinx builds the pages; the reference is written here, from the public names."""

import inspect
import re
from importlib import import_module
from pathlib import Path

import armctl

project = "armctl"
author = "the armctl authors"
version = release = armctl.__version__

extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "myst_parser"]
exclude_patterns = ["_build"]
default_role = "code"
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3

autoclass_content = "both"
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_type_aliases = {name: name for name in ("Array", "ArrayLike", "BoolArray", "IntArray", "TextArray")}
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = "armctl"
html_show_copyright = False

CHAPTERS = {
    "core": "Values: poses, limits, setpoints, logs, errors",
    "robot": "The arm",
    "loading": "Loading robots",
    "ik": "Inverse kinematics",
    "motion": "Motion",
    "control": "Control",
    "sim": "Simulation",
    "render": "Pictures and films",
    "design": "Identification",
    "analysis": "Reports, plots, comparisons",
}


def reference() -> str:
    """The reference: every public name, by the subpackage it is in."""
    subpackage_of = {name: getattr(armctl, name).__module__.split(".")[1] for name in armctl.__all__ if name != "__version__"}
    without_chapter = set(subpackage_of.values()) - set(CHAPTERS)
    if without_chapter:
        raise ValueError(f"CHAPTERS: give {', '.join(sorted(without_chapter))} a chapter")
    lines = ["# Reference", "", "Every public name; each is `armctl.NAME`.", ""]
    for subpackage, title in CHAPTERS.items():
        introduction = (import_module(f"armctl.{subpackage}").__doc__ or "").split("\n")[0]
        lines += [f"## {title}", "", introduction, ""]
        for name, home in subpackage_of.items():
            if home == subpackage:
                lines += ["```{eval-rst}", *directive(name), "```", ""]
    return "\n".join(lines)


def directive(name: str) -> list[str]:
    """What documents one public name."""
    value = getattr(armctl, name)
    if not inspect.isclass(value):
        return [f".. autofunction:: armctl.{name}"]
    if issubclass(value, Exception):
        return [f".. autoclass:: armctl.{name}", "   :members:", "   :show-inheritance:"]
    return [f".. autoclass:: armctl.{name}", "   :members:", "   :inherited-members: tuple, object"]


def leave_out(app, what, name, obj, skip, options):
    """The fields of a NamedTuple are listed by its docstring; Python's own words for them say nothing."""
    return True if type(obj).__name__ == "_tuplegetter" else None


def plain_aliases(app, what, name, obj, options, signature, returns):
    """A type's alias by its own name."""
    return tuple(part and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", part) for part in (signature, returns))


def own_words(app, what, name, obj, options, lines):
    """Without what Python says of every NamedTuple."""
    lines[:] = [line for line in lines if not line.startswith("Create new instance of")]


def setup(app):
    (Path(__file__).parent / "reference.md").write_text(reference(), encoding="utf-8")
    app.connect("autodoc-skip-member", leave_out)
    app.connect("autodoc-process-signature", plain_aliases)
    app.connect("autodoc-process-docstring", own_words)
