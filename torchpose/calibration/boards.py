"""Views of a chessboard or ChArUco board, found by OpenCV: the usual alternative to a ring target."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.calibration.views import Views
from torchpose.errors import ConfigError

_EXAMPLES = (
    "chessboard:9x6:5mm (inner corners, square), charuco:8x5:10mm:7mm:4X4_50 (squares, square, marker), "
    "circles:7x6:20mm, acircles:4x11:20mm (pitch) or rings:10x7:20mm:6mm:3mm (pitch, radii)"
)
# up to three digits a side and six a length: a thousand marks across, a kilometre
_LENGTH = r"(\d{1,6}\.?\d{0,9}|\.\d{1,9})mm"
_CHESSBOARD = re.compile(rf"chessboard:(\d{{1,3}})x(\d{{1,3}}):{_LENGTH}")
_CHARUCO = re.compile(rf"charuco:(\d{{1,3}})x(\d{{1,3}}):{_LENGTH}:{_LENGTH}:(\w+)")
_SUBPIX_WINDOW = 0.3  # of the distance between corners, half width
_SUBPIX_RANGE = (3, 11)  # px
# of OpenCV's older search: without the quick look for corners first a frame that has no board takes minutes
_QUICK = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
_NONE = (np.zeros(0, int), np.zeros((0, 2)))


@dataclass(frozen=True)
class Board:
    """A flat board of squares.

    Attributes:
        columns: corners inside the board, across.
        rows: the same, down.
        square: side of a square, mm.
        charuco: OpenCV's board, None for a plain chessboard.
    """

    columns: int
    rows: int
    square: float
    charuco: cv2.aruco.CharucoBoard | None = None

    @classmethod
    def parse(cls, text: str) -> Board:
        """``chessboard:9x6:5mm`` (inner corners, square) or ``charuco:8x5:10mm:7mm:4X4_50`` (squares, square, marker).

        Raises:
            ConfigError: it is neither.
        """
        problem = f"is no board; write {_EXAMPLES}"
        if found := _CHESSBOARD.fullmatch(text):
            columns, rows, square = int(found[1]), int(found[2]), float(found[3])
            if min(columns, rows) >= 3 and square > 0:
                return cls(columns, rows, square)
            problem = "a chessboard needs 3 x 3 inner corners at least and squares above 0 mm; take a larger one"
        elif found := _CHARUCO.fullmatch(text):
            size, square, marker = (int(found[1]), int(found[2])), float(found[3]), float(found[4])
            dictionary = getattr(cv2.aruco, f"DICT_{found[5].removeprefix('DICT_')}", None)
            codes = None if dictionary is None else cv2.aruco.getPredefinedDictionary(dictionary)
            if codes is None:
                problem = f"no dictionary {found[5]} in OpenCV; write for example 4X4_50"
            elif not 0 < marker < square or min(size) < 3:
                problem = "needs 3 x 3 squares at least and markers above 0 mm, smaller than the squares"
            elif math.prod(size) // 2 > len(codes.bytesList):
                problem = f"{found[5]} has too few markers for the board; take a larger dictionary"
            else:
                return cls(size[0] - 1, size[1] - 1, square, cv2.aruco.CharucoBoard(size, square, marker, codes))
        raise ConfigError(f"--board: {text}: {problem}")

    @property
    def corners(self) -> Float[Tensor, "corners 3"]:
        """Row by row, mm."""
        down, across = np.indices((self.rows, self.columns)).reshape(2, -1)
        return self.square * torch.from_numpy(np.stack([across, down, np.zeros_like(down)], -1)).double()


def find_corners(names: Sequence[str], frames: Tensor, board: Board) -> Views:
    """Corners of the board in every frame; their covariance is zero, that is unknown.

    Args:
        names: of the B frames.
        frames: (B, H, W) uint8 or uint16.
    """
    find = _chessboard_corners if board.charuco is None else _charuco_corners
    # OpenCV's detectors want 8 bits
    grey = (frames if frames.dtype == torch.uint8 else (frames.int() >> 8).to(torch.uint8)).cpu().numpy()
    number, pixels = zip(*(find(frame, board) for frame in grey), strict=True)
    point = torch.from_numpy(np.concatenate(number)).to(frames.device, torch.int64)
    seen = torch.from_numpy(np.concatenate(pixels)).to(frames.device, torch.float64)
    index = torch.from_numpy(np.repeat(np.arange(len(grey)), [len(ids) for ids in number])).to(point)
    return Views(index, point, board.corners.to(seen)[point], seen, seen.new_zeros(len(seen), 2, 2), tuple(names))


def _chessboard_corners(grey: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray]:
    flags = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE
    size = (board.columns, board.rows)
    found, corners = cv2.findChessboardCornersSB(grey, size, flags=flags)
    if not found or len(corners) != board.columns * board.rows:
        # the older search finds boards that lack the white border, or are close to the frame's
        found, corners = cv2.findChessboardCorners(grey, size, flags=_QUICK)
        if not found or len(corners) != board.columns * board.rows:
            return _NONE
        corners = _settled(grey, np.arange(len(corners)), corners, board)
    return np.arange(len(corners)), corners.reshape(-1, 2).astype(float)


def _charuco_corners(grey: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray]:
    assert board.charuco is not None  # the caller chose by it
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board.charuco).detectBoard(grey)
    if ids is None or len(ids) == 0:
        return _NONE
    ids = ids.ravel()
    return ids.astype(int), _settled(grey, ids, corners, board).reshape(-1, 2).astype(float)


def _settled(grey: np.ndarray, ids: np.ndarray, corners: np.ndarray, board: Board) -> np.ndarray:
    """Corners where the gradients of the squares around them meet."""
    points = corners.reshape(-1, 1, 2).astype(np.float32)
    grid = np.stack([ids % board.columns, ids // board.columns], -1)
    # a window that does not reach the next corner
    neighbours = np.abs(grid[:, None] - grid).sum(-1) == 1
    apart = np.linalg.norm(points - points[:, 0], axis=-1)[neighbours].min(initial=np.inf)
    half = int(np.clip(_SUBPIX_WINDOW * apart if np.isfinite(apart) else 0.0, *_SUBPIX_RANGE))
    end = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    cv2.cornerSubPix(grey, points, (half, half), (-1, -1), end)
    return points
