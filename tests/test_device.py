"""What a GPU needs, shown on the CPU: tensors are made where the frames are, and waiting for it is rare."""

import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from tests.devices import DeviceNamed
from torchpose.camera import Camera
from torchpose.cli.main import main
from torchpose.geometry import rotations
from torchpose.pipeline import Method, PoseEstimator
from torchpose.sim import add_noise, render
from torchpose.target import Target

STAGES = (
    *("camera", "detect", "ellipse.py", "geometry", "identify", "kernels"),
    *("pipeline.py", "pnp", "pose", "refine", "results.py", "rings"),
)
# operations whose result or its shape depends on numbers: a GPU is waited for
WAITS = {
    *("_local_scalar_dense", "nonzero", "masked_select", "_unique2", "unique_dim", "unique_consecutive"),
    *("repeat_interleave", "equal", "bincount"),
}
MOST_WAITS = 560  # of a batch of clean frames (measured here: 498 of one frame, 535 of eight)
F64 = torch.float64
CAMERA = Camera(
    640, 480, torch.tensor([[700.0, 0, 319.5], [0, 700, 239.5], [0, 0, 1]], dtype=F64), torch.zeros(4, dtype=F64)
)


@pytest.fixture(scope="module")
def frames() -> Tensor:
    k = torch.arange(4, dtype=F64)
    R = rotations.exp(torch.stack([0.1 * k, 0.3 - 0.1 * k, 0.4 * k], -1))
    t = torch.stack([2 * k, -k, 200 + 5 * k], -1)
    return add_noise(render(CAMERA, Target.load("quad40"), R, t), 2.0, seed=5)


@pytest.mark.parametrize("method", ["photometric", "edges", "paper"])
def test_every_stage_makes_its_tensors_where_the_frames_are(frames: Tensor, method: Method) -> None:
    estimator = PoseEstimator(CAMERA, "quad40", method=method)
    poses = estimator(frames)  # tables that are made once come with it
    with DeviceNamed(*STAGES):
        again = estimator(frames, near=poses)
    assert again.ok.all()


class Waits(TorchDispatchMode):
    """Counts operations that a GPU would be waited for."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # of torch
        self.count: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        by_truth = name in ("index", "index_put", "index_put_") and any(
            i is not None and i.dtype == torch.bool for i in args[1]
        )
        if name in WAITS or by_truth:
            self.count[name] += 1
        return func(*args, **(kwargs or {}))


def test_the_number_of_waits_does_not_grow_with_the_batch(frames: Tensor) -> None:
    estimator = PoseEstimator(CAMERA, "quad40")
    counts = []
    for size in (1, 4):
        with Waits() as waits:
            assert estimator(frames[:size]).ok.all()
        counts.append(waits.count.total())
    assert counts[1] <= MOST_WAITS
    assert counts[1] < 1.25 * counts[0]


def test_without_a_gpu_the_check_says_so_in_a_line() -> None:
    if torch.cuda.is_available():
        pytest.skip("there is one")
    script = Path(__file__).parents[1] / "scripts" / "check_gpu.py"
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=True)
    assert done.stdout == "check_gpu: torch finds no CUDA device here; nothing was checked\n"


@pytest.mark.parametrize(
    ("name", "words"), [("tpu", "tpu is not known; give cpu or cuda"), ("cuda", "torch finds no CUDA device here")]
)
def test_a_device_that_is_not_there_is_one_line(
    name: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    options = ["--camera", "camera.yaml", "--target", "quad40", "--out", str(tmp_path / "poses.csv")]
    with pytest.raises(SystemExit) as end:
        main(["estimate", str(tmp_path), *options, "--device", name])
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"torchpose: error: --device: {words}")
