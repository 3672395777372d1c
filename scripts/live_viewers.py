"""Viewers of a live page without a browser, for scripts/bench_live.py: prints what they see as JSON.

    python scripts/live_viewers.py PORT COUNT SECONDS

A viewer does what the page does: it reads the events, and asks for the newest picture when it has the one before.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from typing import Any


async def asked(port: int, path: str, reader: Any, writer: Any) -> bytes:
    """One answer over a connection that is kept: head and body."""
    writer.write(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
    await writer.drain()
    head: bytes = await reader.readuntil(b"\r\n\r\n")
    length = next(
        int(line.split(b":")[1]) for line in head.split(b"\r\n") if line.lower().startswith(b"content-length")
    )
    return head + await reader.readexactly(length)


async def view(port: int, seconds: float) -> dict[str, Any]:
    """What one viewer sees: latencies in s of numbers and of pictures, and frames/s that the server looked at."""
    found: dict[str, Any] = {"numbers": [], "pictures": [], "rate": 0.0}
    marks: list[tuple[float, int]] = []
    taken: dict[int, float] = {}
    newest = asyncio.Event()
    end = time.monotonic() + seconds

    async def events() -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1 << 22)
        writer.write(f"GET /api/events HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
        frame = False
        last = -1
        while time.monotonic() < end:
            line = await reader.readline()
            if line.startswith(b"event: "):
                frame = line == b"event: frame\n"
            elif frame and line.startswith(b"data: "):
                state = json.loads(line[6:])
                if state["seen"] and state["number"] > last:
                    last = state["number"]
                    taken[state["version"]] = state["seen"]["taken_s"]
                    marks.append((time.monotonic(), last))
                    found["numbers"].append(time.time() - state["seen"]["taken_s"])
                    newest.set()
        writer.close()
        newest.set()
        if len(marks) > 1:
            found["rate"] = (marks[-1][1] - marks[0][1]) / (marks[-1][0] - marks[0][0])

    async def pictures() -> None:
        connection, shown = None, -1
        while time.monotonic() < end:
            await newest.wait()
            newest.clear()
            try:
                connection = connection or await asyncio.open_connection("127.0.0.1", port, limit=1 << 22)
                answer = await asked(port, "/api/picture", *connection)
            except (ConnectionError, asyncio.IncompleteReadError):  # the server lets idle connections go
                connection = None
                continue
            head = answer[: answer.index(b"\r\n\r\n")].lower()
            version = next(
                (int(line.split(b":")[1]) for line in head.split(b"\r\n") if line.startswith(b"x-version")), -1
            )
            if version > shown and version in taken:
                shown = version
                found["pictures"].append(time.time() - taken[version])
        if connection is not None:
            connection[1].close()

    await asyncio.gather(events(), pictures())
    return found


async def viewers(port: int, count: int, seconds: float) -> None:
    """Prints what all viewers see as JSON."""
    print(json.dumps(await asyncio.gather(*(view(port, seconds) for _ in range(count)))))


if __name__ == "__main__":
    asyncio.run(viewers(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])))
