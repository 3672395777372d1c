"""Pictures that show at once what was found in a frame: fitted ellipses, ids, axes, status."""

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.config import is_inside
from torchpose.errors import ConfigError
from torchpose.io.writers import atomic_path
from torchpose.report.files import make_folder
from torchpose.results import Poses, Reason, Status
from torchpose.target import Target

Colour = tuple[int, int, int]

_GREEN, _AMBER, _RED = (60, 170, 40), (0, 150, 240), (50, 50, 220)  # blue, green, red, as OpenCV has them
_STATUS_COLOUR: dict[Status, Colour] = {Status.OK: _GREEN, Status.AMBIGUOUS: _AMBER}
_WHITE = (255, 255, 255)
_OUTER, _INNER, _CENTRE = (255, 200, 0), (255, 0, 220), (0, 230, 255)
_AXES: tuple[Colour, ...] = ((40, 40, 255), (40, 220, 40), (255, 110, 30))
_AXIS_POINTS = 33  # along an axis, so that distortion bends it
_SHIFT = 6  # OpenCV draws at 1/64 px
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # lossless, so that a line of a pixel stays one; low effort: noise packs badly
_LONGEST_NAME = 255  # bytes of a file's name in all usual file systems
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def picture_path(folder: Path, frame: str) -> Path:
    """Where the picture of a frame lies: the frame's relative path, with ``.png`` appended unless it ends so.

    Raises:
        ConfigError: that is not in the folder, or the name is longer than file systems have it.
    """
    path = folder / (frame if frame.lower().endswith(".png") else f"{frame}.png")
    if not is_inside(path, folder):
        problem = f"its picture would lie outside of {folder}"
        raise ConfigError(f"{frame}: --overlay: {problem}; give an INPUT whose frames lie in its own folder")
    if len(os.fsencode(path.name)) > _LONGEST_NAME:
        raise ConfigError(f"{frame}: --overlay: the name is too long for a picture's; shorten it")
    return path


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Writes a PNG file whole or not at all. ConfigError: it cannot be written."""
    with atomic_path(path, option="--overlay: ", fix="free some space", sync=False) as temporary:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(cv2.imencode(".png", picture, _PNG)[1].tobytes())


class Overlay:
    """Draws and writes the picture of each frame.

    Args:
        camera: as for `PoseEstimator`.
        targets: as for `PoseEstimator`.
        folder: where the pictures go, created if missing; only `write` needs it.
        threads: pictures that are drawn and written side by side.
        place: R (3, 3), t (3,) mm, from the axes of the poses to those of the camera.

    Raises:
        ConfigError: the folder cannot be created or written.
    """

    def __init__(
        self,
        camera: Camera,
        targets: Sequence[Target],
        folder: Path | None = None,
        *,
        threads: int = 1,
        place: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        self._camera, self._place = camera, place
        self._names = [target.name for target in targets]
        self._folder = folder or Path()
        self._threads = threads
        centers = [target.centers for target in targets]
        middle = torch.stack([c.mean(0) for c in centers])
        extent = torch.stack([(c - m).norm(dim=-1).max() for c, m in zip(centers, middle, strict=True)])
        steps = torch.linspace(0, 1, _AXIS_POINTS, dtype=torch.float64)
        # (T, 3 axes, points, 3): from the target's origin, about as long as the target is wide
        self._axes = extent[:, None, None, None] * torch.eye(3, dtype=torch.float64)[:, None] * steps[:, None]
        if folder is not None:
            make_folder(folder, "--overlay")

    def write(self, frames: Tensor, poses: Poses, names: Sequence[str], seen: Sequence[bool] | None = None) -> None:
        """Writes one picture a frame.

        Args:
            frames: (B, H, W) uint8 or uint16.
            poses: of these frames, targets to camera.
            names: of the frames.
            seen: which of them are pictures; by default all.

        Raises:
            ConfigError: a picture cannot be written.
        """
        lines = self.project_axes(poses)

        def write_one(index: int) -> None:
            picture = self._draw(frames[index], index, poses, lines, names[index])
            write_picture(picture_path(self._folder, names[index]), picture)

        with ThreadPoolExecutor(self._threads) as pool:
            list(pool.map(write_one, [k for k in range(len(names)) if seen is None or seen[k]]))

    def draw(self, frame: Tensor, poses: Poses, name: str) -> np.ndarray:
        """Picture (H, W, 3) uint8, blue-green-red, of one frame (H, W) with the poses of a batch of one."""
        return self._draw(frame, 0, poses, self.project_axes(poses), name)

    def project_axes(self, poses: Poses) -> np.ndarray:
        """Pixels (N, 3, points, 2) of the axes of each pose, NaN where there is none or it is behind the camera."""
        points = self._axes[poses.target] @ poses.R[:, None].mT + poses.t[:, None, None]
        if self._place is not None:
            points = points @ self._place[0].mT + self._place[1]
        pixels = self._camera.project(points)
        return torch.where(points[..., 2:] > 0, pixels, torch.nan).numpy()

    def _draw(self, frame: Tensor, index: int, poses: Poses, lines: np.ndarray, name: str) -> np.ndarray:
        picture = cv2.cvtColor(eight_bit(frame.numpy()), cv2.COLOR_GRAY2BGR)
        unit = max(picture.shape[:2]) / 1000  # everything is drawn in thousandths of the picture's longer side
        found = poses.detections[poses.detections.frame == index]
        columns = (found.outer, found.inner, found.center, found.marker, found.target)
        for outer, inner, center, marker, target in zip(*(column.tolist() for column in columns), strict=True):
            draw_ellipse(picture, outer, _OUTER)
            hole = math.isfinite(inner[3])  # discs have none
            if hole:
                draw_ellipse(picture, inner, _INNER)
            _cross(picture, center, max(0.4 * inner[3], 3.0) if hole else 3.0)
            # a ring that two targets claim shows both ids, one below the other
            place = (center[0] + 0.75 * outer[2], center[1] - 0.75 * outer[2] + 32 * unit * target)
            draw_text(picture, str(marker), place, unit, _CENTRE)
        rows = (poses.frame == index).nonzero()[:, 0].tolist()
        for row in rows:
            for axis, colour in zip(lines[row], _AXES, strict=True):
                draw_polyline(picture, axis, colour, max(1, round(1.5 * unit)))
        target = poses.target[rows]
        banners = [
            self._banner(poses, row) if of == 1 else self._numbered(picture, poses, row, lines[row, 0, 0], unit)
            for row, of in zip(rows, (target[:, None] == target).sum(1).tolist(), strict=True)
        ]
        # the banners of many copies would hide the picture: the plate of a target says how many there are
        _banners(picture, list(dict.fromkeys(banner for banner in banners if banner)), name, unit)
        return picture

    def _numbered(self, picture: np.ndarray, poses: Poses, row: int, at: np.ndarray, unit: float) -> tuple[str, Colour]:
        """Writes the number of a copy at its origin, and gives text and colour of the plate of all of them."""
        status = Status(int(poses.status[row]))
        if np.isfinite(at).all():
            place = (float(at[0]) + 4 * unit, float(at[1]) - 4 * unit)
            draw_text(picture, f"#{int(poses.instance[row])}", place, unit, _STATUS_COLOUR.get(status, _RED))
        every = (poses.frame == poses.frame[row]) & (poses.target == poses.target[row])
        ok = int(poses.ok[every].sum())
        text = f"{self._names[int(poses.target[row])]}: {int(every.sum())} copies, {ok} ok"
        return text, _GREEN if ok == int(every.sum()) else _AMBER

    def _banner(self, poses: Poses, row: int) -> tuple[str, Colour]:
        """Text and colour of the plate of one pose."""
        status = Status(int(poses.status[row]))
        words = [f"{self._names[int(poses.target[row])]}: {status.name.lower().replace('_', ' ')}"]
        if int(poses.reason[row]):
            words.append(f"({Reason(int(poses.reason[row])).name.lower().replace('_', ' ')})")
        words.append(f" {int(poses.markers[row])} markers")
        if bool(poses.t[row].isfinite().all()):
            turn = poses.rotation_vector[row].rad2deg().tolist()
            words.append("  t " + " ".join(f"{v:.3f}" for v in poses.t[row].tolist()) + " mm")
            words.append("  +- " + " ".join(f"{1000 * v:.1f}" for v in poses.std[row, :3].tolist()) + " um")
            words.append("  r " + " ".join(f"{v:.3f}" for v in turn) + " deg")
            words.append(f"  rms {float(poses.rms[row]):.4f} px")
        return " ".join(words), _STATUS_COLOUR.get(status, _RED)


def eight_bit(frame: np.ndarray) -> np.ndarray:
    """The frame for the eye: 16-bit grey values are stretched to their range."""
    if frame.dtype == np.uint8:
        return frame
    low, high = int(frame.min()), int(frame.max())
    return cv2.convertScaleAbs(frame, alpha=255 / max(high - low, 1), beta=-255 * low / max(high - low, 1))


def _fixed(values: Sequence[float] | np.ndarray) -> tuple[int, ...]:
    """Pixels as OpenCV's fixed-point coordinates."""
    return tuple(round(v * (1 << _SHIFT)) for v in values)


