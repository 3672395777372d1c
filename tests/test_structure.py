"""The house: what may import what, and how large a function may grow."""

import ast
import re
from ast import Module
from collections.abc import Iterator
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1] / "torchpose"
# each room may import those before it, and rooms of its own line none of each other
FLOW = [
    ["errors"],
    ["geometry"],
    ["config", "ellipse", "grids", "kernels"],
    ["camera", "target"],
    ["handeye", "results", "pnp"],
    ["detect"],
    ["rings"],
    ["identify"],
    ["pose"],
    ["refine"],
    ["moments"],
    ["pipeline"],
    ["tracking"],
    ["io", "sim"],
    ["analysis"],
    ["datasets"],
    ["design", "calibration", "rig", "scale"],
    ["report"],
    ["live"],
    ["studies"],
    ["cli"],
    ["__main__"],
]
LEVEL = {room: level for level, rooms in enumerate(FLOW) for room in rooms}
MODULES = sorted(ROOT.rglob("*.py"))
LOOSE = 8  # files beside __init__.py
MOST_THRESHOLDS = 80  # named numbers of the stages that decide, see scripts/count_thresholds.py
LONGEST, MOST_PARAMETERS = 60, 7  # of a function: lines, and parameters outside pnp/ and the command line


def imported(tree: Module) -> Iterator[tuple[str, int]]:
    """Rooms of the package that a module imports, with their lines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "torchpose":
            parts = node.module.split(".")[1:2] or [alias.name for alias in node.names]
            yield from ((part, node.lineno) for part in parts)
        elif isinstance(node, ast.Import):
            names = [alias.name.split(".") for alias in node.names]
            yield from ((name[1], node.lineno) for name in names if name[0] == "torchpose" and len(name) > 1)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_follow_the_flow(path: Path) -> None:
    room = path.relative_to(ROOT).parts[0].removesuffix(".py")
    if room == "__init__":
        return  # hands on the public names of all rooms
    for other, line in imported(ast.parse(path.read_text())):
        if other != room and other not in ("__version__",):
            assert LEVEL[other] < LEVEL[room], f"line {line}: {room} imports {other}"


def test_every_room_has_its_place() -> None:
    found = {path.stem for path in ROOT.glob("*.py")} | {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert found - {"__init__"} == set(LEVEL)


def test_few_loose_files() -> None:
    assert len([path for path in ROOT.glob("*.py") if path.name != "__init__.py"]) <= LOOSE


def functions(path: Path) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield node


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_functions_are_small(path: Path) -> None:
    for function in functions(path):
        length = (function.end_lineno or 0) - function.lineno + 1
        assert length <= LONGEST, f"{function.name}: {length} lines"
        if path.relative_to(ROOT).parts[0] in ("pnp", "cli"):
            continue
        arguments = function.args
        names = [a.arg for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
        count = len([name for name in names if name not in ("self", "cls")])
        assert count <= MOST_PARAMETERS, f"{function.name}: {count} parameters"


def test_tensor_rows_share_their_base() -> None:
    """What selects, joins or moves rows is written in `geometry/rows.py` alone."""
    for path in MODULES:
        if path.name != "rows.py":
            assert "__dataclass_fields__" not in path.read_text(), path
    rows = [path for path in MODULES if re.search(r"^class \w+\(Rows\):", path.read_text(), re.M)]
    assert len(rows) >= 12


def thresholds() -> ModuleType:
    """`scripts/count_thresholds.py`."""
    spec = spec_from_file_location("count_thresholds", ROOT.parent / "scripts" / "count_thresholds.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_thresholds_say_where_they_come_from() -> None:
    found = [c for c in thresholds().constants(ROOT) if c.decides]
    assert 60 < len(found) <= MOST_THRESHOLDS, "one may be derived from another, or stand in one place for both"
    assert not [f"{c.module}:{c.line} {c.name}" for c in found if not c.has_origin]
    assert thresholds().bare_numbers(ROOT) <= 12, "a number in a comparison wants a name"


def test_a_threshold_without_origin_is_found(tmp_path: Path) -> None:
    (tmp_path / "rings").mkdir()
    (tmp_path / "rings" / "one.py").write_text(
        "_MOST = 0.3  # of the width\n_LEAST = 0.7  # of the width (convention)\n_SIZE = 9\n"
        "def good(x, y):\n    limit = _MOST * y\n    return (x < limit) & (x > _LEAST) & (y.sum(_SIZE) > 0)\n"
    )
    found = [(c.name, c.decides, c.has_origin) for c in thresholds().constants(tmp_path)]
    assert found == [("_MOST", True, False), ("_LEAST", True, True), ("_SIZE", False, False)]


def test_text_is_read_and_printed_in_one_place() -> None:
    """Text of others goes through the bounds of `config`, and reaches a terminal without what would steer it."""
    own = {"config/documents.py", "rig/child.py", "rig/twin/wire.py", "studies/study.py", "io/store.py"}  # own data
    for path in MODULES:
        name, text = path.relative_to(ROOT).as_posix(), path.read_text()
        if name not in own:
            assert not re.search(r"json\.loads?\(|yaml\.(safe_)?load|yaml\.parse", text), name
        if name not in ("cli/common.py", "cli/main.py"):
            assert "typer.echo(" not in text, f"{name}: say() of cli/common.py"
