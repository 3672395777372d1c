"""Every place where kornia could do what torchpose does: digits and time of both, with what was chosen.

    python scripts/bench_kornia.py --out docs/kornia.md   # writes its table anew
    python scripts/bench_kornia.py --only decoding --rounds 3

Times are medians of the processor's time over `--rounds` rounds in which ours and kornia's take turns, one thread;
`ratio` is the median of kornia's over ours of the same round, below 1 where kornia is faster. `difference` is the
largest one between both, or of each to the truth where there is one. The rows on the reader are seconds on the clock,
decoding and measuring side by side: kornia_rs holds the interpreter while it decodes, OpenCV does not.
"""

from __future__ import annotations

import argparse
import math
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import kornia
import numpy as np
import torch
from kornia.geometry import conversions
from kornia.geometry.liegroup import So3
from torch import Tensor, nn

import torchpose as tp
from torchpose.detect import find_candidates, reduce
from torchpose.geometry import rotations
from torchpose.geometry.grey import grey
from torchpose.io import images
from torchpose.io.images.native import FLAGS
from torchpose.io.reader import FrameReader, default_batch, in_batches
from torchpose.io.sources import find_sources
from torchpose.pnp import solve
from torchpose.sim import Lighting, add_noise, render

F64 = torch.float64
SIZES = {"2 MP": (1824, 1216, 1111.11), "20 MP": (5472, 3648, 3333.33)}
HEADER = ("place", "case", "ours, ms", "kornia, ms", "ratio", "difference", "chosen")
Row = tuple[str, ...]
Work = Callable[[], Any]


class Bench:
    """Times pairs of functions and writes them as rows of the table."""

    def __init__(self, rounds: int) -> None:
        self.rounds = rounds

    def row(self, place: str, case: str, ours: Work, theirs: Work, difference: str, chosen: str) -> Row:
        """One row; both functions run once before they are timed."""
        ours(), theirs()
        pairs = [(self._ms(ours), self._ms(theirs)) for _ in range(self.rounds)]
        a, b = (statistics.median(times) for times in zip(*pairs, strict=True))
        ratio = statistics.median(y / x for x, y in pairs)
        return place, case, f"{a:.3g}", f"{b:.3g}", f"{ratio:.2f}", difference, chosen

    @staticmethod
    def _ms(work: Work) -> float:
        """Milliseconds of one call, of at least 20 ms of them."""
        calls, start = 0, time.process_time()
        while (spent := time.process_time() - start) < 0.02:
            work()
            calls += 1
        return 1e3 * spent / max(1, calls)


def camera_of(label: str) -> tp.Camera:
    width, height, focal = SIZES[label]
    return tp.Camera.ideal(width, height, focal)


def scene(label: str) -> tuple[Tensor, tp.Camera]:
    """(1, H, W) uint8 of quad40 with noise 2, and its camera."""
    camera = camera_of(label)
    R, t = rotations.exp(torch.tensor([[0.3, 0.1, 0.2]], dtype=F64)), torch.tensor([[2.0, -1, 165]], dtype=F64)
    return add_noise(render(camera, tp.Target.load("quad40"), R, t, plate=(70.0, 70.0)), 2.0), camera


def worst(a: Any, b: Any) -> str:
    """Largest difference of two arrays."""
    a, b = (torch.as_tensor(np.asarray(x).astype(np.float64)) for x in (a, b))
    largest = float((a - b).abs().max())
    return "none" if largest == 0 else f"{largest:.1g}"


