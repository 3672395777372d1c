"""Files that come with the package besides targets: cameras, plans and rigs, by name or to be copied."""

import os
from pathlib import Path

EXAMPLES = Path(__file__).parents[1] / "examples"
KINDS = ("cameras", "plans", "rig")
"""Their folders, which name each other's files by relative paths."""


def example(path: str | os.PathLike[str], kind: str) -> Path:
    """The file that a name means: one that is there, else the example of that name, else what was given.

    Args:
        path: of a file, or the name of an example without its suffix.
        kind: of `KINDS`.
    """
    name = os.fspath(path)
    file = EXAMPLES / kind / f"{name}.yaml"
    known = name == Path(name).name and not os.path.exists(name) and os.path.exists(file)
    return file if known else Path(path)
