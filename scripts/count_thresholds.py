"""Named thresholds of the stages: where each stands, what it is, and whether it says where it comes from.

    python scripts/count_thresholds.py [--list] [--root torchpose]

A constant is a name in capitals that a module binds to numbers. It is a threshold where it decides: where it, or a name
that a line of the same function makes of it, stands in a comparison, or where it is handed to a function that compares
(`DECIDING`). Beside it the script counts bare numbers in comparisons, other than -1 to 4 and 0.5 (signs, counts,
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

ROOMS = ("detect", "rings", "identify", "pose", "refine", "geometry", "pipeline.py", "ellipse.py")
ORIGIN = re.compile(r"derived|convention|measured|contract|`[\w/.]+(\.py|\.md)?\b[^`]*`|docs/|00\d\d", re.I)
PLAIN = {-1, 0, 1, 2, 3, 4, 0.5}
DECIDING = {"near_pairs", "reduction_for", "merge_duplicates"}


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
    return sorted(
        path for room in ROOMS for path in ([root / room] if room[-3:] == ".py" else (root / room).rglob("*.py"))
    )


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
        return all(_is_number(n) for n in node.args) and bool(node.args)
    if isinstance(node, (ast.Attribute, ast.Subscript)):
        return ast.unparse(node).split(".")[-1].isupper() or ast.unparse(node) in ("math.pi", "math.inf", "torch.pi")
    return isinstance(node, ast.Name) and node.id.isupper()


def _used(node: ast.AST) -> set[str]:
    return {n.id for n in ast.walk(node) if isinstance(n, ast.Name)} | {
        n.attr for n in ast.walk(node) if isinstance(n, ast.Attribute)
    }


def _deciding(tree: ast.Module) -> Iterator[str]:
    """Names that comparisons of a module use, themselves or by a name made of them in the same function."""
    scopes = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
    for scope in scopes:
        made: dict[str, set[str]] = {}
        for node in ast.walk(scope):
            if isinstance(node, (ast.Assign, ast.For, ast.comprehension)):
                target = node.targets[0] if isinstance(node, ast.Assign) else node.target
                source = _used(node.value if isinstance(node, ast.Assign) else node.iter)
                for name in (n.id for n in ast.walk(target) if isinstance(n, ast.Name)):
                    made.setdefault(name, set()).update(source)
        for default in (*scope.args.defaults, *scope.args.kw_defaults):
            if isinstance(default, ast.Name):
                yield default.id
        for node in ast.walk(scope):
            called = isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in DECIDING
            if isinstance(node, ast.Compare) or called:
                names = _used(node)
                yield from names
                yield from (source for name in names for source in made.get(name, ()))


def _imported(tree: ast.Module, decided: set[str], root: Path) -> Iterator[tuple[Path, str]]:
    """Modules and names of imported constants that decide here."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("torchpose."):
            path = root.joinpath(*node.module.split(".")[1:])
            for alias in node.names:
                if (alias.asname or alias.name) in decided:
                    yield path.with_suffix(".py"), alias.name
                if alias.name in decided or any(alias.name == name for name in decided):
                    yield (path / alias.name).with_suffix(".py"), alias.name


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
    above, line = [], node.lineno - 1
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
