"""Detection against contrast, noise, blur, size, tilt and cover, beside other detectors; false alarms in noise.

    python scripts/bench_detection.py [--frames 16] [--seed 0] [--only blur noise]
    python scripts/bench_detection.py --noise-frames 10000
    python scripts/bench_detection.py --megapixels 20
    python scripts/bench_detection.py --clutter [--scale 3]

Frames are rendered with the target quad40 on the 2 MP camera; a marker counts as found if an ellipse lies within
0.3 semi-minor axes of its outer circle and within 20 % of its size. Given are recall of the outer circles, ellipses
that lie on none of the circles (a frame), RMS error of the centres (px), and CPU time a frame over that of torchpose,
by one thread. The peers get their usual settings, none of them tuned; ringgrid (optional, `pip install ringgrid`) is
told a plain target of 2 x 2 rings and their ratio 0.4. findCirclesGrid is told the 2 x 2 grid and gives centres alone.
scikit-image's hough_ellipse votes with pairs of all edge pixels, hours for a frame of 2 MP, and is left out; its RANSAC
fits ellipses to the contours of OpenCV's Canny edges.

--noise-frames counts single ellipses, and rings, in frames of noise alone, half of them white, half correlated, 320 x
240 px. --megapixels 20 times candidates alone, 8 large frames at once, and gives their memory. --clutter times the
candidates of single frames whose plate lies among 0 to 1,000 discs, 10,000 specks, or before pictures of scikit-image:
all of them, and those that the estimator asks for, beside OpenCV's ArUco detector and AprilTag 3 (optional, `pip
install pupil_apriltags`; no decimation, one thread) on the same frame; --scale 3 makes frames of 20 megapixels of it.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from torchpose.camera import Camera
from torchpose.detect import Wanted, find_candidates, find_coarse
from torchpose.detect.reduce import reduction_factor
from torchpose.geometry import conics, rotations
from torchpose.rings import measure_rings
from torchpose.sim import add_noise, render
from torchpose.target import Target

Detector = Callable[[np.ndarray], np.ndarray]  # frame (H, W) uint8 -> ellipses (M, 5)
F64 = torch.float64


@dataclass(frozen=True)
class Condition:
    """One point of a sweep; the defaults are the easy case."""

    distance: float = 160.0  # mm
    tilt: float = 20.0  # deg
    psf: float = 0.8  # px
    noise: float = 2.0
    dark: float = 30.0
    light: float = 220.0
    cover: float = 0.0  # of the perimeter of every ring


SWEEPS: dict[str, list[tuple[str, Condition]]] = {
    "contrast": [(f"{c}", Condition(dark=20.0, light=20.0 + c)) for c in (190, 60, 30, 15)],
    "noise": [(f"{n}", Condition(noise=float(n))) for n in (0, 2, 8, 16)],
    "blur": [(f"{p}", Condition(psf=p)) for p in (0.5, 1.0, 2.0, 4.0)],
    "size": [(f"{z}", Condition(distance=z)) for z in (80.0, 160.0, 400.0, 800.0)],
    "tilt": [(f"{t}", Condition(tilt=float(t))) for t in (0, 30, 50, 60, 70)],
    "cover": [(f"{c}", Condition(cover=c)) for c in (0.0, 0.1, 0.2, 0.35)],
}


def camera(scale: int = 1) -> Camera:
    """The 2 MP camera, or the same with ``scale`` times the pixels along each side."""
    f, width, height = 1111.11 * scale, 1824 * scale, 1216 * scale
    k = [[f, 0.0, (width - 1) / 2], [0.0, f, (height - 1) / 2], [0.0, 0.0, 1.0]]
    return Camera(width=width, height=height, matrix=torch.tensor(k, dtype=F64), distortion=torch.zeros(4, dtype=F64))


def scenes(
    lens: Camera, target: Target, condition: Condition, count: int, seed: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """Frames (H, W) uint8 with the outer and inner ellipses (M, 2, 5) of their markers."""
    rng = np.random.default_rng(seed)
    for number in range(count):
        azimuth, roll = rng.uniform(0, 2 * math.pi, 2)
        tilt = math.radians(condition.tilt)
        lean = torch.tensor([[tilt * math.cos(azimuth), tilt * math.sin(azimuth), 0.0]], dtype=F64)
        r = rotations.exp(lean) @ rotations.exp(torch.tensor([[0.0, 0.0, roll]], dtype=F64))
        z = condition.distance
        t = torch.tensor([[rng.uniform(-0.08, 0.08) * z, rng.uniform(-0.04, 0.04) * z, z]], dtype=F64)
        clean = render(lens, target, r, t, psf_sigma=condition.psf, dark=condition.dark, light=condition.light)
        truth = circles(lens, target, r, t)
        covered = cover(clean[0].numpy(), truth[:, 0], condition, rng)
        yield add_noise(torch.from_numpy(covered)[None], condition.noise, seed + number)[0], truth


def circles(lens: Camera, target: Target, r: Tensor, t: Tensor) -> Tensor:
    """Projected circles (M, 2, 5) of every marker."""
    center = (r @ target.centers[..., None]).squeeze(-1) + t
    return conics.circle_ellipse(lens.matrix, r[:, None], center[:, None], target.normals[:, None], target.radii)


def cover(frame: np.ndarray, outer: Tensor, condition: Condition, rng: np.random.Generator) -> np.ndarray:
    """The frame with a half plane over each ring, blurred like the rest."""
    for ellipse in outer if condition.cover else ():
        angle = rng.uniform(0, 2 * math.pi)
        along = np.array([math.cos(angle), math.sin(angle)])
        across, near = np.array([-along[1], along[0]]), math.cos(math.pi * condition.cover)
        corners = [along * near - across, along * near + across, along * 1.3 + across, along * 1.3 - across]
        points = np.array(corners) @ conics.shape_matrix(ellipse).numpy().T + ellipse[:2].numpy()
        mask = np.zeros(frame.shape, np.uint8)
        cv2.fillPoly(mask, [np.round(points * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
        weight = cv2.GaussianBlur(mask.astype(np.float32) / 255, (0, 0), condition.psf)
        grey = rng.uniform(condition.dark, condition.light)
        frame = frame * (1 - weight) + grey * weight
    return frame.astype(np.float32)


def ours(frame: np.ndarray) -> np.ndarray:
    return find_candidates(torch.from_numpy(frame)[None]).ellipse.numpy()


def blob_detector() -> cv2.SimpleBlobDetector:
    """By its own defaults, but for size and for the colour at the centre, where a ring has a hole."""
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.maxArea, parameters.filterByColor = 1e6, False
    return cv2.SimpleBlobDetector.create(parameters)


def blobs(frame: np.ndarray) -> np.ndarray:
    found = blob_detector().detect(frame)
    return np.array([[*k.pt, k.size / 2, k.size / 2, 0.0] for k in found]).reshape(-1, 5)


def hough(frame: np.ndarray) -> np.ndarray:
    found = cv2.HoughCircles(cv2.GaussianBlur(frame, (0, 0), 1.5), cv2.HOUGH_GRADIENT, 1.5, 10)
    rows = [] if found is None else [[u, v, r, r, 0.0] for u, v, r in found.reshape(-1, 3)]
    return np.array(rows).reshape(-1, 5)


def contours(frame: np.ndarray) -> np.ndarray:
    """Otsu's threshold, contours, direct ellipse fits; those with an area unlike their ellipse's are left out."""
    _, binary = cv2.threshold(frame, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    rows = []
    for contour in cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
        if len(contour) < 12:
            continue
        (u, v), (first, second), angle = cv2.fitEllipseDirect(contour)
        area = math.pi * first * second / 4
        if area > 0 and abs(cv2.contourArea(contour) / area - 1) < 0.1:
            rows.append([u, v, max(first, second) / 2, min(first, second) / 2, math.radians(angle)])
    return np.array(rows).reshape(-1, 5)


def grid(frame: np.ndarray) -> np.ndarray:
    """OpenCV's symmetric circle grid of 2 x 2; sizes are not given."""
    found, centers = cv2.findCirclesGrid(frame, (2, 2), flags=cv2.CALIB_CB_SYMMETRIC_GRID, blobDetector=blob_detector())
    rows = [[u, v, math.nan, math.nan, 0.0] for u, v in centers.reshape(-1, 2)] if found else []
    return np.array(rows).reshape(-1, 5)


