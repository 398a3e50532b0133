"""Docstrings are in Google style, agree with the code, and say what the signature does not say.

Every public argument, field and result is documented with its meaning, shape and unit. What name and type say already may be
left out, and a line that only repeats them must be.
"""

import ast
import builtins
import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import pytest
from syntax import definition_of, nodes_of_text

import armctl
from armctl.core import errors
from armctl.core.log import SimulationError

pytestmark = pytest.mark.form

ERRORS = {**vars(errors), "SimulationError": SimulationError}
SECTIONS = ["Args", "Attributes", "Returns", "Yields", "Raises", "Warns", "Example"]
RECORDS = {"NamedTuple", "TypedDict"}
# Arguments and fields that mean the same everywhere. So do transforms such as `T_body_tip`, and what
# is named after its type, such as `plant: Plant`. The page on conventions defines the letters.
OBVIOUS = {"controller", "count", "folder", "joint", "joint_names", "name", "path", "robot", "rng", "seed", "tip_body"}
OBVIOUS |= {"q", "v", "a", "tau"}
# Types of results that need a sentence: it gives the shape, the unit, or the meaning of the entries.
UNCLEAR_RESULT = re.compile(r"\b(float|int|tuple|list|dict|object|Any|Sequence|Iterator|\w*Array|NDArray\S*)\b")
FILLERS = {"a", "an", "the", "its", "of", "this", "that", "given", "whose", "one", "both", "whole"}

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

    def entries(self, section: str) -> dict[str, str]:
        """What a section says of each name that it lists, in order."""
        parts = re.split(r"^    (\*{0,2}\w+):\s", self.sections.get(section, ""), flags=re.MULTILINE)
        return dict(zip(parts[1::2], parts[2::2], strict=True))

    @cached_property
    def types(self) -> dict[str, str]:
        """The annotations of the parameters of a function, or of the fields of a class."""
        if isinstance(self.node, ast.ClassDef):
            fields = [s for s in self.node.body if isinstance(s, ast.AnnAssign)]
            return {ast.unparse(field.target): ast.unparse(field.annotation) for field in fields}
        args = self.node.args
        named = [*args.posonlyargs, *args.args, *args.kwonlyargs]
        return {arg.arg: ast.unparse(arg.annotation) for arg in named if arg.annotation}

    @cached_property
    def returns(self) -> str:
        """The annotation of a function's result."""
        annotation = getattr(self.node, "returns", None)
        return ast.unparse(annotation) if annotation else "None"

    def is_obvious(self, name: str) -> bool:
        """Whether name and type say it all."""
        if name in OBVIOUS or name.startswith("T_"):
            return True
        noun = name.replace("_", "").removesuffix("s")
        types = [type_.lower().removesuffix("s") for type_ in re.findall(r"\w{3,}", self.types.get(name, ""))]
        return len(noun) >= 3 and any(type_.startswith(noun) or type_.endswith(noun) for type_ in types)

    def agrees(self, section: str, names: list[str]) -> bool:
        """Whether a section lists these names in this order, and all but the obvious ones."""
        listed = list(self.entries(section))
        return listed == [name for name in names if name in listed or not self.is_obvious(name)]

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


def has_source(value: type) -> bool:
    """Whether a class is armctl's and written in Python; the docstrings of the core are in C++."""
    return value.__module__.startswith("armctl.") and value.__module__ != "armctl._core"


def public_api() -> Iterator[Documented]:
    """The names of `armctl.__all__`, and the public methods of their classes, inherited ones included."""
    for name in armctl.__all__:
        value = getattr(armctl, name)
        if inspect.isclass(value):
            for home in filter(has_source, value.__mro__):
                node = definition_of(home)
                yield Documented(name if home is value else f"{name}({home.__name__})", node)
                for member in node.body:
                    if isinstance(member, Function) and (not member.name.startswith("_") or member.name == "__init__"):
                        method = Documented(f"{name}.{member.name}", member, is_method=True)
                        if "setter" not in method.decorators:  # the property says what it is
                            yield method
        elif inspect.isfunction(value):
            yield Documented(name, definition_of(value))


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
    if isinstance(found.node, Function) and not found.agrees("Args", found.parameters):
        yield f"Args lists {list(found.entries('Args'))}, the parameters are {found.parameters}"


def returned_value(found: Documented) -> Iterator[str]:
    if not isinstance(found.node, Function):
        return
    first_line_says_it = "property" in found.decorators or not found.parameters
    documented = {"Returns", "Yields"} & set(found.sections)
    if found.returns == "None" or found.node.name == "__init__":
        if documented:
            yield "Returns, but it returns nothing"
    elif not first_line_says_it and not documented and UNCLEAR_RESULT.search(found.returns):
        yield f"no Returns, it returns {found.returns}"


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
    if is_record and not found.agrees("Attributes", public):
        yield f"Attributes lists {list(found.entries('Attributes'))}, the fields are {public}"


