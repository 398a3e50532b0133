"""How Sphinx builds the pages; the reference is written here, from the public names."""

import inspect
import re
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from sphinx.util import logging

import armctl
import armctl.envs

project = "armctl"
author = "the armctl authors"
version = release = armctl.__version__

extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "myst_parser", "sphinx_copybutton"]
exclude_patterns = ["_build"]
default_role = "code"
highlight_language = "text"  # what programs print is no code
copybutton_selector = "div.highlight:not(.highlight-text *) > pre"  # of code, not of what programs print
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3

autoclass_content = "both"
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_type_aliases = {name: name for name in ("Array", "ArrayLike", "BoolArray", "IntArray", "TextArray")}
# Defaults as values: the signatures of functions with options have more arguments than their source.
autodoc_preserve_defaults = False
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = f"armctl {version}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_extra_path = ["../llms.txt"]  # for coding assistants: tasks, and the call for each
html_show_copyright = False


class Chapter(NamedTuple):
    """A page of the reference."""

    title: str
    question: str  # that its names answer


# One chapter per package that has public names, in the order of the rooms.
CHAPTERS = {
    "core": Chapter("Values: poses, limits, setpoints, logs, errors", "In which values do I think?"),
    "model.mjmodel": Chapter("MuJoCo models", "How do I write a robot in MJCF?"),
    "model.arm": Chapter("The arm", "Where is the arm, and what does it weigh?"),
    "model.collision": Chapter("Collisions and clearance", "What touches, and how near does it come?"),
    "model.loading": Chapter("Loading robots", "How do I get a robot?"),
    "control": Chapter("Control", "Which torque follows the motion?"),
    "plan.ik": Chapter("Inverse kinematics", "Which joint positions reach a pose?"),
    "plan.motion": Chapter("Motion", "How do I get there within all limits?"),
    "plan.planner": Chapter("Collision-free motion", "How do I get there without a contact?"),
    "plan.stream": Chapter("Streams of targets", "How do I follow targets that keep coming?"),
    "run.execution": Chapter("Commands", "How do I command an arm?"),
    "run.sim": Chapter("Simulation", "How do I try it without a robot?"),
    "run.links": Chapter("Robots", "How do I command a real arm?"),
    "run.agent": Chapter("Language models", "How does a language model move an arm?"),
    "run": Chapter("Robots of other libraries", "How does another library use armctl?"),
    "report.render": Chapter("Pictures and videos", "How do I show it?"),
    "report": Chapter("Reports and plots", "How well did it follow?"),
    "lab.loops": Chapter("Margins and tuning", "How robust is the loop, and which gains are right?"),
    "lab.identification": Chapter("Identification", "Which masses, friction and delays has the arm?"),
    "lab.study": Chapter("Studies", "What happens over many payloads, delays and controllers?"),
    "lab": Chapter("Comparisons and checks", "Which controller is better, and what is wrong?"),
    "view": Chapter("The viewer", "How do I see and drag it?"),
    "envs": Chapter("Reinforcement learning", "How do I train a policy?"),
    "envs.jax": Chapter("Pure functions for JAX", "How do I differentiate and batch it?"),
}
MODULES = {"links": armctl.links, "envs": armctl.envs, "jax": armctl.jax}  # with public names of their own


def public_names() -> list[str]:
    """All public names, those of modules with the name of the module."""
    names = [name for name in armctl.__all__ if name not in {"__version__", *MODULES}]
    return names + [f"{module}.{name}" for module, value in MODULES.items() for name in value.__all__]


def chapter_of(name: str) -> str:
    """The package of a public name that has a chapter."""
    module = attrgetter(name)(armctl).__module__.removeprefix("armctl.")
    if module == "_core":
        return "control"  # the core's public class is a law
    while module not in CHAPTERS:
        module = module.rpartition(".")[0]
    return module