def draw_ellipse(picture: np.ndarray, ellipse: Sequence[float], colour: Colour, width: int = 1) -> None:
    cx, cy, a, b, theta = ellipse
    center, axes, turn = _fixed((cx, cy)), _fixed((a, b)), float(np.rad2deg(theta))
    cv2.ellipse(picture, center, axes, turn, 0, 360, colour, width, lineType=cv2.LINE_AA, shift=_SHIFT)


def _cross(picture: np.ndarray, center: Sequence[float], arm: float) -> None:
    u, v = center
    for start, end in (((u - arm, v), (u + arm, v)), ((u, v - arm), (u, v + arm))):
        cv2.line(picture, _fixed(start), _fixed(end), _CENTRE, 1, cv2.LINE_AA, _SHIFT)


def draw_polyline(picture: np.ndarray, points: np.ndarray, colour: Colour, width: int) -> None:
    height, wide = picture.shape[:2]
    # OpenCV's fixed point overflows far outside of the picture
    near = np.isfinite(points).all(-1) & (np.abs(points) < 10 * max(height, wide)).all(-1)
    chain = np.round(points[: int(near.argmin()) if not near.all() else None] * (1 << _SHIFT)).astype(np.int32)
    if len(chain) > 1:
        cv2.polylines(picture, [chain], False, colour, width, cv2.LINE_AA, _SHIFT)


