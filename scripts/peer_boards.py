"""The 70 mm plate as each of torchpose's peers needs it, and each peer as its users run it.

Everything printed is a set of polygons and circles (`torchpose.sim.shapes`), so that the renderer's boundary integrals
draw them as exactly as the rings. Object points are in mm in the plate's frame: x right, y down, z away from whoever
looks at it.

A peer takes a grey frame and returns rotation (3, 3) and translation (3,), mm, or None. Correspondences go through
`cv2.solvePnP` with its default, on all points found.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
import torch

import torchpose as tp
from torchpose.pipeline import Method
from torchpose.sim import shapes
from torchpose.sim.shapes import Shapes

DARK = 30.0  # grey level of print
TAG_MM, TAG_PITCH_MM = 10.0, 40.0  # as large as the rings and in their places
CHARUCO_CELL_MM, CHARUCO_SQUARES = 0.45, 7  # a square is 20 cells, its marker 14
CHESS_MM, CHESS_CORNERS = 7.0, (8, 7)  # inner corners; 9 x 8 squares
GRID_MM, GRID_SIZE, GRID_DISC_MM = 6.0, (4, 11), 2.25  # asymmetric, 42 x 60 mm, and the radius of a disc
NO_APRILTAG = "AprilTag 3: not installed (pip install torchpose[peers]); its figures are left out"

Pose = tuple[np.ndarray, np.ndarray]
Peer = Callable[[np.ndarray], list[Pose]]
"""Poses of a grey frame: none, one, or the two of a board that looks the same upside down."""


@dataclass(frozen=True, eq=False)
class Contender:
    """A name in the tables, what is printed for it, and how it measures."""

    name: str
    print: str
    measure: Peer


def prints(tag_mm: float = TAG_MM) -> dict[str, tp.Target | Shapes]:
    """What is printed on the plate; tags of that side."""
    return {
        "rings": tp.Target.load("quad40"),
        "apriltag": shapes.cat([_tag(cv2.aruco.DICT_APRILTAG_36h11, i, 8, tag_mm) for i in range(4)]),
        "aruco": shapes.cat([_tag(cv2.aruco.DICT_4X4_50, i, 6, tag_mm) for i in range(4)]),
        "charuco": _charuco_print(),
        "chessboard": _chessboard_print(),
        "circles": shapes.cat([shapes.ring((x, y), GRID_DISC_MM, level=DARK) for x, y, _ in grid_points().tolist()]),
    }


def contenders(camera: tp.Camera, tag_mm: float = TAG_MM) -> list[Contender]:
    """All that are installed; a line on stdout says what is not."""
    out = [Contender(f"torchpose {m}", "rings", _torchpose(camera, m)) for m in ("photometric", "centers")]
    if not has_apriltag():
        print(NO_APRILTAG)
    else:
        out.append(Contender("AprilTag 3", "apriltag", _apriltag(camera, tag_mm)))
    return [
        *out,
        Contender("ArUco", "aruco", _aruco(camera, tag_mm, cv2.aruco.CORNER_REFINE_NONE)),
        Contender("ArUco subpixel", "aruco", _aruco(camera, tag_mm, cv2.aruco.CORNER_REFINE_SUBPIX)),
        Contender("ChArUco", "charuco", _charuco(camera)),
        Contender("chessboard SB", "chessboard", _chessboard(camera)),
        Contender("circle grid", "circles", _circles(camera)),
    ]


def has_apriltag() -> bool:
    return importlib.util.find_spec("pupil_apriltags") is not None


# prints


def cells(black: np.ndarray, cell: float, center: tuple[float, float]) -> Shapes:
    """Black cells (rows, columns) bool of a raster about ``center``, as few rectangles that do not overlap."""
    rows, columns = black.shape
    out, left = [], black.copy()
    for r, c in np.argwhere(black):
        if not left[r, c]:
            continue
        wide = int(np.argmin(np.append(left[r, c:], False)))
        tall = int(np.argmin(np.append(left[r:, c : c + wide].all(1), False)))
        left[r : r + tall, c : c + wide] = False
        middle = (center[0] + cell * (c + wide / 2 - columns / 2), center[1] + cell * (r + tall / 2 - rows / 2))
        out.append(shapes.rectangle(middle, cell * wide, cell * tall, level=DARK))
    return shapes.cat(out)


def _tag(family: int, number: int, size: int, tag_mm: float) -> Shapes:
    """One tag of so many cells across, border included, at its place on the plate."""
    image = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(family), number, size)
    x, y = tag_centers()[number]
    return cells(np.asarray(image) < 128, tag_mm / size, (float(x), float(y)))


def tag_centers() -> np.ndarray:
    """(4, 2) mm."""
    return (np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) - 0.5) * TAG_PITCH_MM


def tag_corners(number: int, tag_mm: float) -> np.ndarray:
    """(4, 3) mm: upper left, upper right, lower right, lower left."""
    corners = 0.5 * tag_mm * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return np.pad(tag_centers()[number] + corners, ((0, 0), (0, 1)))


def charuco_board() -> cv2.aruco.CharucoBoard:
    """Its own coordinates start at a corner of the board."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    size = (CHARUCO_SQUARES, CHARUCO_SQUARES)
    return cv2.aruco.CharucoBoard(size, 20 * CHARUCO_CELL_MM, 14 * CHARUCO_CELL_MM, dictionary)


def _charuco_print() -> Shapes:
    side = 20 * CHARUCO_SQUARES  # one pixel a cell
    return cells(charuco_board().generateImage((side, side)) < 128, CHARUCO_CELL_MM, (0.0, 0.0))


