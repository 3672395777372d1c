"""Named thresholds of the stages: where each stands, what it is, and whether it says where it comes from.

    python scripts/count_thresholds.py [--list] [--root torchpose]

A constant is a name in capitals that a module binds to numbers. It is a threshold where it decides: where it, or a name
that a line of the same function makes of it, stands in a comparison, or where it is handed to a function that compares
(`COMPARING`). Beside it the script counts bare numbers in comparisons, other than -1 to 4 and 0.5 (signs, counts,
halves): naming thresholds less would be no progress.

The origin of a threshold stands in the comment on its line or right above it: it is *derived*, a *convention*, or
*measured*, by a script, a test or a page of the documentation that is named.
"""

import argparse
import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOMS = ("detect", "rings", "identify", "pose", "refine", "moments", "geometry", "pipeline.py", "ellipse.py")
ORIGIN = re.compile(r"\((a )?(derived|convention|measured|contract)|^contract", re.I)
PLAIN = {-1, 0, 1, 2, 3, 4, 0.5}
COMPARING = {"near_pairs", "reduction_for", "merge_duplicates", "ratio_tolerance"}
PASSING = {
    "maximum",
    "minimum",
    "max",
    "min",
    "clamp",
    "clamp_min",
    "clamp_max",
    "where",
    "sqrt",
    "square",
    "double",
    "abs",
}


class Constant(NamedTuple):
    """A named number: module, line, name, its comment, and whether a comparison uses it."""

    module: str
    line: int
    name: str
    comment: str
    decides: bool

    @property
    def has_origin(self) -> bool:
        return bool(ORIGIN.search(self.comment))


def modules(root: Path) -> list[Path]:
    """Modules of the stages."""
    return sorted(path for path in root.rglob("*.py") if path.relative_to(root).parts[0] in ROOMS)


def constants(root: Path) -> list[Constant]:
    """Named numbers of the stages, in the order of their modules."""
    trees = {path: ast.parse(path.read_text()) for path in modules(root)}
    # a name that one module hands to another decides where the other compares with it
    decided = {path: set(_deciding(tree)) for path, tree in trees.items()}
    lent = {(source, name) for path, tree in trees.items() for source, name in _imported(tree, decided[path], root)}
    out = []
    for path, tree in trees.items():
        comments = _comments(path.read_text())
        for node in tree.body:
            for name in _names(node):
                comment = _comment_of(node, comments)
                decides = name in decided[path] or (path, name) in lent
                out.append(Constant(str(path.relative_to(root)), node.lineno, name, comment, decides))
    return out


def bare_numbers(root: Path) -> int:
    """Numbers without a name that comparisons use."""
    found = 0
    for path in modules(root):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Compare):
                inside = (n.value for n in ast.walk(node) if isinstance(n, ast.Constant))
                found += sum(type(v) in (int, float) and v not in PLAIN for v in inside)
    return found


def _names(node: ast.stmt) -> list[str]:
    """Names in capitals that a statement of a module binds to numbers."""
    targets: list[ast.expr]
    value: ast.expr | None
    if isinstance(node, ast.AnnAssign):
        targets, value = [node.target], node.value
    elif isinstance(node, ast.Assign):
        targets, value = node.targets, node.value
    else:
        return []
    names = [n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)]
    names = [name for name in names if re.fullmatch(r"_?[A-Z][A-Z0-9_]*", name)]
    return names if value is not None and _is_number(value) else []


def _is_number(node: ast.expr) -> bool:
    """Numbers, their tuples, and sums and products of numbers and names in capitals."""
    if isinstance(node, ast.Constant):
        return type(node.value) in (int, float)
    if isinstance(node, (ast.Tuple, ast.List)):
        return all(_is_number(n) for n in node.elts)
    if isinstance(node, ast.Starred):
        return _is_number(node.value)
    if isinstance(node, ast.UnaryOp):
        return _is_number(node.operand)
    if isinstance(node, ast.BinOp):
        return _is_number(node.left) and _is_number(node.right)
    if isinstance(node, ast.Call):
        return ast.unparse(node.func) in ("math.sqrt", "math.log", "round") and all(_is_number(n) for n in node.args)
    if isinstance(node, (ast.Attribute, ast.Subscript)):
        return ast.unparse(node).split(".")[-1].isupper() or ast.unparse(node) in ("math.pi", "math.inf", "torch.pi")
    return isinstance(node, ast.Name) and node.id.isupper()