def decoding(bench: Bench) -> Iterator[Row]:
    """PNG of 8 and 16 bits, of both sizes, and how long kornia_rs keeps other threads waiting."""
    from kornia_rs import io

    for label in SIZES:
        frame = scene(label)[0][0].numpy()
        for bits, image in ((8, frame), (16, frame.astype(np.uint16) << 4)):
            for name, options in (("default", []), ("Paeth", [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_PAETH])):
                data = cv2.imencode(".png", image, options)[1].tobytes()
                difference = worst(image, by_kornia(data))
                yield bench.row(
                    "PNG",
                    f"{label}, {bits} bit, OpenCV's encoder, {name} filters",
                    partial(by_opencv, data),
                    partial(by_kornia, data),
                    difference,
                    "kornia",
                )
        jpeg = cv2.imencode(".jpg", frame)[1].tobytes()
        yield bench.row(
            "JPEG",
            f"{label}, grey",
            partial(by_opencv, jpeg),
            partial(io.decode_image_jpegturbo, jpeg, "mono"),
            worst(by_opencv(jpeg), io.decode_image_jpegturbo(jpeg, "mono")[..., 0]),
            "kornia: refuses damage",
        )
    png = cv2.imencode(".png", frame)[1].tobytes()
    spent = statistics.median(Bench._ms(partial(images.png.read_header, png)) for _ in range(bench.rounds))
    yield "PNG, checksums of the chunks", "20 MP, 8 bit; part of kornia's time above", "", f"{spent:.3g}", "", "", ""
    held = [1e3 * longest_wait(work) for work in (lambda: by_opencv(png), lambda: by_kornia(png))]
    yield "PNG, interpreter held", "20 MP, longest wait of another thread", *(f"{ms:.0f}" for ms in held), "", "", ""


def by_opencv(data: bytes) -> Any:
    return cv2.imdecode(np.frombuffer(data, np.uint8), FLAGS)


def by_kornia(data: bytes) -> Any:
    return images.png.decode(data, images.png.read_header(data), threads=1)


def longest_wait(work: Work) -> float:
    """Longest time in seconds that a busy Python thread waits while ``work`` runs in another."""
    running, waits = True, [0.0]

    def spin() -> None:
        last = time.perf_counter()
        while running:
            now = time.perf_counter()
            waits.append(now - last)
            last = now

    thread = threading.Thread(target=spin)
    thread.start()
    time.sleep(0.05)
    waits.clear()
    work()
    longest = max(waits)
    running = False
    thread.join()
    return longest


def reading(bench: Bench) -> Iterator[Row]:
    """`FrameReader` with `PoseEstimator` on its frames: milliseconds a frame on the clock."""
    for label in SIZES:
        frame, camera = scene(label)
        estimator = tp.PoseEstimator(camera, tp.Target.load("quad40"))
        count = 32 if label == "2 MP" else 12
        with tempfile.TemporaryDirectory() as folder:
            for i in range(count):
                cv2.imwrite(f"{folder}/{i:02d}.png", frame[0].numpy())
            for threads in (1, 2, 4):
                pairs = [
                    (read_all(estimator, folder, 0, threads), read_all(estimator, folder, 99, threads))
                    for _ in range(max(3, bench.rounds // 2))
                ]
                a, b = (statistics.median(times) for times in zip(*pairs, strict=True))
                ratio = statistics.median(y / x for x, y in pairs)
                chosen = "kornia" if threads <= 2 else "ours: free of the interpreter"
                case = f"{label}, {threads} decoding threads, on the clock"
                yield "reader and estimator", case, f"{a:.1f}", f"{b:.1f}", f"{ratio:.2f}", "none", chosen


def read_all(estimator: tp.PoseEstimator, folder: str, holders: int, threads: int) -> float:
    """Milliseconds a frame of a folder, by kornia_rs where there are at most so many ``holders``."""
    width, height = estimator.camera.width, estimator.camera.height
    sources = find_sources([Path(folder)])
    before, images.png._HOLDERS = images.png._HOLDERS, holders
    start = time.perf_counter()
    for batch in FrameReader(in_batches(sources, default_batch(width, height)), width, height, threads=threads):
        for _, frames in batch.groups:
            estimator(frames)
    images.png._HOLDERS = before
    return 1e3 * (time.perf_counter() - start) / len(sources)


def turning(bench: Bench) -> Iterator[Row]:
    """Rotations: digits near zero and half a turn, and time for few and many."""
    generator = torch.Generator().manual_seed(0)
    axis = nn.functional.normalize(torch.randn(500, 3, generator=generator, dtype=F64), dim=-1)
    pairs: dict[str, tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]]] = {
        "exp": (rotations.exp, conversions.axis_angle_to_rotation_matrix),
        "exp, So3": (rotations.exp, lambda v: So3.exp(v).matrix()),
        "log": (rotations.log, conversions.rotation_matrix_to_axis_angle),
        "log, So3": (rotations.log, lambda R: So3.from_matrix(R).log()),
        "quaternion": (rotations.quaternion, conversions.rotation_matrix_to_quaternion),
        "skew": (rotations.skew, conversions.vector_to_skew_symmetric_matrix),
    }
    for name, (ours, theirs) in pairs.items():
        takes_vector = name.startswith(("exp", "skew"))
        largest = 0.0
        for angle in (0.0, 1e-12, 1e-8, 1e-4, 0.3, 2.0, math.pi - 1e-4, math.pi - 1e-9):
            given = angle * axis if takes_vector else rotations.exp(angle * axis)
            a, b = ours(given), theirs(given)
            if name == "quaternion":
                b = torch.where(b[:, :1] < 0, -b, b)
            largest = max(largest, float((a - b).abs().max()))
        for count in (1, 100, 65536):
            vector = axis[torch.arange(count) % 500] * torch.rand(count, 1, generator=generator, dtype=F64)
            given = vector if takes_vector else rotations.exp(vector)
            yield bench.row(
                f"rotations, {name}",
                f"{count}",
                partial(ours, given),
                partial(theirs, given),
                f"{largest:.0e}",
                "ours: time of few, import",
            )


