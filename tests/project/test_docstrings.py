"""Docstrings of the public API are in Google style and agree with the code: parameters, returns, raises, attributes."""

import ast
import builtins
import inspect
import re
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import armctl
from armctl.core import errors
from armctl.core.log import SimulationError

ERRORS = {**vars(errors), "SimulationError": SimulationError}
SECTIONS = ["Args", "Attributes", "Returns", "Yields", "Raises", "Warns", "Example"]
RECORDS = {"NamedTuple", "TypedDict"}

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass
class Documented:
    """A public class, function or method, and its syntax tree."""

    name: str
    node: ast.ClassDef | Function
    is_method: bool = False

    @cached_property
    def doc(self) -> str:
        return ast.get_docstring(self.node) or ""

    @cached_property
    def sections(self) -> dict[str, str]:
        """The text of each section, by its heading."""
        parts = re.split(r"^(\w+):$", self.doc, flags=re.MULTILINE)
        return dict(zip(parts[1::2], parts[2::2], strict=True))

    def entries(self, section: str) -> list[str]:
        """The names that a section lists, in order."""
        return re.findall(r"^    (\*{0,2}\w+):\s", self.sections.get(section, ""), flags=re.MULTILINE)

    @property
    def decorators(self) -> set[str]:
        return {ast.unparse(decorator).split("(")[0].split(".")[-1] for decorator in self.node.decorator_list}

    @property
    def parameters(self) -> list[str]:
        assert isinstance(self.node, Function)
        args = self.node.args
        names = [arg.arg for arg in [*args.posonlyargs, *args.args]]
        if self.is_method and "staticmethod" not in self.decorators:
            names = names[1:]
        names += [f"*{args.vararg.arg}"] if args.vararg else []
        names += [arg.arg for arg in args.kwonlyargs]
        names += [f"**{args.kwarg.arg}"] if args.kwarg else []
        return [name for name in names if not name.lstrip("*").startswith("_")]


def tree_of(value: object) -> ast.ClassDef | Function:
    """The syntax tree of a class or function."""
    [node] = ast.parse(textwrap.dedent(inspect.getsource(value))).body  # type: ignore[arg-type]
    assert isinstance(node, ast.ClassDef | Function)
    return node


def public_api() -> Iterator[Documented]:
    """The names of `armctl.__all__`, and the public methods of their classes, inherited ones included."""
    for name in armctl.__all__:
        value = getattr(armctl, name)
        if inspect.isclass(value):
            for home in (base for base in value.__mro__ if base.__module__.startswith("armctl.")):
                node = tree_of(home)
                yield Documented(name if home is value else f"{name}({home.__name__})", node)
                for member in node.body:
                    if isinstance(member, Function) and (not member.name.startswith("_") or member.name == "__init__"):
                        method = Documented(f"{name}.{member.name}", member, is_method=True)
                        if "setter" not in method.decorators:  # the property says what it is
                            yield method
        elif inspect.isfunction(value):
            yield Documented(name, tree_of(value))


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


def first_line(found: Documented) -> Iterator[str]:
    first = found.doc.split("\n")[0]
    if not first:
        yield "no docstring"
    elif (first[0].islower() and not first.startswith("armctl ")) or not first.endswith((".", "?", ":")):
        yield f"its first line is no sentence: {first}"


def sections(found: Documented) -> Iterator[str]:
    unknown = set(found.sections) - set(SECTIONS)
    if unknown:
        yield f"unknown sections {sorted(unknown)}"
    known = [SECTIONS.index(name) for name in found.sections if name in SECTIONS]
    if not all(a < b for a, b in pairwise(known)):
        yield f"sections {list(found.sections)}, their order is {SECTIONS}"


def arguments(found: Documented) -> Iterator[str]:
    if isinstance(found.node, Function) and found.entries("Args") != found.parameters:
        yield f"Args lists {found.entries('Args')}, the parameters are {found.parameters}"


def returned_value(found: Documented) -> Iterator[str]:
    if not isinstance(found.node, Function):
        return
    returns = ast.unparse(found.node.returns) if found.node.returns else "None"
    first_line_says_it = "property" in found.decorators or not found.parameters
    documented = {"Returns", "Yields"} & set(found.sections)
    if returns == "None" or found.node.name == "__init__":
        if documented:
            yield "Returns, but it returns nothing"
    elif not first_line_says_it and not documented:
        yield f"no Returns, it returns {returns}"


def raised_errors(found: Documented) -> Iterator[str]:
    listed = {name: ERRORS.get(name) or getattr(builtins, name, None) for name in found.entries("Raises")}
    if None in listed.values():
        yield f"Raises lists {list(listed)}, one of them is no error"
    elif isinstance(found.node, Function):
        for name in sorted(raised(found.node)):
            if not any(issubclass(ERRORS[name], error) for error in listed.values() if error):
                yield f"no Raises for {name}"


def fields(found: Documented) -> Iterator[str]:
    if not isinstance(found.node, ast.ClassDef):
        return
    is_record = "dataclass" in found.decorators or RECORDS & {ast.unparse(base) for base in found.node.bases}
    annotated = [s.target.id for s in found.node.body if isinstance(s, ast.AnnAssign) and isinstance(s.target, ast.Name)]
    public = [name for name in annotated if not name.startswith("_")]
    if is_record and found.entries("Attributes") != public:
        yield f"Attributes lists {found.entries('Attributes')}, the fields are {public}"


CHECKS: list[Callable[[Documented], Iterator[str]]] = [first_line, sections, arguments, returned_value, raised_errors, fields]


def faults(documented: Documented) -> list[str]:
    return [f"{documented.name}: {fault}" for check in CHECKS for fault in check(documented)]


def test_the_docstrings_of_the_public_api_agree_with_the_code():
    found = [fault for documented in public_api() for fault in faults(documented)]
    assert not found, "\n".join(found)


def test_each_kind_of_fault_is_found():
    wrong = '''
def move(arm, q):
    """moves the arm

    Returns:
        Nothing.

    Args:
        q: rad.
        arm: The arm.

    Notes:
        None.
    """
    raise InputError("q: no number")
'''
    [node] = ast.parse(wrong).body
    assert isinstance(node, ast.FunctionDef)
    text = "\n".join(faults(Documented("move", node)))
    for fault in ("no sentence", "unknown sections", "their order is", "Args lists", "returns nothing", "no Raises for"):
        assert fault in text