def ransac(frame: np.ndarray) -> np.ndarray:
    """scikit-image's RANSAC with an ellipse model, on every contour of OpenCV's Canny edges."""
    from skimage.measure import EllipseModel
    from skimage.measure import ransac as fit_ransac

    edges = cv2.Canny(cv2.GaussianBlur(frame, (0, 0), 1.0), 40, 80)
    rows = []
    for contour in cv2.findContours(edges, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
        points = np.unique(contour[:, 0].astype(float), axis=0)
        if len(points) < 20:
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                model, inliers = fit_ransac(points, EllipseModel, 6, 1.0, max_trials=50, rng=0)
            except TypeError:  # scikit-image 0.26: some samples give the model a complex angle
                continue
        if model is None or inliers is None or inliers.mean() < 0.7:
            continue
        (u, v), (a, b) = model.center, model.axis_lengths
        rows.append([u, v, max(a, b), min(a, b), 0.0])
    return np.array(rows).reshape(-1, 5)


def ringgrid_detector() -> Detector:
    import ringgrid

    layout = ringgrid.TargetLayout(
        "quad", ringgrid.RectGeometry(2, 2, 40.0), ringgrid.RingGeometry(5.0, 2.0), ringgrid.Plain()
    )
    detector = ringgrid.Detector(ringgrid.DetectConfig(layout))

    def detect(frame: np.ndarray) -> np.ndarray:
        outer = [m.ellipse_outer for m in detector.detect(frame).detected_markers if m.ellipse_outer]
        return np.array([[e.cx, e.cy, e.a, e.b, e.angle] for e in outer]).reshape(-1, 5)

    return detect


def detectors() -> dict[str, Detector]:
    peers: dict[str, Detector] = {
        "torchpose": ours,
        "SimpleBlobDetector": blobs,
        "findCirclesGrid": grid,
        "HoughCircles": hough,
        "contours+fitEllipseDirect": contours,
        "Canny+RANSAC (skimage)": ransac,
    }
    if importlib.util.find_spec("ringgrid"):
        peers["ringgrid"] = ringgrid_detector()
    return peers


def judge(found: np.ndarray, truth: Tensor) -> tuple[int, int, list[float]]:
    """Outer circles found, ellipses on none of the circles, and centre errors in px."""
    if len(found) == 0:
        return 0, 0, []
    ellipses, all_circles = torch.from_numpy(found), truth.flatten(0, 1)
    miss = torch.linalg.vector_norm(ellipses[:, None, :2] - all_circles[:, :2], dim=-1)
    size = ((ellipses[:, None, 2] * ellipses[:, None, 3]) / (all_circles[:, 2] * all_circles[:, 3])).sqrt()
    hit = (miss < 0.3 * all_circles[:, 3]) & (((size - 1).abs() < 0.2) | size.isnan())
    errors = torch.where(hit, miss, torch.inf).amin(0)[0::2]
    return int(errors.isfinite().sum()), int((~hit.any(1)).sum()), errors[errors.isfinite()].tolist()


def sweep(name: str, frames: int, seed: int, peers: dict[str, Detector]) -> None:
    lens, target = camera(), Target.load("quad40")
    for label, condition in SWEEPS[name]:
        made = list(scenes(lens, target, condition, frames, seed))
        own = math.nan
        for peer, detect in peers.items():
            errors: list[float] = []
            hits, false, start = 0, 0, time.process_time()
            results = [detect(frame.numpy()) for frame, _ in made]
            cpu = 1e3 * (time.process_time() - start) / len(made)
            for found, (_, truth) in zip(results, made, strict=True):
                some, wrong, miss = judge(found, truth)
                hits, false, errors = hits + some, false + wrong, errors + miss
            own = cpu if peer == "torchpose" else own
            recall = hits / (len(target) * len(made))
            rms = math.sqrt(sum(e * e for e in errors) / len(errors)) if errors else math.nan
            print(
                f"{name:9s} {label:>6s}  {peer:26s} recall {recall:6.3f}  false {false / len(made):6.2f}  "
                f"error {rms:7.4f} px  CPU {cpu / own:6.2f}"
            )


def noise_frames(count: int, seed: int) -> None:
    """Ellipses and rings in frames of noise: sigma 1 to 30 grey levels, white or correlated over 0.7 to 2 px."""
    rng = np.random.default_rng(seed)
    lens = camera()
    for kind in ("white", "correlated"):
        frames, singles, rings = 0, 0, 0
        while frames < count // 2:
            some = min(40, count // 2 - frames)
            noise = rng.standard_normal((some, 240, 320), dtype=np.float32)
            if kind == "correlated":
                noise = gaussian_filter(noise, (0, *[rng.uniform(0.7, 2.0)] * 2))
                noise /= noise.std()
            sigma = np.exp(rng.uniform(0, math.log(30), (some, 1, 1))).astype(np.float32)
            batch = torch.from_numpy((128 + sigma * noise).round().clip(0, 255).astype(np.uint8))
            found = find_candidates(batch)
            frames, singles, rings = frames + some, singles + len(found), rings + len(measure_rings(batch, found, lens))
        print(f"{kind} noise, {frames} frames of 320 x 240: {singles} ellipses, {rings} rings", flush=True)


def resident_peak() -> int:
    """Largest resident memory of this process in bytes, from Linux."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split("VmHWM:")[1].split()[0])


def large(megapixels: float) -> None:
    """CPU time of the candidates of a batch of 8 large frames, median of five, and the memory they take."""
    scale = max(1, round(math.sqrt(megapixels / 2.2)))
    lens, target = camera(scale), Target.load("quad40")
    made = [frame for frame, _ in scenes(lens, target, Condition(), 2, 0)]
    batch = torch.stack(made * 4)
    find_candidates(batch[:, :200, :200].contiguous())
    Path("/proc/self/clear_refs").write_text("5")  # Linux: the peak counts from here
    before = resident_peak()
    times = []
    for _ in range(6):
        start = time.process_time()
        find_candidates(batch)
        times.append(1e3 * (time.process_time() - start) / len(batch))
    grown = resident_peak() - before
    reduced = batch.numel() / reduction_factor(lens.height, lens.width) ** 2
    print(
        f"candidates, 8 x {lens.width} x {lens.height}: {sorted(times[1:])[2]:.1f} ms CPU a frame, "
        f"peak memory {grown / reduced:.1f} bytes a reduced pixel"
    )


def discs(shape: tuple[int, int], count: int, radii: tuple[float, float]) -> np.ndarray:
    """A picture (H, W) of dark and light discs."""
    rng = np.random.default_rng(count)
    picture = np.full(shape, 128, np.uint8)
    for _ in range(count):
        x, y, radius = rng.uniform(0, shape[1]), rng.uniform(0, shape[0]), rng.uniform(*radii)
        cv2.circle(
            picture, (int(16 * x), int(16 * y)), int(16 * radius), int(rng.choice([20, 240])), -1, cv2.LINE_AA, 4
        )
    return picture


def surrounds(shape: tuple[int, int]) -> Iterator[tuple[str, np.ndarray]]:
    """What lies around the plate, by name."""
    import skimage.data

    for count in (0, 10, 50, 200, 1000):
        yield f"{count} discs", discs(shape, count, (3, 15))
    yield "10000 specks", discs(shape, 10_000, (1, 3))
    for name in (
        "camera",
        "page",
        "text",
        "coins",
        "brick",
        "grass",
        "gravel",
        "astronaut",
        "coffee",
        "chelsea",
        "moon",
    ):
        picture = getattr(skimage.data, name)()
        picture = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) if picture.ndim == 3 else picture
        yield name, cv2.resize(picture, shape[::-1])


def median_cpu(work: Callable[[], object], times: int = 5) -> float:
    """Median CPU time in ms, after one run that does not count."""
    spent = []
    for _ in range(times + 1):
        start = time.process_time()
        work()
        spent.append(1e3 * (time.process_time() - start))
    return sorted(spent[1:])[times // 2]


def clutter(scale: int) -> None:
    """CPU time of the candidates of one frame against what else is in it, beside detectors of tags."""
    lens, target = camera(scale), Target.load("quad40")
    asked = Wanted.of(torch.tensor([1.0], dtype=F64), 3.0)
    aruco = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    tags = None
    if importlib.util.find_spec("pupil_apriltags"):
        tags = importlib.import_module("pupil_apriltags").Detector(families="tag36h11", nthreads=1, quad_decimate=1.0)
    r = rotations.exp(torch.tensor([[0.3, -0.2, 0.5]], dtype=F64))
    t = torch.tensor([[5.0, -4.0, 160.0]], dtype=F64)
    for name, picture in surrounds((lens.height, lens.width)):
        around = torch.from_numpy(picture)[None].float()
        clean = render(lens, target, r, t, psf_sigma=0.8, dark=30.0, light=220.0, plate=(70.0, 70.0), surround=around)
        frames = add_noise(clean, 2.0, 0)
        grey = np.ascontiguousarray(frames[0].numpy())
        every, some = (median_cpu(partial(find_candidates, frames, wanted=w)) for w in (Wanted(), asked))
        coarse = median_cpu(partial(find_coarse, frames, wanted=asked))
        peers = [("ArUco", median_cpu(partial(aruco.detectMarkers, grey)))]
        peers += [("AprilTag 3", median_cpu(partial(tags.detect, grey)))] if tags else []
        found, wanted = len(find_candidates(frames)), len(find_candidates(frames, wanted=asked))
        beside = ", ".join(f"{coarse / cpu:.2f} and {some / cpu:.2f} of {peer} ({cpu:.0f} ms)" for peer, cpu in peers)
        print(
            f"{name:13s} all {found:4d} in {every:6.0f} ms, asked for {wanted:4d}: coarse {coarse:6.0f} ms, "
            f"whole {some:6.0f} ms: {beside}",
            flush=True,
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=16, help="of each condition")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", choices=sorted(SWEEPS), default=sorted(SWEEPS))
    parser.add_argument("--megapixels", type=float, help="time large frames instead")
    parser.add_argument("--noise-frames", type=int, help="count false alarms in so many frames of noise instead")
    parser.add_argument("--clutter", action="store_true", help="time single frames full of other things instead")
    parser.add_argument("--scale", type=int, default=1, help="of the frames of --clutter")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    if arguments.clutter:
        clutter(arguments.scale)
        return 0
    if arguments.megapixels:
        large(arguments.megapixels)
        return 0
    if arguments.noise_frames:
        noise_frames(arguments.noise_frames, arguments.seed)
        return 0
    peers = detectors()
    for name in arguments.only:
        sweep(name, arguments.frames, arguments.seed, peers)
    return 0


if __name__ == "__main__":
    sys.exit(main())
