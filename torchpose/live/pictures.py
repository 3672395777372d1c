"""The picture as a page shows it: reduced, grey, JPEG; made once a frame, and only when somebody asks."""

from __future__ import annotations

import asyncio
from typing import Any

import cv2

from torchpose.live.engine import Live, Snapshot
from torchpose.report.overlay import eight_bit

LONGEST = 1280  # px of the longer side (convention): a screen's half
_QUALITY = 80  # of JPEG (convention): artefacts stay below what a screen shows
LEAST_AGE_S = 0.1  # between two pictures (convention): an eye takes ten a second for motion


def encode(snapshot: Snapshot) -> bytes:
    """JPEG of a snapshot's frame, which has one; nothing is drawn on it."""
    assert snapshot.sight is not None
    image: Any = snapshot.sight.shot.image
    assert image is not None
    factor = max(1, -(-max(image.shape) // LONGEST))
    if factor > 1:
        height, width = (side // factor for side in image.shape)
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", eight_bit(image), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


class Pictures:
    """The newest picture, for any number of viewers."""

    def __init__(self, live: Live) -> None:
        self._live = live
        self._last: tuple[int, bytes] | None = None
        self._making: asyncio.Task[tuple[int, bytes] | None] | None = None
        self._since = 0.0
        self.encoded = 0

    async def newest(self) -> tuple[int, bytes] | None:
        """Version of its snapshot and JPEG; None where there is no picture. All who wait for one get the same."""
        if self._making is None or self._making.done():
            self._making = asyncio.create_task(self._make())
        return await asyncio.shield(self._making)

    async def _make(self) -> tuple[int, bytes] | None:
        clock = asyncio.get_running_loop().time
        snapshot = self._live.snapshot
        if snapshot.sight is None or snapshot.sight.shot.image is None:
            return None
        fresh = self._last is None or snapshot.version != self._last[0]
        if fresh and (self._last is None or clock() - self._since >= LEAST_AGE_S):
            self._since = clock()
            self._last = snapshot.version, await asyncio.to_thread(encode, snapshot)
            self.encoded += 1
        return self._last
