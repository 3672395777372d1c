"""C++ to machine code: the compiler, and what it has made before."""

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path

import torch
from torch import Tensor

from torchpose.errors import ConfigError

_FLAGS = (
    "-std=c++17",
    "-O2",
    "-march=native" if platform.machine() in ("x86_64", "AMD64") else "-mcpu=native",
    "-ffp-contract=fast",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fPIC",
    "-shared",
)
# the threads of torch, which brings the same library for GCC; other compilers may have none
_THREADS = "-fopenmp"
# problems below which a second thread does not pay
_SHARE = 512


class Kernel:
    """A function of tensors that lie in memory as `Rows`, with the results among them."""

    def __init__(self, library: Path) -> None:
        code = ctypes.CDLL(str(library))
        self._run = code.kernel
        self._run.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int)
        self._run.restype = None

    def __call__(self, tensors: Sequence[Tensor], batch: int, limit: int = 1) -> None:
        data = [t.data_ptr() for t in tensors]
        strides = [s for t in tensors for s in t.stride()]
        threads = torch.get_num_threads() if batch >= _SHARE else 1
        pointers, steps = (ctypes.c_void_p * len(data))(*data), (ctypes.c_int64 * len(strides))(*strides)
        self._run(pointers, steps, batch, limit, threads)


def build(source: str) -> Kernel:
    """Compiles the source of a `Program`, unless this compiler has done so on such a processor before.

    Raises:
        ConfigError: there is no C++ compiler, or it fails, or there is no room for what it makes.
    """
    compiler = find_compiler()
    source = files("torchpose.kernels").joinpath("lanes.h").read_text() + source
    key = hashlib.sha256("\0".join((source, *_FLAGS, _target(compiler))).encode()).hexdigest()[:32]
    library = _folder() / f"{key}.so"
    try:
        if library.exists():
            try:
                return Kernel(library)
            except OSError:  # cut short, by a full disk say
                pass
        _compile(compiler, source, library)
        return Kernel(library)
    except OSError as error:
        raise ConfigError(f"compile: {library}: {error.strerror or error}; make room or use compile=False") from None


def _compile(compiler: str, source: str, library: Path) -> None:
    with tempfile.TemporaryDirectory(dir=library.parent) as scratch:
        text, made = Path(scratch, "kernel.cpp"), Path(scratch, "kernel.so")
        text.write_text(source)
        for flags in ((*_FLAGS, _THREADS), _FLAGS):
            run = subprocess.run([compiler, *flags, text, "-o", made], capture_output=True, text=True)
            if run.returncode == 0:
                break
        else:
            said = [line for line in run.stderr.splitlines() if "error" in line] or [f"exit code {run.returncode}"]
            raise ConfigError(f"compile: {compiler} failed: {said[0]}; use compile=False")
        os.replace(made, library)  # another process may be at the same


def has_compiler() -> bool:
    """Is there a C++ compiler?"""
    return _compiler() is not None


def find_compiler() -> str:
    """
    Raises:
        ConfigError: there is no C++ compiler.
    """
    if (path := _compiler()) is None:
        raise ConfigError("compile: needs a C++ compiler and found none; install g++ or clang++, or use compile=False")
    return path


def _compiler() -> str | None:
    names = (os.environ.get("CXX", ""), "g++", "clang++")
    return next((path for name in names if name and (path := shutil.which(name))), None)


@cache
def _target(compiler: str) -> str:
    """What distinguishes the code of this compiler, for this processor, from that of others."""
    command = [compiler, *_FLAGS, "-dM", "-E", "-x", "c++", os.devnull]
    return subprocess.run(command, capture_output=True, text=True).stdout


@cache
def _folder() -> Path:
    """Where kernels are kept: the user's cache, or, where this cannot be written, a folder for this process."""
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "torchpose", "kernels")
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except (OSError, RuntimeError):  # nobody's home
        return Path(tempfile.mkdtemp(prefix="torchpose-kernels-"))
