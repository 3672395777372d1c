"""``torchpose.yaml``: what is the same for all frames of a folder, so that it need not be typed.

    camera: camera.yaml        # relative to this file
    target: quad40             # or a list of targets
    method: edges

The command line goes first, then this file.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from torchpose.config import beside, read_yaml, real, validate
from torchpose.config.kinds import Word
from torchpose.errors import ConfigError, printable
from torchpose.io.storage import Place
from torchpose.pipeline import Method

PROJECT_FILE = "torchpose.yaml"


class _Keys(BaseModel):
    model_config = ConfigDict(extra="forbid")

    camera: Word | None = None
    target: (
        Annotated[list[Word], Field(min_length=1), BeforeValidator(lambda one: [one] if isinstance(one, str) else one)]
        | None
    ) = None
    method: Method | None = None
    tone: Word | None = None
    instances: Annotated[int, Field(ge=1, le=1000)] | None = None
    hand_eye: Word | None = None
    relative_to: Word | None = None
    assume_upright: bool | None = None


class Settings(dict[str, Any]):
    """Options by name, as the command line and a project file give them; None where neither does.

    Attributes:
        told: the line that says what the file has given; empty where it has given nothing.
    """

    told = ""

    def needed(self, name: str) -> Any:
        """An option that there has to be. ConfigError: there is none."""
        if self[name] in (None, []):
            option = name.replace("_", "-")
            raise ConfigError(f"--{option}: is missing; give it, or write `{name}: ...` into {PROJECT_FILE}")
        return self[name]


def settings(inputs: Sequence[Path | Place], **given: Any) -> Settings:
    """What the command line gives, and for the rest what the project file beside the frames says.

    The file lies in the folder of the frames (that which is an INPUT, or that of an INPUT which is a file), or else in
    the working directory.

    Args:
        inputs: of the command.
        **given: options of the command line, None (or an empty list) for those that are not given.

    Raises:
        ConfigError: a project file cannot be read or has an unknown key, or INPUTs have several.
    """
    path = _file([one for one in inputs if isinstance(one, Path)])
    result = Settings(given)
    if path is None:
        return result
    data = read_yaml(path)
    stated = validate(_Keys, data, path).model_dump(exclude_none=True)
    taken = {name: _placed(path, name, stated[name]) for name in given if given[name] in (None, []) and name in stated}
    result.update(taken)
    if taken:
        result.told = f"{path}: {', '.join(_shown(name, stated[name]) for name in taken)}"
    return result


def _file(inputs: Sequence[Path]) -> Path | None:
    """The project file. ConfigError: there are several."""
    folders = dict.fromkeys(path if os.path.isdir(path) else path.parent for path in inputs)
    # a link to nothing is one, too: that of the working directory would be another one
    found = {real(path): path for path in (folder / PROJECT_FILE for folder in folders) if os.path.lexists(path)}
    if len(found) > 1:
        one, other = list(found.values())[:2]
        raise ConfigError(f"{other}: INPUT: has another {PROJECT_FILE} than {one.parent}; run them one by one")
    here = Path(PROJECT_FILE)
    return next(iter(found.values()), here if os.path.lexists(here) else None)


def _placed(path: Path, name: str, value: Any) -> Any:
    """The value of a key, names of files from where the project file lies."""
    if name == "target":
        return [beside(path, one) for one in value]
    if name == "camera":
        return str(path.parent / value)
    return path.parent / value if name == "hand_eye" else value


def _shown(name: str, value: Any) -> str:
    words = value if isinstance(value, list) else [value]
    return printable(f"{name} {' '.join(str(word) for word in words)}")