def draw_text(picture: np.ndarray, text: str, place: tuple[float, float], size: float, colour: Colour) -> None:
    """Text with a dark rim, readable on any ground."""
    rim = max(1, round(1.5 * size))
    (wide, high), below = cv2.getTextSize(text, _FONT, size, rim)
    # whole within the picture, whatever it belongs to
    x = max(min(round(place[0]), picture.shape[1] - wide - rim), rim)
    y = max(min(round(place[1]), picture.shape[0] - below - rim), high + rim)
    for dx, dy in ((-rim, -rim), (-rim, rim), (rim, -rim), (rim, rim)):
        cv2.putText(picture, text, (x + dx, y + dy), _FONT, size, (0, 0, 0), rim, cv2.LINE_AA)
    cv2.putText(picture, text, (x, y), _FONT, size, colour, rim, cv2.LINE_AA)


def _banners(picture: np.ndarray, banners: Sequence[tuple[str, Colour]], name: str, unit: float) -> None:
    """One coloured plate a target along the top, the frame's name at the bottom."""
    top = 0
    for text, colour in banners:
        size = 0.55 * unit
        (wide, high), below = cv2.getTextSize(text, _FONT, size, max(1, round(1.4 * size)))
        fit = min(1.0, 0.97 * picture.shape[1] / wide)
        size, line = size * fit, round((high + below) * 1.7)
        cv2.rectangle(picture, (0, top), (picture.shape[1] - 1, top + line), colour, cv2.FILLED)
        place = (round(6 * unit), top + round((line + high * fit) / 2))
        cv2.putText(picture, text, place, _FONT, size, _WHITE, max(1, round(1.4 * size)), cv2.LINE_AA)
        top += line + 1
    draw_text(picture, name, (6 * unit, picture.shape[0] - 8 * unit), 0.5 * unit, _WHITE)