def _chessboard_print() -> Shapes:
    across, down = CHESS_CORNERS[0] + 1, CHESS_CORNERS[1] + 1
    return cells(np.indices((down, across)).sum(0) % 2 == 0, CHESS_MM, (0.0, 0.0))


def chess_points() -> np.ndarray:
    """(56, 3) mm."""
    v, u = np.indices(CHESS_CORNERS[::-1]).reshape(2, -1)
    points = CHESS_MM * np.stack([u, v, 0 * u], 1)
    return points - points.mean(0)


def grid_points() -> np.ndarray:
    """(44, 3) mm, as findCirclesGrid counts them."""
    row, column = np.indices(GRID_SIZE[::-1]).reshape(2, -1)
    points = GRID_MM * np.stack([2 * column + row % 2, row, 0 * row], 1).astype(float)
    return points - 0.5 * (points.min(0) + points.max(0))


# peers


def solved(camera: tp.Camera, points: np.ndarray, pixels: np.ndarray) -> list[Pose]:
    """The pose of points (N, 3) seen at pixels (N, 2)."""
    if len(points) < 4:
        return []
    xyz, uv = points.astype(np.float64), pixels.astype(np.float64).reshape(-1, 2)
    good, turn, place = cv2.solvePnP(xyz, uv, camera.matrix.numpy(), camera.distortion.numpy())
    return [(cv2.Rodrigues(turn)[0], place[:, 0])] if good else []


def _torchpose(camera: tp.Camera, method: Method) -> Peer:
    estimator = tp.PoseEstimator(camera, tp.Target.load("quad40"), method=method)

    def measure(frame: np.ndarray) -> list[Pose]:
        poses = estimator(torch.from_numpy(frame)[None])
        return [(poses.R[0].numpy(), poses.t[0].numpy())] if bool(poses.ok[0]) else []

    return measure


@cache
def apriltag_detector() -> Any:
    """One detector for the whole process."""
    from pupil_apriltags import Detector

    class Kept(Detector):  # type: ignore[misc]  # has no types
        def __del__(self) -> None:
            """Nothing: what pupil-apriltags 1.0.4 frees here twice corrupts the heap."""

    return Kept(families="tag36h11", nthreads=1, quad_decimate=1.0)


def _apriltag(camera: tp.Camera, tag_mm: float) -> Peer:
    detector = apriltag_detector()

    def measure(frame: np.ndarray) -> list[Pose]:
        found = [d for d in detector.detect(frame) if d.tag_id < 4]
        # corners run from the lower left against the clock, and OpenCV prints these tags upside down; AprilTag counts
        # pixels from the corner of the first one
        pixels = [d.corners[[1, 0, 3, 2]] - 0.5 for d in found]
        points = [tag_corners(d.tag_id, tag_mm) for d in found]
        return solved(camera, np.concatenate(points), np.concatenate(pixels)) if found else []

    return measure


def _aruco(camera: tp.Camera, tag_mm: float, refinement: int) -> Peer:
    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = refinement
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), options)

    def measure(frame: np.ndarray) -> list[Pose]:
        corners, numbers, _ = detector.detectMarkers(frame)
        every = [] if numbers is None else [int(n) for n in np.ravel(numbers)]
        found = [(n, np.asarray(c).reshape(4, 2)) for n, c in zip(every, corners, strict=True) if n < 4]
        if not found:
            return []
        points = [tag_corners(n, tag_mm) for n, _ in found]
        return solved(camera, np.concatenate(points), np.concatenate([c for _, c in found]))

    return measure


def _charuco(camera: tp.Camera) -> Peer:
    board = charuco_board()
    detector = cv2.aruco.CharucoDetector(board)
    middle = np.array([10.0, 10.0, 0.0]) * CHARUCO_SQUARES * CHARUCO_CELL_MM

    def measure(frame: np.ndarray) -> list[Pose]:
        corners: Any
        corners, numbers, _, _ = detector.detectBoard(frame)
        if numbers is None or len(numbers) < 6:
            return []
        points, pixels = board.matchImagePoints(corners, numbers)
        return solved(camera, points.reshape(-1, 3) - middle, pixels)

    return measure


def _either_way(camera: tp.Camera, points: np.ndarray, pixels: np.ndarray) -> list[Pose]:
    """Poses of a board whose points may be counted from either end."""
    return [*solved(camera, points, pixels), *solved(camera, points[::-1], pixels)]


def _chessboard(camera: tp.Camera) -> Peer:
    def measure(frame: np.ndarray) -> list[Pose]:
        good, corners = cv2.findChessboardCornersSB(frame, CHESS_CORNERS)
        return _either_way(camera, chess_points(), corners) if good else []

    return measure


def _circles(camera: tp.Camera) -> Peer:
    options = cv2.SimpleBlobDetector_Params()  # type: ignore[attr-defined]  # missing in the stubs of OpenCV 5
    options.maxArea = 1e5  # the default leaves out discs as large as these
    detector = cv2.SimpleBlobDetector_create(options)  # type: ignore[attr-defined]  # missing in the stubs of OpenCV 5

    def measure(frame: np.ndarray) -> list[Pose]:
        flags = cv2.CALIB_CB_ASYMMETRIC_GRID
        good, centers = cv2.findCirclesGrid(frame, GRID_SIZE, flags=flags, blobDetector=detector)
        return _either_way(camera, grid_points(), centers) if good else []

    return measure