def _used(node: ast.AST) -> set[str]:
    """Names that the value of an expression is made of; what goes into other functions is a number of theirs."""
    if isinstance(node, ast.Name):
        return {node.id}
    if isinstance(node, ast.Attribute):
        return {node.attr} | _used(node.value)
    parts = [part for part in ast.iter_child_nodes(node) if not isinstance(part, ast.Slice)]
    if isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] not in PASSING | COMPARING:
        parts = [node.func]
    return {name for part in parts for name in _used(part)}


def _deciding(tree: ast.Module) -> Iterator[str]:
    """Names that comparisons of a module use, themselves or by a name made of them in the same function."""
    assigned = [n for n in tree.body if isinstance(n, ast.Assign) and isinstance(n.value, ast.Constant)]
    broken = {
        ast.unparse(n.targets[0])
        for n in assigned
        if isinstance(n.value, ast.Constant) and type(n.value.value) is float
    }
    for scope in (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)):
        made: dict[str, set[str]] = {}
        for node in ast.walk(scope):
            if isinstance(node, ast.Assign):
                for name in (n.id for n in ast.walk(node.targets[0]) if isinstance(n, ast.Name)):
                    made.setdefault(name, set()).update(_used(node.value))
        given = (d.id for d in (*scope.args.defaults, *scope.args.kw_defaults) if isinstance(d, ast.Name))
        yield from (name for name in given if name in broken)  # whole numbers are sizes there
        for node in ast.walk(scope):
            compares = isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in COMPARING
            if isinstance(node, ast.Compare) or compares:
                names = _used(node)
                yield from names
                yield from (source for name in names for source in made.get(name, ()))


def _imported(tree: ast.Module, decided: set[str], root: Path) -> Iterator[tuple[Path, str]]:
    """Modules and names of imported constants that decide here."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("torchpose"):
            path = root.joinpath(*node.module.split(".")[1:])
            for alias in node.names:
                name = alias.asname or alias.name
                if name in decided:  # itself, or as a module whose constants stand behind a dot
                    yield path.with_suffix(".py"), alias.name
                    yield from (((path / alias.name).with_suffix(".py"), other) for other in decided)


def _comments(text: str) -> dict[int, tuple[str, bool]]:
    """Comments by line, and whether each has its line for itself."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return {
        t.start[0]: (t.string.lstrip("# "), not t.line[: t.start[1]].strip())
        for t in tokens
        if t.type == tokenize.COMMENT
    }


def _comment_of(node: ast.stmt, comments: dict[int, tuple[str, bool]]) -> str:
    """The comments of a statement: on its lines, and right above it."""
    lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
    parts = [comments[line][0] for line in lines if line in comments]
    above: list[str] = []
    line = node.lineno - 1
    while line in comments and comments[line][1]:
        above.insert(0, comments[line][0])
        line -= 1
    return " ".join([*above, *parts])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=Path(__file__).parents[1] / "torchpose")
    parser.add_argument("--list", action="store_true", help="every threshold, and what it says of itself")
    args = parser.parse_args()
    every = constants(args.root)
    thresholds = [c for c in every if c.decides]
    if args.list:
        for c in thresholds:
            print(f"{'  ' if c.has_origin else '- '}{c.module}:{c.line} {c.name}  # {c.comment}")
    without = sum(not c.has_origin for c in thresholds)
    print(f"{len(every)} named numbers, {len(thresholds)} of them thresholds, {without} of these without an origin;")
    print(f"{bare_numbers(args.root)} bare numbers in comparisons")


if __name__ == "__main__":
    main()