def geometry(bench: Bench) -> Iterator[Row]:
    """Projection, undistortion, rigid transforms and PnP."""
    camera = tp.Camera(1824, 1216, camera_of("2 MP").matrix, [-0.3, 0.12, 1e-3, -2e-3])
    generator = torch.Generator().manual_seed(1)
    pixels = torch.rand(10_000, 2, generator=generator, dtype=F64) * torch.tensor([1823.0, 1215.0], dtype=F64)
    eye = torch.eye(3, dtype=F64)[None]

    def theirs() -> Tensor:
        matrix, distortion = camera.matrix[None], camera.distortion[None]
        return kornia.geometry.calibration.undistort_points(pixels[None], matrix, distortion, eye)[0]

    ours_px, theirs_px = (
        float((camera.distort(xy) - pixels).norm(dim=-1).max()) for xy in (camera.undistort_points(pixels), theirs())
    )
    yield bench.row(
        "undistort_points",
        "10,000, k1 -0.3",
        lambda: camera.undistort_points(pixels),
        theirs,
        f"back in px: ours {ours_px:.0e}, kornia's {theirs_px:.0e}",
        "ours: to rounding",
    )
    ideal = camera_of("2 MP")
    R = rotations.exp(0.3 * torch.randn(100, 3, generator=generator, dtype=F64))
    t = torch.tensor([0.0, 0, 160], dtype=F64) + torch.randn(100, 3, generator=generator, dtype=F64)
    points = torch.tensor([[-20.0, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]], dtype=F64)
    pinhole, many = ideal.pinhole(R, t), points.expand(100, 4, 3)

    def project() -> Tensor:
        return ideal.project(points @ R.mT + t[:, None])

    yield bench.row(
        "PinholeCamera.project",
        "100 poses of 4 points",
        project,
        lambda: pinhole.project(many),
        worst(project(), pinhole.project(many)),
        "ours: distortion, Jacobians",
    )
    four = torch.eye(4, dtype=F64).repeat(100, 1, 1)
    four[:, :3, :3], four[:, :3, 3] = R, t
    compose = kornia.geometry.linalg.compose_transformations
    yield bench.row(
        "compose_transformations",
        "100",
        lambda: rotations.compose(R, t, R, t),
        lambda: compose(four, four),
        worst(rotations.compose(R, t, R, t)[1], compose(four, four)[:, :3, 3]),
        "ours",
    )
    solid = 20 * torch.randn(9, 3, generator=generator, dtype=F64)
    seen = ideal.project(solid @ R.mT + t[:, None]) + 0.1 * torch.randn(100, 9, 2, generator=generator, dtype=F64)
    matrix = ideal.matrix.expand(100, 3, 3)
    dlt = kornia.geometry.solve_pnp_dlt
    errors = [
        float((found - t).norm(dim=-1).square().mean().sqrt())
        for found in (solve(solid, seen, ideal).t, dlt(solid.expand(100, 9, 3), seen, matrix)[:, :, 3])
    ]
    yield bench.row(
        "solve_pnp_dlt",
        "100 of 9 points, solid, noise 0.1 px",
        lambda: solve(solid, seen, ideal),
        lambda: dlt(solid.expand(100, 9, 3), seen, matrix),
        f"RMS error, mm: ours {errors[0]:.3f}, kornia's {errors[1]:.3f}",
        "ours: planes, covariance",
    )


