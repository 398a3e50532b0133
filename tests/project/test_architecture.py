"""The form of the source: short modules, plain assignments, and an import that loads nothing heavy.

`make lint` checks the rest: the layers and cycles (import-linter) and the length of functions (ruff).
"""

import ast
import re
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
from syntax import nodes_of_text, tree_of_text

import armctl

pytestmark = pytest.mark.form

PACKAGE = Path(armctl.__file__).parent
MAX_MODULE_LINES = 500
MAX_CPP_LINES = 600

# Modules that are long for a reason. A row goes when its module is split.
LONG_MODULES: dict[str, str] = {}

SOURCES = {path.relative_to(PACKAGE).as_posix(): path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))}


def test_the_package_contains_subpackages_only():
    """And the compiled core: its sources, its types, and the builds of it for this Python and others."""
    files = {path.name for path in PACKAGE.iterdir() if path.is_file() and path.suffix not in (".so", ".pyd")}
    assert files == {"__init__.py", "__init__.pyi", "__main__.py", "py.typed", "_core.pyi"}
    assert all(path.name.startswith("_core.") for path in PACKAGE.iterdir() if path.suffix in (".so", ".pyd"))
    folders = [path for path in PACKAGE.iterdir() if path.is_dir() and path.name not in ("__pycache__", "cpp")]
    assert all((folder / "__init__.py").is_file() for folder in folders), folders


def test_a_module_is_short():
    lines = {module: len(text.splitlines()) for module, text in SOURCES.items()}
    long = {module for module, count in lines.items() if count > MAX_MODULE_LINES}
    assert long == set(LONG_MODULES)


def test_a_cpp_file_is_short():
    lines = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in (PACKAGE / "cpp").rglob("*.[ch]pp")}
    assert lines
    assert {name for name, count in lines.items() if count > MAX_CPP_LINES} == set()


def bare_names(node: ast.expr) -> list[str]:
    return (
        sorted(ast.unparse(element) for element in node.elts) if isinstance(node, ast.Tuple | ast.List) else [ast.unparse(node)]
    )


def is_text_or_list(node: ast.expr) -> bool:
    return isinstance(node, ast.List | ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def is_condition(node: ast.expr) -> bool:
    return isinstance(node, ast.Compare | ast.BoolOp) or (isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not))


def is_one_vector(node: ast.expr) -> bool:
    """Whether a tuple holds two or three elements of one array, attributes of one object, or three numbers."""
    if not isinstance(node, ast.Tuple) or len(node.elts) > 3:
        return False
    elements = node.elts
    if len(elements) == 3 and all(isinstance(each, ast.Constant) and isinstance(each.value, float) for each in elements):
        return True
    owners = {ast.unparse(each.value) for each in elements if isinstance(each, ast.Subscript | ast.Attribute)}
    return len(owners) == 1 and len({type(each) for each in elements}) == 1


def unclear_statements(nodes: Iterable[ast.AST]) -> Iterator[tuple[int, str]]:
    """Lines that assign several values at once, except swaps and the components of one vector, and lines that multiply a text
    or a list by a condition."""
    for node in nodes:
        if isinstance(node, ast.Assign):
            target = node.targets[0]
            literal = isinstance(node.value, ast.Tuple | ast.List | ast.ListComp | ast.GeneratorExp)
            swap = literal and bare_names(target) == bare_names(node.value)
            vector = is_one_vector(node.value)
            if len(node.targets) > 1 or (isinstance(target, ast.Tuple) and literal and not swap and not vector):
                yield node.lineno, ast.unparse(node)
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
            sides = (node.left, node.right)
            if any(map(is_text_or_list, sides)) and any(map(is_condition, sides)):
                yield node.lineno, ast.unparse(node)


def test_one_statement_does_one_thing():
    found = [
        f"{module}:{line}: {code}" for module, text in SOURCES.items() for line, code in unclear_statements(nodes_of_text(text))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "code",
    [
        "a, b = 1, 2",
        "a = b = 0",
        "x.a, x.b = [0, 1]",
        "a, b = x.a, y.b",
        "a, b, c, d = x[0], x[1], x[2], x[3]",
        "a, b = x[0], 0.0",
        "a = ['note'] * (b > 0)",
        "a = 'note' * (not b)",
    ],
)
def test_an_unclear_statement_is_found(code: str):
    assert list(unclear_statements(nodes_of_text(code)))


