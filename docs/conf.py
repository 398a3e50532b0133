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
    "armctl.loading.load": "Robots by name",
    "armctl.loading.chain": "Chains",
    "armctl.loading.scene": "Scenes",
    "armctl.robot.arm": "The arm",
    "armctl.core.pose": "Poses",
    "armctl.core.trajectory": "Limits, setpoints, trajectories",
    "armctl.ik": "Inverse kinematics",
    "armctl.motion": "Motion",
    "armctl.control": "Control",
    "armctl.sim.plant": "The plant",
    "armctl.sim.simulation": "Simulation",
    "armctl.sim.gripper": "Grippers",
    "armctl.sim.multi_arm": "Teams",
    "armctl.core.log": "The log",
    "armctl.analysis.report": "Reports",
    "armctl.analysis.comparison": "Comparison",
    "armctl.core.errors": "Errors",
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
            value, options = getattr(armctl, name), []
            if inspect.isclass(value):
                options = ["   :members:"] + ["   :show-inheritance:"] * issubclass(value, Exception)
            kind = "autoclass" if inspect.isclass(value) else "autofunction"
            lines += ["```{eval-rst}", f".. {kind}:: armctl.{name}", *options, "```", ""]
    return "\n".join(lines)


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
