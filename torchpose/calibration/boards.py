"""Views of a chessboard or ChArUco board, found by OpenCV: the usual alternative to a ring target."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from torchpose.calibration.views import Views
from torchpose.errors import ConfigError

_EXAMPLES = "chessboard:9x6:5mm (inner corners, square) or charuco:8x5:10mm:7mm:4X4_50 (squares, square, marker)"
_CHESSBOARD = re.compile(r"chessboard:(\d+)x(\d+):([\d.]+)mm")
_CHARUCO = re.compile(r"charuco:(\d+)x(\d+):([\d.]+)mm:([\d.]+)mm:(\w+)")
_SUBPIX_WINDOW = 0.3  # of the distance between corners, half width
_SUBPIX_RANGE = (3, 11)  # px


@dataclass(frozen=True)
class Board:
    """A flat board of squares.

    Attributes:
        columns, rows: corners inside the board, across and down.
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
        if m := _CHESSBOARD.fullmatch(text):
            columns, rows, square = int(m[1]), int(m[2]), _length(m[3], text)
            if min(columns, rows) < 3:
                raise ConfigError(
                    f"--board: {text}: a chessboard needs 3 x 3 inner corners at least; take a larger one"
                )
            return cls(columns, rows, square)
        if m := _CHARUCO.fullmatch(text):
            across, down, square, marker = int(m[1]), int(m[2]), _length(m[3], text), _length(m[4], text)
            dictionary = getattr(cv2.aruco, f"DICT_{m[5].removeprefix('DICT_')}", None)
            if dictionary is None:
                raise ConfigError(f"--board: {text}: no dictionary {m[5]} in OpenCV; write for example 4X4_50")
            if marker >= square or min(across, down) < 3:
                raise ConfigError(f"--board: {text}: needs 3 x 3 squares at least and markers smaller than the squares")
            codes = cv2.aruco.getPredefinedDictionary(dictionary)
            if across * down // 2 > len(codes.bytesList):
                raise ConfigError(
                    f"--board: {text}: {m[5]} has too few markers for the board; take a larger dictionary"
                )
            return cls(across - 1, down - 1, square, cv2.aruco.CharucoBoard((across, down), square, marker, codes))
        raise ConfigError(f"--board: {text}: is no board; write {_EXAMPLES}")

    @property
    def corners(self) -> Tensor:
        """(columns * rows, 3) mm, row by row."""
        number = torch.arange(self.columns * self.rows, dtype=torch.float64)
        across, down = number % self.columns, number // self.columns
        return self.square * torch.stack([across, down.floor(), torch.zeros_like(number)], -1)


def _length(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not value > 0:
        raise ConfigError(f"--board: {where}: {text!r} is no length; write {_EXAMPLES}")
    return value


def find_corners(names: Sequence[str], frames: Tensor, board: Board) -> Views:
    """Corners of the board in every frame; their covariance is zero, that is unknown.

    Args:
        names: of the B frames. frames: (B, H, W) uint8 or uint16.
    """
    find = _chessboard_corners if board.charuco is None else _charuco_corners
    number, pixels, view = [], [], []
    for k, frame in enumerate(frames):
        # OpenCV's detectors want 8 bits
        grey = frame.numpy() if frame.dtype == torch.uint8 else (frame.int() >> 8).to(torch.uint8).numpy()
        ids, found = find(grey, board)
        number.append(ids)
        pixels.append(found)
        view.append(np.full(len(ids), k))
    point = torch.from_numpy(np.concatenate(number)).long()
    seen = torch.from_numpy(np.concatenate(pixels)).double()
    index = torch.from_numpy(np.concatenate(view)).long()
    return Views(tuple(names), index, point, board.corners[point], seen, seen.new_zeros(len(seen), 2, 2))


def _chessboard_corners(grey: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray]:
    flags = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE
    found, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=flags)
    count = board.columns * board.rows
    if not found or len(corners) != count:
        return np.zeros(0, int), np.zeros((0, 2))
    return np.arange(count), corners.reshape(-1, 2).astype(float)


def _charuco_corners(grey: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray]:
    assert board.charuco is not None  # the caller chose by it
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board.charuco).detectBoard(grey)
    if ids is None or len(ids) == 0:
        return np.zeros(0, int), np.zeros((0, 2))
    ids = ids.ravel()
    points = corners.reshape(-1, 1, 2).astype(np.float32)
    grid = np.stack([ids % board.columns, ids // board.columns], -1)
    # a window that does not reach the next corner
    apart = [
        np.linalg.norm(points[i, 0] - points[j, 0])
        for i in range(len(ids))
        for j in range(i)
        if np.abs(grid[i] - grid[j]).sum() == 1
    ]
    half = int(np.clip(_SUBPIX_WINDOW * min(apart, default=0.0), *_SUBPIX_RANGE))
    end = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    cv2.cornerSubPix(grey, points, (half, half), (-1, -1), end)
    return ids.astype(int), points.reshape(-1, 2).astype(float)
