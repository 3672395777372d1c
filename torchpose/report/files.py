"""Where pictures go: folders that can be written, and files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from torchpose.errors import ConfigError
from torchpose.io.writers import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def make_folder(folder: Path, option: str) -> None:
    """Makes the folder that is the argument of ``option``. ConfigError: it cannot be created or written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".probe.{os.getpid()}.tmp"  # another run may try the same folder
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ConfigError(f"{folder}: {option}: cannot be written ({error.strerror}); choose another place") from None


def save_figures(figures: Mapping[str, Figure], folder: Path, dpi: int = 120) -> list[Path]:
    """Writes plots under their file names; the paths. ConfigError: one cannot be written."""
    from torchpose.report.figures import finish

    for name, figure in figures.items():
        finish(figure)
        with atomic_path(folder / name) as temporary:
            figure.savefig(temporary, format=name.rsplit(".", 1)[-1], dpi=dpi)
    return [folder / name for name in figures]