@pytest.mark.parametrize(
    "code",
    [
        "a, b = b, a",
        "low, high = bounds(q)",
        "a[i], a[j] = a[j], a[i]",
        "x, y, z = work[k], work[k + 1], work[k + 2]",
        "x, y = goal.x, goal.y",
        "x, y, z = 0.0, 0.0, 1.0",
        "a = [0] * n",
        "a = (1, 2)",
    ],
)
def test_a_clear_statement_is_not(code: str):
    assert not list(unclear_statements(nodes_of_text(code)))


def class_names(text: str) -> list[str]:
    """The names of the classes of a module, without leading underscores."""
    return [node.name.lstrip("_") for node in nodes_of_text(text) if isinstance(node, ast.ClassDef)]


def test_a_class_name_means_one_class():
    """Also for readers and searches: an underscore does not make it another name."""
    places = defaultdict(list)
    for module, text in SOURCES.items():
        for name in class_names(text):
            places[name].append(module)
    shared = {name: modules for name, modules in places.items() if len(modules) > 1}
    assert not shared


def test_a_private_class_name_counts_as_the_public_one():
    assert class_names("class _Stream: pass\nclass Stream:\n    class _Row: pass") == ["Stream", "Stream", "Row"]


MAX_LATE_ATTRIBUTES = 3
CONSTRUCTORS = ("__init__", "__post_init__", "__new__")


def assigned_attributes(method: ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    """The attributes that a method assigns to its first argument, itself or in functions inside it."""
    owner = next((argument.arg for argument in (*method.args.posonlyargs, *method.args.args)), None)
    return {
        node.attr
        for node in ast.walk(method)
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and ast.unparse(node.value) == owner
    }


def made_attributes(node: ast.ClassDef, classes: dict[str, ast.ClassDef]) -> set[str]:
    """The attributes that a class has as soon as it is constructed, those of its bases too, and its methods."""
    made = set()
    for statement in node.body:
        if isinstance(statement, ast.FunctionDef):
            made.add(statement.name)  # also that of a property with a setter
            made.update(assigned_attributes(statement) if statement.name in CONSTRUCTORS else ())
        elif isinstance(statement, ast.AnnAssign) and (statement.value is not None or node.decorator_list):
            made.add(ast.unparse(statement.target))  # a value of the class, or a field of a dataclass
        elif isinstance(statement, ast.Assign):
            made.update(map(ast.unparse, statement.targets))
    bases = [classes[base.id] for base in node.bases if isinstance(base, ast.Name) and base.id in classes]
    return made.union(*(made_attributes(base, classes) for base in bases))


def late_attributes(node: ast.ClassDef, classes: dict[str, ast.ClassDef]) -> list[str]:
    """The attributes that only other methods of a class make."""
    methods = [statement for statement in node.body if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef)]
    assigned = set().union(*map(assigned_attributes, methods))
    return sorted(assigned - made_attributes(node, classes))


def classes_of(texts: Iterable[str]) -> dict[str, ast.ClassDef]:
    return {node.name: node for text in texts for node in nodes_of_text(text) if isinstance(node, ast.ClassDef)}


def test_a_class_makes_its_attributes_in_its_constructor():
    """All but three: what an object has is read in one place, and no method must be called before another one."""
    classes = classes_of(SOURCES.values())
    late = {name: late_attributes(node, classes) for name, node in classes.items()}
    assert {name: names for name, names in late.items() if len(names) > MAX_LATE_ATTRIBUTES} == {}


def test_an_attribute_that_a_method_makes_is_found():
    code = """
class Base:
    def __init__(self):
        self.made = 0

class Robot(Base):
    a: int
    b: int = 0

    def __init__(self):
        self.c, self.d = 0, 0
        self.reset()

    @property
    def speed(self): ...

    @speed.setter
    def speed(self, speed): ...

    def reset(this):
        this.made = this.a = this.b = this.c = this.d = this.speed = 1
        this.e, (this.f, other.g) = 1, (2, 3)
        this.h.i = 4
        this.j += 5
"""
    classes = classes_of([code])
    assert late_attributes(classes["Robot"], classes) == ["a", "e", "f", "j"]


def test_a_file_name_means_one_topic():
    """A file of `cli` may have the name of its command, which is that of what it runs."""
    stems = Counter(Path(module).stem for module in SOURCES if not module.startswith("cli/"))
    assert {stem for stem, count in stems.items() if count > 1 and not stem.startswith("__")} == set()


def test_tests_import_no_private_names():
    """What tests import is public, and so are the modules it comes from."""
    private = []
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        for node in nodes_of_text(path.read_text(encoding="utf-8")):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "armctl":
                names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
                private += [f"{path.name}: {name}" for name in names if name.startswith("_") and name != "_core"]
    assert not private