def pictures(bench: Bench) -> Iterator[Row]:
    """Luma, area reduction, and kornia's edge detector in place of the detector's."""
    frame, _ = scene("2 MP")
    colour = frame[:, None].repeat(1, 3, 1, 1)
    wide = colour[0].permute(1, 2, 0).contiguous().numpy()
    yield bench.row(
        "rgb_to_grayscale",
        "2 MP uint8; ours is cv2.cvtColor",
        lambda: cv2.cvtColor(wide, cv2.COLOR_RGB2GRAY),
        lambda: grey(colour),
        worst(cv2.cvtColor(wide, cv2.COLOR_RGB2GRAY), grey(colour)[0]),
        "kornia: batches, devices",
    )
    value = frame[:, None].float() / 255
    yield bench.row(
        "Canny",
        "2 MP; ours is find_candidates, ellipses included",
        lambda: find_candidates(frame),
        lambda: kornia.filters.canny(value),
        "pixels, no ellipses",
        "ours",
    )
    small = kornia.geometry.transform.resize
    yield bench.row(
        "resize, area",
        "2 MP by 4",
        lambda: reduce.area_reduce(frame, 4),
        lambda: small(value, (304, 456), interpolation="area"),
        worst(reduce.area_reduce(frame, 4)[0], 255 * small(value, (304, 456), interpolation="area")[0, 0]),
        "ours",
    )
    for name, module in (
        ("MedianBlur 3", kornia.filters.MedianBlur((3, 3))),
        ("GaussianBlur2d 5", kornia.filters.GaussianBlur2d((5, 5), (0.7, 0.7))),
    ):
        plain = value[0, 0].numpy()
        ours: Work = partial(cv2.medianBlur, plain, 3)
        if "Gaussian" in name:
            ours = partial(cv2.GaussianBlur, plain, (5, 5), 0.7, borderType=cv2.BORDER_REFLECT_101)
        difference = worst(ours()[1:-1, 1:-1], module(value)[0, 0, 1:-1, 1:-1])
        yield bench.row(
            f"filters.{name}",
            "2 MP; ours is OpenCV",
            ours,
            partial(module, value),
            difference,
            "kornia: in Sequential",
        )


