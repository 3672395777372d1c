"""The application behind the page: a handful of fixed answers. Files are held in memory, no request names one."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncGenerator, Callable
from importlib import resources
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from torchpose.config import parse_json
from torchpose.errors import TorchposeError
from torchpose.live.engine import Live
from torchpose.live.guard import App, Guard, Refused, refusal
from torchpose.live.pictures import Pictures
from torchpose.live.view import fault_text, frame_of, history_of, ordered, row_of
from torchpose.rig.faults import RigFault

MOST_VIEWERS = 32  # at a time (convention): more than stand around a rig
_LEAST_GAP_S = 0.1  # between two messages to a viewer: as often as pictures are made
_HEARTBEAT_S = 1.0  # after which a viewer is told that there is nothing new
_PAGE = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/live.css": ("live.css", "text/css; charset=utf-8"),
    "/live.js": ("live.js", "text/javascript; charset=utf-8"),
    "/strips.js": ("strips.js", "text/javascript; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}


_REFUSALS = {404: "there is no such thing here", 405: "method not allowed"}


class Viewers:
    """Tells viewers of new snapshots; what is told is written once for all of them."""

    def __init__(self, live: Live, wanted_um: float | None) -> None:
        self._live, self._wanted_um = live, wanted_um
        self._changed = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self._written: tuple[Any, bytes] | None = None
        self.count = 0
        self.ended = False
        live.changed = self._wake_from_thread

    def _wake_from_thread(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self.wake)

    def wake(self) -> None:
        """Lets all who wait look again."""
        self._changed.set()
        self._changed = asyncio.Event()

    def end(self) -> None:
        """Lets all streams end."""
        self.ended = True
        self._live.changed = lambda: None
        self.wake()

    def message(self) -> bytes:
        """What a page shows now."""
        snapshot, recording = self._live.snapshot, self._live.recorder.state
        key = (snapshot.version, recording, self.count)
        if self._written is None or self._written[0] != key:
            points = self._live.points[-1:] if snapshot.sight is not None else []
            state = frame_of(snapshot, points[0] if points else None, recording, self._wanted_um)
            state["viewers"] = self.count
            self._written = key, b"event: frame\ndata: " + json.dumps(state, allow_nan=False).encode() + b"\n\n"
        return self._written[1]

    async def stream(self) -> AsyncGenerator[bytes]:
        """Server-sent events of one viewer. Of a viewer who takes them slowly, those in between are left out."""
        self.count += 1
        try:
            yield b"event: history\ndata: " + await asyncio.to_thread(history_of, self._live.points) + b"\n\n"
            last = b""
            while not self.ended:
                changed, now = self._changed, self.message()
                if now != last:
                    last = now
                    yield now
                    await asyncio.sleep(_LEAST_GAP_S)
                    continue
                try:
                    await asyncio.wait_for(changed.wait(), _HEARTBEAT_S)
                except TimeoutError:
                    yield b"event: alive\ndata: " + str(round(time.time(), 3)).encode() + b"\n\n"
        finally:
            self.count -= 1


class Answers:
    """What is answered to each path.

    Args:
        live: what there is to show.
        about: words for the head of the page.
        wanted_um: standard deviation that is wanted.
        tell: is given a line for each fault.
    """

    def __init__(self, live: Live, about: dict[str, Any], wanted_um: float | None, tell: Callable[[str], None]) -> None:
        self._live, self._about, self._wanted_um, self._tell = live, about, wanted_um, tell
        self._pictures = Pictures(live)
        self._viewers: Viewers | None = None
        folder = resources.files("torchpose.live") / "page"
        self._files = {path: ((folder / name).read_bytes(), kind) for path, (name, kind) in _PAGE.items()}

    @property
    def viewers(self) -> Viewers:
        """Those of the loop that runs."""
        if self._viewers is None:
            self._viewers = Viewers(self._live, self._wanted_um)
        return self._viewers

    def end(self) -> None:
        """Lets all streams end."""
        if self._viewers is not None:
            self._viewers.end()

    def file(self, path: str) -> Callable[[Request], Any]:
        content, kind = self._files[path]

        async def answer(_request: Request) -> Response:
            return Response(content, media_type=kind)

        return answer

    async def about(self, _request: Request) -> Response:
        return JSONResponse(self._about)

    async def state(self, _request: Request) -> Response:
        row = row_of(self._live.snapshot, time.time())
        if row is None:
            text = fault_text(self._live.snapshot.fault) or "No frame yet."
            return JSONResponse({"status": None, "age_s": None, "fault": text}, 503, {"retry-after": "1"})
        return JSONResponse(row)

    async def events(self, request: Request) -> Response:
        if request.method != "GET":  # a HEAD would be a viewer who is told nothing
            raise Refused(405, "method not allowed")
        if self.viewers.count >= MOST_VIEWERS:
            raise Refused(503, f"{MOST_VIEWERS} viewers are there already")
        return _Stream(self.viewers.stream(), media_type="text/event-stream")

    async def picture(self, _request: Request) -> Response:
        newest = await self._pictures.newest()
        if newest is None:
            return Response(status_code=204)
        version, jpeg = newest
        return Response(jpeg, media_type="image/jpeg", headers={"x-version": str(version)})

    async def recording(self, request: Request) -> Response:
        wanted = (await _sent(request, {"on": bool}))["on"]
        recorder = self._live.recorder
        try:
            state = await asyncio.to_thread(recorder.start if wanted else recorder.stop)
        except TorchposeError as error:
            return self._failed(error)
        self.viewers.wake()
        return JSONResponse({"on": state.on, "name": state.name, "frames": state.frames})

    async def still(self, request: Request) -> Response:
        await _sent(request, {})
        sight = self._live.snapshot.sight
        if sight is None or sight.shot.image is None:
            return JSONResponse({"error": "There is no frame to keep."}, 409)
        try:
            name = await asyncio.to_thread(self._live.recorder.still, sight.shot, ordered(sight.row))
        except TorchposeError as error:
            return self._failed(error)
        return JSONResponse({"name": name})

    def _failed(self, error: TorchposeError) -> Response:
        """The terminal is told all, the page what has no path in it."""
        self._tell(str(error))
        word = error.reason.value if isinstance(error, RigFault) else "not_writable"
        return JSONResponse({"error": fault_text(word)}, 507)


class _Stream(StreamingResponse):
    """Ends what it streams from when the viewer goes."""

    async def stream_response(self, send: Send) -> None:
        source = self.body_iterator
        assert isinstance(source, AsyncGenerator)
        async with contextlib.aclosing(source):
            await super().stream_response(send)


async def _sent(request: Request, kinds: dict[str, type]) -> dict[str, Any]:
    """The object of a request, with just these entries. Refused: it is another."""
    try:
        sent = parse_json(await request.body())
    except ValueError:
        raise Refused(400, "body is not JSON") from None
    if not isinstance(sent, dict) or set(sent) != set(kinds):
        raise Refused(400, f"body is not an object of {', '.join(kinds) or 'nothing'}")
    for name, kind in kinds.items():
        if type(sent[name]) is not kind:
            raise Refused(400, f"{name} is no {kind.__name__}")
    return sent


async def _refuse(request: Request, error: Exception) -> Response:
    """Leaves the refusal to the guard, which tells of it."""
    if isinstance(error, Refused):
        return refusal(request.scope, error)
    status = error.status_code if isinstance(error, HTTPException) else 404
    return refusal(request.scope, Refused(status, _REFUSALS.get(status, "not possible")))


def application(answers: Answers, host: str, token: str | None, tell: Callable[[str], None]) -> App:
    """The guarded application.

    Args:
        answers: to each path.
        host: that is listened on.
        token: that is demanded; None: none.
        tell: is given a line for each refusal.
    """
    routes = [Route(path, answers.file(path)) for path in _PAGE]
    routes += [
        Route("/api/about", answers.about),
        Route("/api/state", answers.state),
        Route("/api/events", answers.events),
        Route("/api/picture", answers.picture),
        Route("/api/recording", answers.recording, methods=["POST"]),
        Route("/api/still", answers.still, methods=["POST"]),
    ]
    inner = Starlette(routes=routes, exception_handlers={HTTPException: _refuse, Refused: _refuse})
    inner.router.redirect_slashes = False
    guard = Guard(inner, host, token, tell)

    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:  # a server tells by it what kind it is
        await guard(scope, receive, send)

    return guarded
