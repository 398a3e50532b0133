"""How Sphinx builds the pages; the reference is written here, from the public names."""

import inspect
from importlib import import_module
from pathlib import Path

import armctl

project = "armctl"
author = "the armctl authors"
version = release = armctl.__version__

extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "myst_parser"]
exclude_patterns = ["_build"]
default_role = "code"
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_type_aliases = {name: name for name in ("Array", "ArrayLike", "BoolArray", "IntArray")}
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = "armctl"
html_show_copyright = False

CHAPTERS = {
    "armctl.robots": "Robots by name",
    "armctl.arm": "The arm",
    "armctl.pose": "Poses",
    "armctl.trajectory": "Limits, setpoints, trajectories",
    "armctl.ik": "Inverse kinematics",
    "armctl.motion": "Motion",
    "armctl.control": "Control",
    "armctl.plant": "The plant",
    "armctl.simulation": "Simulation",
    "armctl.log": "The log",
    "armctl.report": "Reports",
    "armctl.comparison": "Comparison",
    "armctl.errors": "Errors",
}


def reference() -> str:
    """The reference: every public name, by the module it is in; modules without a chapter of their own come last."""
    modules = {module: [name for name in armctl.__all__ if armctl._MODULES[name] == module] for module in CHAPTERS}
    for name, module in armctl._MODULES.items():
        if module not in CHAPTERS:
            modules.setdefault(module, []).append(name)
    lines = ["# Reference", "", "Every public name; each is `armctl.NAME`.", ""]
    for module, names in modules.items():
        lines += [f"## {CHAPTERS.get(module, module)}", "", (import_module(module).__doc__ or "").split("\n")[0], ""]
        for name in names:
            is_class = inspect.isclass(getattr(armctl, name))
            members = ["   :members:", "   :show-inheritance:"] if is_class else []
            kind = "autoclass" if is_class else "autofunction"
            lines += ["```{eval-rst}", f".. {kind}:: armctl.{name}", *members, "```", ""]
    return "\n".join(lines)


def leave_out(app, what, name, obj, skip, options):
    """The fields of a NamedTuple are listed by its docstring; Python's own words for them say nothing."""
    return True if type(obj).__name__ == "_tuplegetter" else None


def setup(app):
    (Path(__file__).parent / "reference.md").write_text(reference(), encoding="utf-8")
    app.connect("autodoc-skip-member", leave_out)