def faults(bench: Bench) -> Iterator[Row]:
    """What the simulated camera does, beside the augmentations of the same name."""
    frame, camera = scene("2 MP")
    clean = frame.float()
    value = clean[:, None] / 255
    augment = kornia.augmentation
    R, t = torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0, 160]], dtype=F64)
    target = tp.Target.load("quad40")
    noise = augment.RandomGaussianNoise(std=2 / 255, p=1.0)
    yield bench.row(
        "RandomGaussianNoise",
        "2 MP, sigma 2",
        lambda: add_noise(clean, 2.0),
        lambda: noise(value),
        "no shot noise, depth of the batch",
        "ours: EMVA 1288, a frame's own chance",
    )
    sharp = render(camera, target, R, t, psf_sigma=0.3, plate=(70.0, 70.0))
    blurred = render(camera, target, R, t, psf_sigma=0.7, plate=(70.0, 70.0))
    blur = augment.RandomGaussianBlur((9, 9), (math.sqrt(0.4),) * 2, p=1.0)
    yield bench.row(
        "RandomGaussianBlur",
        "2 MP; ours is the rendering with it",
        lambda: render(camera, target, R, t, psf_sigma=0.7, plate=(70.0, 70.0)),
        lambda: blur(sharp[:, None]),
        f"{worst(blurred[0], blur(sharp[:, None])[0, 0])} grey levels",
        "ours: integrals, not samples",
    )
    path = torch.tensor([[0.5, 0, 0, 0, 0, 0]], dtype=F64)
    moved = render(camera, target, R, t, motion=path, plate=(70.0, 70.0))
    still = render(camera, target, R, t, plate=(70.0, 70.0))
    motion = augment.RandomMotionBlur(kernel_size=3, angle=0.0, direction=0.0, p=1.0)
    yield bench.row(
        "RandomMotionBlur",
        "2 MP, 3.5 px; ours is the rendering with it",
        lambda: render(camera, target, R, t, motion=path, plate=(70.0, 70.0)),
        lambda: motion(still[:, None]),
        f"{worst(moved[0], motion(still[:, None])[0, 0])} grey levels",
        "ours: paths in space, parts of a pixel",
    )
    light = Lighting(gradient=(0.15, 0.0))
    linear = augment.RandomLinearIllumination(gain=(0.15, 0.15), sign=(1.0, 1.0), p=1.0)
    yield bench.row(
        "RandomLinearIllumination",
        "2 MP",
        lambda: clean * light.gain(camera, R, t),
        lambda: linear(value),
        "adds where light multiplies",
        "ours",
    )
    jpeg = augment.RandomJPEG(jpeg_quality=(90.0, 90.0), p=1.0)
    colour = value.repeat(1, 3, 1, 1)

    def through_opencv() -> Any:
        return by_opencv(cv2.imencode(".jpg", frame[0].numpy(), [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())

    yield bench.row(
        "RandomJPEG",
        "2 MP, quality 90; ours is OpenCV's codec",
        through_opencv,
        lambda: jpeg(colour),
        f"{worst(through_opencv(), 255 * grey(jpeg(colour))[0])} grey levels",
        "neither: colour alone",
    )
    for name, options in (
        ("RandomSaltAndPepperNoise", {"amount": (0.001, 0.001)}),
        ("RandomErasing", {"scale": (0.001, 0.002), "value": 0.2}),
        ("RandomGaussianIllumination", {"gain": (0.1, 0.2)}),
        ("RandomPlasmaShadow", {"shade_intensity": (-0.4, -0.2)}),
    ):
        module = getattr(augment, name)(**options, p=1.0)
        module(value)
        spent = statistics.median(Bench._ms(partial(module, value)) for _ in range(bench.rounds))
        yield name, "2 MP", "", f"{spent:.3g}", "", "ours has none", "kornia: `faults` of a plan"


def starting(bench: Bench) -> Iterator[Row]:
    """Seconds on the clock that the imports cost."""
    for module in ("kornia_rs.io", "kornia.geometry.conversions", "kornia"):
        clock = "time.perf_counter()"
        command = f"import time, torch, numpy\nstart = {clock}\nimport {module}\nprint({clock} - start)"
        times = [
            float(subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True).stdout)
            for _ in range(max(3, bench.rounds // 2))
        ]
        yield (
            f"import {module}",
            "after torch, on the clock",
            "",
            f"{1e3 * statistics.median(times):.0f}",
            "",
            "",
            "where used",
        )


PARTS = {f.__name__: f for f in (decoding, reading, turning, geometry, pictures, faults, starting)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--out", type=Path, help="page whose table, between two marks, is written anew")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    lines = [
        f"Made by `scripts/bench_kornia.py`; Python {platform.python_version()}, torch {torch.__version__}, kornia "
        f"{version('kornia')}, kornia_rs {version('kornia_rs')}, OpenCV {cv2.__version__}, {os.cpu_count()} cores, one "
        f"thread, {options.rounds} rounds.",
        "",
        f"| {' | '.join(HEADER)} |",
        "| " + "--- | " * len(HEADER),
    ]
    bench = Bench(options.rounds)
    for name in options.only:
        for row in PARTS[name](bench):
            lines.append(f"| {' | '.join(row)} |")
            print(lines[-1], flush=True)
    if options.out:
        before, _, rest = options.out.read_text(encoding="utf-8").partition("<!-- table -->\n")
        after = rest.partition("<!-- end -->\n")[2]
        text = "\n".join(line.rstrip() for line in lines)
        options.out.write_text(f"{before}<!-- table -->\n{text}\n<!-- end -->\n{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
