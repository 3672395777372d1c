"""Hooks of mkdocs.yml: pages that are made from the program, and links that leave docs/.

Made anew in every build: the command reference from the options of the program, the API from what each room exports,
the records of decisions in the navigation, notebooks with their pictures, and the pages at the top of the checkout.
"""

from __future__ import annotations

import ast
import base64
import inspect
import json
import posixpath
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PACKAGE = ROOT / "torchpose"
TOP_PAGES = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md", "README.md": "readme.md"}
NO_LIBRARY = {"cli", "config", "report", "studies", "__init__", "__main__"}  # parts of the program itself
# in the order in which a frame passes them; others follow
ORDER = [
    *("pipeline", "results", "camera", "target", "handeye", "errors", "ellipse", "pnp", "detect", "rings", "identify"),
    *("pose", "refine", "geometry", "grids", "kernels", "sim", "datasets", "analysis", "design", "calibration"),
    *("io", "rig"),
]
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")


def on_config(config: Any) -> Any:
    """Fills the navigation: what is listed by the program, and of the pages those that are there."""
    made = {"commands.md", *TOP_PAGES.values()}
    filled: dict[str, list[Any]] = {
        "API": ["api/index.md", *({f"torchpose.{room}": f"api/{room}.md"} for room in rooms())],
        "Decisions": ["decisions/README.md", *({title(path): f"decisions/{path.name}"} for path in records())],
        "Notebooks": [{title_of_notebook(path): f"notebooks/{path.stem}.md"} for path in notebooks()],
    }
    config.nav = list(navigation(config.nav, filled, made))
    return config


def navigation(entries: Iterable[Any], filled: dict[str, list[Any]], made: set[str]) -> Iterable[Any]:
    """Entries with the sections filled, without pages that are neither in docs/ nor made."""
    for entry in entries:
        ((name, below),) = entry.items()
        if name in filled:
            if filled[name]:
                yield {name: filled[name]}
        elif isinstance(below, list):
            yield {name: list(navigation(below, filled, made))}
        elif below in made or (DOCS / below).exists():
            yield entry


def on_files(files: Files, *, config: Any) -> Files:
    """Adds the pages that are made."""
    pages = {"commands.md": command_reference(), "api/index.md": api_index()}
    pages |= {f"api/{room}.md": api_page(room) for room in rooms()}
    pages |= {place: top_page(name) for name, place in TOP_PAGES.items()}
    for path in notebooks():
        files.remove(files.src_uris[f"notebooks/{path.name}"])  # its page is enough
        text, pictures = notebook_page(path)
        pages[f"notebooks/{path.stem}.md"] = text
        for name, pixels in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=pixels))
    for place, content in pages.items():
        files.append(File.generated(config, place, content=content))
    return files


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Files) -> str:
    """Links to the top pages lead to their places in the site; links to other files of the checkout become names."""
    here = posixpath.dirname(page.file.src_uri)
    return _LINK.sub(lambda found: led(found, here), markdown)


def led(found: re.Match[str], here: str) -> str:
    mark, text, link = found.groups()
    target, hash_, anchor = link.partition("#")
    if mark or "://" in link or not target:
        return found[0]
    place = posixpath.normpath(posixpath.join("docs", here, target))
    if place.startswith("docs/"):
        return found[0]
    if place in TOP_PAGES:
        return f"[{text}]({posixpath.relpath(TOP_PAGES[place], here or '.')}{hash_}{anchor})"
    return text if "`" in text else f"`{place}`"


def top_page(name: str) -> str:
    """A page at the top of the checkout, its links as from docs/."""
    text = (ROOT / name).read_text(encoding="utf-8")

    def moved(found: re.Match[str]) -> str:
        mark, words, link = found.groups()
        if "://" in link or link.startswith("#"):
            return found[0]
        return f"{mark}[{words}]({link.removeprefix('docs/') if link.startswith('docs/') else '../' + link})"

    return _LINK.sub(moved, text)


def records() -> list[Path]:
    return sorted((DOCS / "decisions").glob("0*.md"))


def title(path: Path) -> str:
    return path.read_text(encoding="utf-8").split("\n", 1)[0].removeprefix("# ")


# --- API