def reference() -> dict[str, str]:
    """The pages of the reference by their file names: a list of all public names, and one page for each chapter."""
    names: dict[str, list[str]] = {package: [] for package in CHAPTERS}
    for name in public_names():
        names[chapter_of(name)].append(name)
    chapters = [package for package in CHAPTERS if names[package]]
    toctree = ["```{toctree}", ":hidden:", "", *(f"reference/{package}" for package in chapters), "```", ""]
    index = [
        "# Reference",
        "",
        "Every public name, by the question that it answers; each is `armctl.NAME`.",
        "",
        *toctree,
    ]
    pages: dict[str, str] = {}
    for package in chapters:
        title, question = CHAPTERS[package]
        lines_of_names = [f"- {{py:obj}}`{name} <armctl.{name}>`: {summary(name)}" for name in names[package]]
        index += [f"## {question}", "", f"[{title}](reference/{package}.md)", "", *lines_of_names, ""]
        introduction = (import_module(f"armctl.{package}").__doc__ or "").split("\n")[0]
        lines = [f"# {title}", "", introduction, ""]
        for name in names[package]:
            lines += [f"## {name}", "", "```{eval-rst}", *directive(name), "```", ""]
        pages[f"reference/{package}.md"] = "\n".join(lines)
    pages["reference.md"] = "\n".join(index)
    return pages


def summary(name: str) -> str:
    """The first sentence of a name's docstring; of an instance, that of its class."""
    text = inspect.getdoc(attrgetter(name)(armctl)) or ""
    first = " ".join(text.split("\n\n")[0].split())
    return re.split(r"(?<=[.]) (?=[A-Z])", first)[0]


def directive(name: str) -> list[str]:
    """The Sphinx directive that documents one public name."""
    value = attrgetter(name)(armctl)
    if not callable(value):
        return [f".. autodata:: armctl.{name}", "   :no-value:"]
    if not inspect.isclass(value):
        return [f".. autofunction:: armctl.{name}"]
    if issubclass(value, Exception):
        return [f".. autoclass:: armctl.{name}", "   :members:", "   :show-inheritance:"]
    return [f".. autoclass:: armctl.{name}", "   :members:", "   :inherited-members: tuple, dict, object"]


def skip_fields_of_named_tuples(app, what, name, obj, skip, options):
    """The docstring of a NamedTuple lists its fields; Python's generated docstrings add nothing."""
    return True if type(obj).__name__ == "_tuplegetter" else None


def plain_aliases(app, what, name, obj, options, signature, returns):
    """Type aliases by their own names."""
    return tuple(part and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", part) for part in (signature, returns))


def without_generated_docstring(app, what, name, obj, options, lines):
    """Removes the docstring that Python generates for the constructor of every NamedTuple."""
    lines[:] = [line for line in lines if not line.startswith("Create new instance of")]


def public_ids() -> set[str]:
    """What the reference must hold: all public names, and the public methods of the classes, inherited ones too."""
    ids = set()
    for name in public_names():
        value = attrgetter(name)(armctl)
        ids.add(f"armctl.{name}")
        for base in value.__mro__ if inspect.isclass(value) else ():
            if base.__module__.startswith("armctl."):
                ids |= {f"armctl.{name}.{m}" for m, v in vars(base).items() if not m.startswith("_") and callable(v)}
    return ids


def warn_of_gaps(app, env):
    """`make docs` treats the warning as an error."""
    gaps = public_ids() - env.get_domain("py").objects.keys()
    if gaps:
        logging.getLogger(__name__).warning("the reference lacks %s", ", ".join(sorted(gaps)))


def setup(app):
    here = Path(__file__).parent
    (here / "reference").mkdir(exist_ok=True)
    for old in (here / "reference").glob("*.md"):  # of packages that are gone
        old.unlink()
    for path, text in reference().items():
        (here / path).write_text(text, encoding="utf-8")
    app.connect("autodoc-skip-member", skip_fields_of_named_tuples)
    app.connect("autodoc-process-signature", plain_aliases)
    app.connect("autodoc-process-docstring", without_generated_docstring)
    app.connect("env-check-consistency", warn_of_gaps)