def content(text: str) -> set[str]:
    """The words of a text or a signature that carry its meaning, without their plural s."""
    words = re.findall(r"[A-Z]?[a-z]+|[A-Z]+|\d+", text.replace("'s", ""))
    return {word.lower() if len(word) == 1 else word.lower().removesuffix("s") for word in words} - FILLERS


def repetitions(found: Documented) -> Iterator[str]:
    """Lines such as "arm: The arm.", sections without a line, and results that the first line names."""
    for section in ("Args", "Attributes"):
        for name, text in found.entries(section).items():
            if not re.search(r'["`]', text) and content(text) <= content(f"{name} {found.types.get(name, '')}"):
                yield f"{name}: {text.strip()} repeats the signature"
    for section, text in found.sections.items():
        if not text.strip():
            yield f"{section} is empty"
    text = found.sections.get("Returns", "").strip()
    is_shape = re.search(r"[(\d`]", text)
    if text and not is_shape and content(text) <= content(f"{found.doc.splitlines()[0]} {found.returns}"):
        yield f"Returns: {text} repeats the first line"


def all_documented() -> Iterator[Documented]:
    """Every class and function of the package."""
    package = Path(armctl.__file__).parent
    for path in sorted(package.rglob("*.py")):
        for node in nodes_of_text(path.read_text(encoding="utf-8")):
            if isinstance(node, ast.ClassDef | Function):
                yield Documented(f"{path.relative_to(package)}:{node.lineno} {node.name}", node)


CHECKS: list[Callable[[Documented], Iterator[str]]] = [first_line, sections, arguments, returned_value, raised_errors, fields]


def faults(documented: Documented) -> list[str]:
    return [f"{documented.name}: {fault}" for check in CHECKS for fault in check(documented)]


def test_the_docstrings_of_the_public_api_agree_with_the_code():
    found = [fault for documented in public_api() for fault in faults(documented)]
    assert not found, "\n".join(found)


def test_no_docstring_repeats_the_signature():
    found = [f"{documented.name}: {fault}" for documented in all_documented() for fault in repetitions(documented)]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("signature", "section", "fault"),
    [
        ("arm: Arm", "Args:\n        arm: The arm.", "arm: The arm. repeats the signature"),
        ("log", "Args:\n        log: The log.", "log: The log. repeats the signature"),
        ("tip_body: int", "Args:\n        tip_body: The body of the tip.", "repeats the signature"),
        ("runs: Sequence[Run]", "Args:\n        runs: The runs.", "repeats the signature"),
        ("arm: Arm", "Args:\n\n    Raises:\n        ValueError: It is a leg.", "Args is empty"),
        ("arm: Arm", "Returns:\n        The pose.", "Returns: The pose. repeats the first line"),
        ("arm: Arm", "Args:\n        arm: The arm that holds the tool.", None),
        ("q: Array", "Args:\n        q: (n,) rad.", None),
        ("clearance: float", "Args:\n        clearance: m.", None),
        ("arm: Arm", "Returns:\n        The pose in the base's frame.", None),
    ],
)
def test_a_line_that_repeats_the_signature_is_found(signature: str, section: str, fault: str | None):
    [node] = ast.parse(f'def pose({signature}) -> Pose:\n    """A pose of the tip.\n\n    {section}\n    """').body
    assert isinstance(node, ast.FunctionDef)
    faults = list(repetitions(Documented("pose", node)))
    assert not faults if fault is None else len(faults) == 1 and fault in faults[0]


@pytest.mark.parametrize(
    ("signature", "may_be_left_out"),
    [
        ("arm: Arm", True),
        ("arms: Sequence[Arm]", True),
        ("model: mujoco.MjModel | None", True),
        ("trajectory: JointTrajectory", True),
        ("seed: int", True),
        ("q: Array", True),
        ("points: Array", False),
        ("speed: float", False),
        ("other: Arm", False),
    ],
)
def test_only_obvious_arguments_may_be_left_out(signature: str, may_be_left_out: bool):
    [node] = ast.parse(f'def pose({signature}) -> Pose:\n    """A pose of the tip."""').body
    assert isinstance(node, ast.FunctionDef)
    assert bool(list(arguments(Documented("pose", node)))) != may_be_left_out


def test_each_kind_of_fault_is_found():
    wrong = '''
def move(arm, q):
    """moves the arm

    Returns:
        Nothing.

    Args:
        q: rad.
        arm: The arm that moves.

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
