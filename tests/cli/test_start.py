"""What a command imports before its first frame: imports are the longer part of a short run."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import torch

from torchpose.camera import Camera

# modules that cost between 50 ms and seconds, and that no frame of a PNG folder needs
HEAVY = (
    "kornia",
    "matplotlib",
    "pandas",
    "pyarrow",
    "rich",
    "scipy",
    "skimage",
    "sympy",
    "torch._dynamo",
    "torch._inductor",
)
CODE = """
import sys
from torchpose.cli.main import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    print(end.code, *[name for name in {names} if name in sys.modules])
"""


def imported(names: tuple[str, ...], *words: str) -> list[str]:
    """Exit code of a command in a process of its own, and which of the modules it has imported."""
    command = [sys.executable, "-c", CODE.format(names=names), *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[-1 - len(names) :]


def test_the_help_needs_no_torch() -> None:
    assert imported(("torch", "numpy", "cv2", "pydantic"), "--version")[2:] == ["0"]


def test_estimate_imports_nothing_heavy_besides_torch(tmp_path: Path) -> None:
    matrix = torch.tensor([[100.0, 0, 31.5], [0, 100, 23.5], [0, 0, 1]], dtype=torch.float64)
    Camera(64, 48, matrix, torch.zeros(4, dtype=torch.float64)).save(tmp_path / "camera.yaml")
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((48, 64), np.uint8))
    words = [str(tmp_path / "0.png"), "--camera", str(tmp_path / "camera.yaml"), "--target", "quad40"]
    found = imported(("torch", *HEAVY), "estimate", *words, "--out", str(tmp_path / "poses.csv"), "--quiet")
    assert found == ["0", "torch"]
