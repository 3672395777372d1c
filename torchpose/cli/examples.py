"""``torchpose examples``: cameras, plans and rigs that come with the package, to look at and to start from."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from torchpose.cli.common import say
from torchpose.errors import ConfigError


class Action(StrEnum):
    list = "list"
    copy = "copy"


_ACTION = "`list` prints the names, `copy` writes the files."
_NAMES = "What to copy, as listed (plans/random) or a kind (plans); by default all."
_OUT = "Folder to copy to. Files that are there are never overwritten."


def examples(
    action: Annotated[Action, typer.Argument(metavar="list|copy", help=_ACTION)],
    names: Annotated[list[str] | None, typer.Argument(metavar="NAME...", help=_NAMES)] = None,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help=_OUT)] = Path("examples"),
) -> int:
    """List or copy the cameras, plans and rigs that come with the package.

    Commands take them by their names: torchpose simulate random --out DIR.
    """
    from torchpose.config.examples import EXAMPLES, KINDS

    known = {f"{kind}/{path.stem}": path for kind in KINDS for path in sorted((EXAMPLES / kind).glob("*.yaml"))}
    wanted = [name for name in known if not names or any(name == one or name.startswith(f"{one}/") for one in names)]
    for one in names or []:
        if not any(name == one or name.startswith(f"{one}/") for name in known):
            raise ConfigError(f"{one}: NAME: is no example; see torchpose examples list")
    if action is Action.list:
        for name in wanted:
            say(name)
        return 0
    places = {name: out / f"{name}.yaml" for name in wanted}
    there = [str(place) for place in places.values() if place.exists()]
    if there:
        raise ConfigError(f"{there[0]}: --out: is there already; choose another folder")
    for name, place in places.items():
        _copy(known[name], place)
        say(str(place))
    return 0


def _copy(file: Path, place: Path) -> None:
    from torchpose.io.writers import atomic_path, make_folder_of

    make_folder_of(place, "--out")
    with atomic_path(place, option="--out: ") as temporary:
        temporary.write_bytes(file.read_bytes())