def rooms() -> list[str]:
    """Every part of the package that is a library."""
    there = {path.stem for path in PACKAGE.glob("*.py")} | {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    return [*(room for room in ORDER if room in there), *sorted(there - {*ORDER} - NO_LIBRARY)]


def module_file(room: str) -> Path:
    return next(path for path in (PACKAGE / room / "__init__.py", PACKAGE / f"{room}.py") if path.exists())


def exported(path: Path) -> list[str]:
    """Public names of a module, read without importing it: those of `__all__`, or what it defines."""
    body = ast.parse(path.read_text(encoding="utf-8")).body
    for node in body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            names: list[str] = ast.literal_eval(node.value)
            return names
    defined = [node.name for node in body if isinstance(node, ast.ClassDef | ast.FunctionDef)]
    return [name for name in defined if not name.startswith("_")]


def homes(path: Path) -> dict[str, str]:
    """The module that each imported name comes from."""
    imports = [node for node in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(node, ast.ImportFrom)]
    return {alias.name: node.module for node in imports for alias in node.names if node.module}


def enum_members(module: str, name: str) -> str:
    """A table of the members of a class that is a list of names, with the comments beside them; nothing for others."""
    path = ROOT / f"{module.replace('.', '/')}.py"
    if not path.exists():
        return ""
    text = path.read_text(encoding="utf-8")
    classes = [n for n in ast.parse(text).body if isinstance(n, ast.ClassDef) and n.name == name]
    members = [
        (node.targets[0], node.value, text.splitlines()[node.lineno - 1].partition("  # ")[2])
        for found in classes
        if any("Enum" in ast.unparse(base) for base in found.bases)
        for node in found.body
        if isinstance(node, ast.Assign)
    ]
    rows = "".join(f"| `{ast.unparse(key)}` | {ast.unparse(value)} | {told} |\n" for key, value, told in members)
    return f"| name | value | |\n| --- | --- | --- |\n{rows}\n" if rows else ""


def about(path: Path) -> str:
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""


def api_index() -> str:
    rows = "".join(
        f"| [`torchpose.{room}`]({room}.md) | {about(module_file(room)).split(chr(10), 1)[0]} |\n" for room in rooms()
    )
    return (
        "# API\n\nWhat every function and class of the library takes and returns, from its docstring. "
        "What `torchpose` itself exports is public. A stage is usable alone, but may still change.\n\n"
        'Shapes stand in the annotations: `Float[Tensor, "B 3 3"]` is a floating-point tensor of B matrices. '
        "Lengths are mm, angles rad; [Conventions](../conventions.md) has the rest.\n\n"
        f"| room | what is in it |\n| --- | --- |\n{rows}"
    )


def api_page(room: str) -> str:
    path = module_file(room)
    head = f"# torchpose.{room}\n\n{about(path)}\n\n"
    if names := exported(path):
        home = homes(path)
        return head + "".join(_entry(f"torchpose.{room}", name, home.get(name, f"torchpose.{room}")) for name in names)
    modules = sorted(file.stem for file in path.parent.glob("*.py") if not file.stem.startswith("_"))
    return head + "".join(f"::: torchpose.{room}.{name}\n\n" for name in modules)


def _entry(module: str, name: str, home: str) -> str:
    """One name under the module that hands it on, which is where a user imports it from."""
    options = f"      heading: {module}.{name}\n      toc_label: {name}\n"
    return f"::: {home}.{name}\n    options:\n{options}\n{enum_members(home, name)}"


# --- commands


def command_reference() -> str:
    """Every command with its arguments and options, as the program itself has them."""
    import typer

    from torchpose.cli.main import app

    group: Any = typer.main.get_command(app)
    parts = ["# Commands\n\nEvery command of `torchpose` with all its options, made from the program itself.\n"]
    parts += [command_section(name, command) for name, command in group.commands.items()]
    return "\n".join(parts)


def command_section(name: str, command: Any) -> str:
    import typer

    context = typer.Context(command, info_name=f"torchpose {name}")
    usage = " ".join(command.collect_usage_pieces(context))
    rows = "".join(_row(parameter.get_help_record(context)) for parameter in command.params)
    return (
        f"## torchpose {name} {{ #{name} }}\n\n    torchpose {name} {usage}\n\n"
        f"{inspect.cleandoc(command.help or '')}\n\n| option | what it says |\n| --- | --- |\n{rows}\n"
        f"{inspect.cleandoc(command.epilog or '')}\n"
    )


def _row(record: tuple[str, str]) -> str:
    names, told = (" ".join(text.split()).replace("|", "&#124;") for text in record)
    names = names.replace("<", "&lt;").replace(">", "&gt;")
    return f"| <code>{names}</code> | {told} |\n"


# --- notebooks


def notebooks() -> list[Path]:
    return sorted((DOCS / "notebooks").glob("*.ipynb"))


def title_of_notebook(path: Path) -> str:
    first = "".join(json.loads(path.read_text(encoding="utf-8"))["cells"][0]["source"])
    return first.split("\n", 1)[0].removeprefix("# ")


def notebook_page(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown, with its outputs, and its pictures by name."""
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{path.stem}_{len(pictures)}.png"
                pictures[name] = base64.b64decode("".join(data["image/png"]))
                parts.append(f"![{data.get('text/plain', ['picture'])[0]}]({name})")
            elif text := "".join(output.get("text", data.get("text/plain", []))).rstrip():
                parts.append(f"```text\n{text}\n```")
    return "\n\n".join(parts) + "\n", pictures
