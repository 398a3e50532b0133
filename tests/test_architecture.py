"""The house: every module has a floor, imports go down, modules and functions stay short, and importing armctl is cheap."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import armctl

PACKAGE = Path(armctl.__file__).parent

# One line a floor; a room is a module or a folder. Rooms on one floor do not know each other, but `a > b` may import b.
FLOORS = [
    ["errors", "arrays > errors", "units", "compiled"],
    ["pose", "trajectory", "log", "goal > pose", "move_result > log"],
    [
        "datasheets",
        "elements",
        "coupling > elements",
        "tip > elements",
        "drives > coupling elements",
        "linkage > drives elements",
        "chain > coupling drives elements tip",
        "apart > drives elements tip",
        "motors > coupling datasheets drives elements",
        "urdf_mass",
        "urdf > drives elements motors urdf_mass",
        "source > datasheets urdf",
        "tools > source tip",
        "scene_file > elements source tools",
        "scene > scene_file",
        "rigid_body > linkage",
        "staging > elements rigid_body",
        "payload > elements",
        "arm > linkage payload rigid_body",
        "contacts > arm elements rigid_body",
    ],
    ["robots", "dynamics", "ik", "describe"],
    ["motion", "control", "plant", "plant_names > plant"],
    [
        "recorder",
        "jaws",
        "disturbances",
        "rig > recorder disturbances",
        "gripper > jaws rig",
        "view > rig recorder",
        "moves > rig recorder",
        "simulation > moves gripper rig recorder view",
        "team > gripper rig recorder",
        "identification",
    ],
    [
        "plot",
        "report > plot",
        "comparison > report",
        "iso9283",
        "comparison_page > comparison plot report",
        "live > report plot comparison",
    ],
    ["__init__", "cli > __init__", "__main__ > cli"],
]
FLOOR_OF = {room.split()[0]: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
MAY_IMPORT = {
    head.strip(): set(below.split()) for rooms in FLOORS for head, _, below in (room.partition(">") for room in rooms)
}

# The one import that may look up, and only for the type checker: SimulationError carries a Log.
UPWARD_FOR_TYPES = {("armctl.errors", "armctl.log")}

MODULE_LINES = 300
FUNCTION_LINES = 50  # without its docstring

# Modules that are long for a reason. A line goes when its module is split.
LONG = {
    "armctl.ik.kernel": "numba's disk cache notices changes in a function's own file only",
}


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 2 else parts)


def room(module: str) -> str:
    return module.split(".")[1]


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}
TREES = {module: ast.parse(path.read_text(encoding="utf-8")) for module, path in MODULES.items()}
every_module = pytest.mark.parametrize("module", MODULES)


def imported(node: ast.AST) -> set[str]:
    """The modules of armctl that one statement imports."""
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, "relative import; write it out from armctl"
        names = [f"{node.module}.{alias.name}" for alias in node.names] if node.module == "armctl" else [node.module or ""]
    else:
        return set()
    ours = {name for name in names if name.split(".")[0] == "armctl"}
    return {name if room(f"{name}.__init__") in FLOOR_OF else "armctl.__init__" for name in ours}


def imports(module: str) -> set[tuple[str, bool]]:
    """What a module imports from armctl, and whether only for the type checker."""
    for_types = {
        node
        for test in ast.walk(TREES[module])
        if isinstance(test, ast.If) and ast.unparse(test.test).endswith("TYPE_CHECKING")
        for node in ast.walk(test)
    }
    return {(name, node in for_types) for node in ast.walk(TREES[module]) for name in imported(node)}


def test_every_module_has_a_floor():
    homeless = {module for module in MODULES if room(module) not in FLOOR_OF}
    assert not homeless, f"{homeless}: give the room a floor in FLOORS"


@every_module
def test_imports_go_down_or_stay_in_their_room(module: str):
    for target, for_types in imports(module):
        if for_types and (module, target) in UPWARD_FOR_TYPES:
            continue
        here, there = room(module), room(target)
        down = FLOOR_OF[there] < FLOOR_OF[here]
        assert down or here == there or there in MAY_IMPORT[here], f"{module} must not import {target}"


@every_module
def test_a_module_is_short(module: str):
    lines = len(MODULES[module].read_text(encoding="utf-8").splitlines())
    if module in LONG:
        assert lines > MODULE_LINES, f"{module} is short now: take it out of LONG"
    else:
        assert lines <= MODULE_LINES, f"{module} has {lines} lines and asks to be split by meaning"


@every_module
def test_a_function_is_short(module: str):
    for node in ast.walk(TREES[module]):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        documented = isinstance(node.body[0], ast.Expr) and ast.get_docstring(node, clean=False) is not None
        docstring = (node.body[0].end_lineno or 0) - node.body[0].lineno + 1 if documented else 0
        lines = (node.end_lineno or 0) - node.lineno + 1 - docstring
        assert lines <= FUNCTION_LINES, f"{module}.{node.name} has {lines} lines and asks to be split by meaning"


def test_the_two_lists_of_public_names_agree():
    front_door = TREES["armctl.__init__"]
    block = next(node for node in front_door.body if isinstance(node, ast.If))
    for_types = {alias.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert for_types == armctl._MODULES


@pytest.mark.parametrize("name", armctl.__all__)
def test_a_public_name_is_there_and_documented(name: str):
    value = getattr(armctl, name)
    assert value.__doc__, f"armctl.{name} has no docstring"
    assert name in dir(armctl)


def test_no_module_hides_a_public_name():
    hidden = {room(module) for module in MODULES} & set(armctl.__all__)
    assert not hidden, f"{hidden}: importing the module would replace the name"


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'lode'"):
        _ = armctl.lode


def loaded(code: str, modules: list[str]) -> list[str]:
    """Which of the modules a new Python has loaded after running some code."""
    code = f"import sys\n{code}\nprint(*[name for name in {modules} if name in sys.modules])"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


def test_importing_armctl_loads_nothing_heavy():
    heavy = ["numpy", "mujoco", "pinocchio", "numba", "mink", "matplotlib", "ruckig", "toppra", "scipy", "viser"]
    assert loaded("import armctl", heavy) == []


def test_what_few_functions_need_waits_for_them():
    code = "import armctl\nfor name in armctl.__all__: getattr(armctl, name)"
    assert loaded(code, ["numba", "mink", "matplotlib", "viser"]) == []
