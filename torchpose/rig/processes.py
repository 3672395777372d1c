"""Helper processes of this package: fresh interpreters that a fault cannot reach through."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import IO

import torchpose


def start_module(module: str, *arguments: str, stderr: IO[bytes] | None = None) -> subprocess.Popen[str]:
    """Runs ``python -m MODULE ARGUMENTS`` with pipes as standard input and output.

    A fresh interpreter, not a fork, and not `multiprocessing`, whose children import the user's script again. It gets a
    session of its own, so that a Ctrl-C at the terminal reaches only the parent, which decides what to do.
    """
    path = os.pathsep.join([str(Path(torchpose.__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
        start_new_session=True,
    )