def test_every_public_name_is_listed_by_dir():
    assert set(armctl.__all__) <= set(dir(armctl))


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="armctl has no attribute 'lode'; similar: load"):
        _ = armctl.lode


def loaded(code: str, modules: list[str]) -> list[str]:
    """The modules of a list that a new Python has loaded after it ran some code."""
    code = f"import sys\n{code}\nprint(*[name for name in {modules} if name in sys.modules])"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


def test_importing_armctl_loads_nothing_heavy():
    heavy = ["numpy", "mujoco", "pinocchio", "numba", "mink", "matplotlib", "ruckig", "toppra", "scipy", "viser"]
    assert loaded("import armctl", heavy) == []


def test_packages_that_few_functions_need_are_loaded_by_those_functions():
    code = "import armctl\nfor name in armctl.__all__: getattr(armctl, name)"
    assert loaded(code, ["numba", "mink", "matplotlib", "viser"]) == []


def test_only_differential_ik_and_other_solvers_load_what_qpsolvers_imports():
    code = "import armctl\narmctl.Simulation(armctl.load('robot_arm_3dof'), controller='qp').step()"
    assert loaded(code, ["qpsolvers", "mink", "jax"]) == []


def is_dataclass(node: ast.ClassDef) -> bool:
    return any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list)


def built_by_position(text: str, classes: set[str]) -> list[str]:
    """Calls that build one of these dataclasses, by its name or as `cls` in it, with more than three positional arguments."""
    nodes = nodes_of_text(text)
    own = {node for scope in nodes if isinstance(scope, ast.ClassDef) and is_dataclass(scope) for node in ast.walk(scope)}
    return [
        ast.unparse(node)
        for node in nodes
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and len(node.args) > 3
        if node.func.id in classes or (node.func.id == "cls" and node in own)
    ]


def test_a_dataclass_of_more_than_three_values_is_built_by_keyword():
    nodes = [node for text in SOURCES.values() for node in nodes_of_text(text)]
    classes = {node.name for node in nodes if isinstance(node, ast.ClassDef) and is_dataclass(node)}
    assert {"Tuning", "LoopMargins", "ClearanceCheck"} <= classes
    assert {module: found for module, text in SOURCES.items() if (found := built_by_position(text, classes))} == {}


def test_a_dataclass_that_is_built_by_position_is_found():
    text = "@dataclass\nclass A:\n    def b(cls): return cls(1, 2, 3, 4)\nA(1, 2, 3, d=4)\nA(*a, 1, 2, 3)\n"
    assert built_by_position(text, {"A"}) == ["A(*a, 1, 2, 3)", "cls(1, 2, 3, 4)"]


def python_constants(text: str) -> dict[str, float]:
    """The numbers that a module gives names in capitals, without leading underscores."""
    found = {}
    for node in tree_of_text(text).body:
        if isinstance(node, ast.Assign) and isinstance(target := node.targets[0], ast.Name) and target.id.isupper():
            try:
                value = ast.literal_eval(node.value)
            except ValueError:
                continue
            if isinstance(value, int | float):
                found[target.id.lstrip("_")] = float(value)
    return found


def cpp_constants(text: str) -> dict[str, float]:
    """The numbers that a C++ file gives names in capitals."""
    found = re.findall(r"constexpr [\w:]+ ([A-Z][A-Z0-9_]*)\s*=\s*([-+.e\d]+);", text)
    return {name: float(value) for name, value in found}


def test_a_number_has_one_definition():
    """In Python and in C++: two constants of one name and value are one number, which would be changed in one place only."""
    places = defaultdict(list)
    for module, text in SOURCES.items():
        for item in python_constants(text).items():
            places[item].append(module)
    for path in sorted((PACKAGE / "cpp").rglob("*.[ch]pp")):
        for item in cpp_constants(path.read_text(encoding="utf-8")).items():
            places[item].append(path.name)
    assert len(places) > 300
    assert {item: found for item, found in places.items() if len(found) > 1} == {}


def test_the_constants_of_a_source_are_found():
    assert python_constants("A = 1\n_B_C = 2e-3\nd = 4\nE = A + 1") == {"A": 1.0, "B_C": 2e-3}
    assert cpp_constants("constexpr double A_B = 1e-6;  // m\nconstexpr int C = 4;\nconstexpr double d = 2.0;") == {
        "A_B": 1e-6,
        "C": 4.0,
    }
