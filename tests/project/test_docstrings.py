"""Public docstrings are in Google style and agree with the code: parameters, their order, returns, raises, attributes."""

import ast
import builtins
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest

import armctl
from armctl.core import errors as error_module
from armctl.core.log import SimulationError

PACKAGE = Path(armctl.__file__).parent
ERRORS = {**vars(error_module), "SimulationError": SimulationError}
SECTIONS = ["Args", "Attributes", "Returns", "Yields", "Raises", "Warns"]
RECORDS = {"NamedTuple", "TypedDict"}

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass
class Documented:
    """A public class or function and where it is."""

    where: str
    node: ast.ClassDef | Function
    owner: ast.ClassDef | None = None

    def __str__(self) -> str:
        return self.where

    @property
    def doc(self) -> str:
        return ast.get_docstring(self.node) or ""

    @property
    def sections(self) -> dict[str, str]:
        """The text of each section, by its heading."""
        parts = re.split(r"^(\w+):$", self.doc, flags=re.MULTILINE)
        return dict(zip(parts[1::2], parts[2::2], strict=True))

    def entries(self, section: str) -> list[str]:
        """What a section lists, in order."""
        return re.findall(r"^    (\*{0,2}\w+):\s", self.sections.get(section, ""), flags=re.MULTILINE)


def walk(module: str, body: list[ast.stmt], owner: ast.ClassDef | None = None) -> Iterator[Documented]:
    for node in body:
        if isinstance(node, ast.ClassDef | Function) and is_public(node.name):
            prefix = f"{module}.{owner.name}" if owner else module
            yield Documented(f"{prefix}.{node.name}", node, owner)
            if isinstance(node, ast.ClassDef):
                yield from walk(module, node.body, node)


def is_public(name: str) -> bool:
    return not name.startswith("_") or name in ("__init__", "__call__")


def decorators(node: ast.AST) -> set[str]:
    return {ast.unparse(decorator).split("(")[0].split(".")[-1] for decorator in getattr(node, "decorator_list", [])}


def is_compiled(tree: ast.Module) -> bool:
    """A module of kernels says what their arguments are once, at its head: nobody else calls them."""
    return any(isinstance(node, ast.ImportFrom) and node.module == "armctl.core.jit" for node in tree.body)


TREES = {
    path.relative_to(PACKAGE.parent): ast.parse(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))
}
ALL = [
    found
    for path, tree in TREES.items()
    if is_public(path.stem) and not is_compiled(tree)
    for found in walk(".".join(path.with_suffix("").parts), tree.body)
]
FUNCTIONS = [found for found in ALL if isinstance(found.node, Function)]
CLASSES = [found for found in ALL if isinstance(found.node, ast.ClassDef)]
every_one = pytest.mark.parametrize("found", ALL, ids=str)
every_function = pytest.mark.parametrize("found", FUNCTIONS, ids=str)
every_class = pytest.mark.parametrize("found", CLASSES, ids=str)


def parameters(found: Documented) -> list[str]:
    assert isinstance(found.node, Function)
    args = found.node.args
    names = [arg.arg for arg in [*args.posonlyargs, *args.args]]
    if found.owner is not None and "staticmethod" not in decorators(found.node):
        names = names[1:]
    names += [f"*{args.vararg.arg}"] if args.vararg else []
    names += [arg.arg for arg in args.kwonlyargs]
    names += [f"**{args.kwarg.arg}"] if args.kwarg else []
    return [name for name in names if not name.lstrip("*").startswith("_")]


def own_statements(node: ast.AST) -> Iterator[ast.AST]:
    """A function's statements without those of functions inside it."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, Function | ast.Lambda | ast.ClassDef):
            yield child
            yield from own_statements(child)


def raised(node: ast.AST) -> set[str]:
    """The errors of armctl that a function raises in its own statements."""
    calls = {ast.unparse(s.exc) for s in own_statements(node) if isinstance(s, ast.Raise) and s.exc is not None}
    return {name for name in (re.split(r"[.(]", call)[0] for call in calls) if name in ERRORS}


@every_one
def test_the_first_line_is_a_sentence(found: Documented):
    first = found.doc.split("\n")[0]
    assert first, "no docstring"
    assert first[0].isupper() or not first[0].isalpha(), first
    assert first.endswith((".", "?", ":")), first


@every_one
def test_sections_are_known_and_in_order(found: Documented):
    known = [SECTIONS.index(name) for name in found.sections if name in SECTIONS]
    assert all(a < b for a, b in pairwise(known)), f"{list(found.sections)}, the order is {SECTIONS}"
    assert set(found.sections) <= {*SECTIONS, "Example"}, list(found.sections)


@every_function
def test_parameters_are_documented_in_their_order(found: Documented):
    assert found.entries("Args") == parameters(found)


@every_function
def test_what_is_returned_is_documented(found: Documented):
    assert isinstance(found.node, Function)
    returns = ast.unparse(found.node.returns) if found.node.returns else "None"
    nothing = returns == "None" or found.node.name == "__init__"
    says_it_in_its_first_line = "property" in decorators(found.node) or not parameters(found)
    if nothing:
        assert "Returns" not in found.sections, "it returns nothing"
    elif not says_it_in_its_first_line:
        assert {"Returns", "Yields"} & set(found.sections), f"it returns {returns}"


@every_function
def test_what_is_raised_is_documented(found: Documented):
    listed = [ERRORS.get(name) or getattr(builtins, name, None) for name in found.entries("Raises")]
    assert None not in listed, f"{found.entries('Raises')}: one of them is no error"
    for name in raised(found.node):
        assert any(issubclass(ERRORS[name], error) for error in listed), f"it raises {name}"


@every_class
def test_the_fields_of_a_record_are_documented_in_their_order(found: Documented):
    assert isinstance(found.node, ast.ClassDef)
    is_record = "dataclass" in decorators(found.node) or RECORDS & {ast.unparse(base) for base in found.node.bases}
    fields = [s.target.id for s in found.node.body if isinstance(s, ast.AnnAssign) and isinstance(s.target, ast.Name)]
    if is_record:
        assert found.entries("Attributes") == [name for name in fields if not name.startswith("_")]
