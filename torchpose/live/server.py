"""The server: one socket, connections that are watched, and an end on a signal with everything written."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from torchpose.errors import ConfigError, printable
from torchpose.live.app import Answers, application
from torchpose.live.guard import MOST_HEAD

MOST_CONNECTIONS = 96  # at a time (convention): three for each of as many viewers as there may be
SILENT_S = 5.0  # that a connection may take to send a whole request (convention)
STALLED_S = 5.0  # that a client may leave sent bytes untaken (convention)
MOST_LINES = 300  # a minute (convention): what a terminal can hold and somebody may still read
_MINUTE = 60.0  # s
_WATCH_S = 0.5  # between two looks at the connections
_UNSENT = 1 << 17  # bytes that wait for a client, a picture or so
_UNSENT_BY_SYSTEM = 1 << 18  # bytes of a socket's own buffer: what waits there is old when it comes


class _Watched(H11Protocol):
    """HTTP over connections that end where a client is silent, stalls, or sends what is no HTTP."""

    _tell: Callable[[str], None]
    _since = 0.0  # when the silence, or the stalling, began
    _watch: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        transport.set_write_buffer_limits(high=_UNSENT)
        self._since = self.loop.time()
        self._watch = self.loop.call_later(_WATCH_S, self._look)
        if len(self.connections) > MOST_CONNECTIONS:
            self._make_room()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._watch is not None:
            self._watch.cancel()
        super().connection_lost(exc)

    @property
    def idle(self) -> bool:
        """Whether no request is under way."""
        return self.cycle is None or self.cycle.response_complete

    def _look(self) -> None:
        now = self.loop.time()
        sending = not self.idle and not self.cycle.more_body
        if sending and not self.flow.write_paused:
            self._since = now
        elif now - self._since > (STALLED_S if sending else SILENT_S):
            # a connection that is kept for a next request may go without a word
            self._drop("takes nothing" if sending else "sends no whole request" if not self._kept() else "")
            return
        self._watch = self.loop.call_later(_WATCH_S, self._look)

    def _kept(self) -> bool:
        return self.cycle is not None and self.idle and not self.conn.trailing_data[0]

    def _make_room(self) -> None:
        """Drops the connection without a request that has been there longest; this one where all have one."""
        idle = [c for c in self.connections if isinstance(c, _Watched) and c.idle and c is not self]
        oldest = min(idle, key=lambda connection: connection._since, default=self)
        oldest._drop(f"one of more than {MOST_CONNECTIONS} connections")

    def _drop(self, why: str) -> None:
        if why:
            self._tell(f"dropped {(self.client or ('unknown',))[0]}: {why}")
        self.connections.discard(self)
        self.transport.abort()

    def send_400_response(self, msg: str) -> None:
        self._tell(f"refused 400 {(self.client or ('unknown',))[0]}: no HTTP, or too long a head")
        super().send_400_response(msg)

    def _unsupported_upgrade_warning(self) -> None:
        pass  # there is no WebSocket here; the request is answered as what it else is


def watched(tell: Callable[[str], None]) -> type[H11Protocol]:
    """A protocol of HTTP that gives ``tell`` a line for each connection that it ends."""

    class Told(_Watched):
        _tell = staticmethod(tell)

    return Told


class Bounded:
    """Hands lines on, so many a minute at most: who asks again and again fills no disk.

    Args:
        tell: is given the lines, and how many were left out.
        clock: s.
    """

    def __init__(self, tell: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._tell, self._clock = tell, clock
        self._since, self._count = clock(), 0

    def __call__(self, line: str) -> None:
        if self._clock() - self._since >= _MINUTE:
            self.end()
        self._count += 1
        if self._count <= MOST_LINES:
            self._tell(line)

    def end(self) -> None:
        """Tells how many lines of the last minute were left out; a new one begins."""
        if self._count > MOST_LINES:
            self._tell(f"{self._count - MOST_LINES} more such lines were left out")
        self._since, self._count = self._clock(), 0


class _Lines(logging.Handler):
    """Hands what a library has to say on, a line each."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        super().__init__(logging.ERROR)
        self._tell = tell

    def emit(self, record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        self._tell(printable(f"server: {record.getMessage().strip()}{f' {error!r}' if error else ''}"))


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens; port 0 is any that is free. ConfigError: it cannot."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError):
        raise ConfigError(f"--host: {host} is no name or address of this machine; give 127.0.0.1 or another") from None
    family, kind, protocol, _, address = found[0]
    listening = socket.socket(family, kind, protocol)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _UNSENT_BY_SYSTEM)  # connections inherit it
        listening.bind(address)
        listening.listen()
    except OSError as error:
        listening.close()
        raise ConfigError(f"--port: {host}:{port} cannot be served ({error.strerror}); give another --port") from None
    return listening


class Server:
    """Serves a page until a signal comes, or `end` is called.

    Args:
        answers: to each path.
        host: that the socket listens on.
        token: that is demanded.
        tell: is given a line for each refusal and each connection that is dropped.
    """

    def __init__(self, answers: Answers, host: str, token: str | None, tell: Callable[[str], None]) -> None:
        self._answers = answers
        self._told = tell = Bounded(tell)
        app = application(answers, host, token, tell)
        self._server = uvicorn.Server(
            uvicorn.Config(
                app,
                interface="asgi3",
                http=watched(tell),
                ws="none",
                loop="asyncio",
                lifespan="off",
                log_config=None,
                access_log=False,
                server_header=False,
                proxy_headers=False,
                timeout_keep_alive=int(SILENT_S),
                timeout_graceful_shutdown=3,
                h11_max_incomplete_event_size=MOST_HEAD,
            )
        )
        self._lines = _Lines(tell)

    def run(self, listening: socket.socket) -> None:
        """Serves; returns after SIGINT or SIGTERM."""
        log = logging.getLogger("uvicorn.error")
        log.addHandler(self._lines)
        propagated, log.propagate = log.propagate, False
        try:
            with _quiet_signals():
                asyncio.run(self._serve(listening))
        finally:
            self._told.end()
            log.removeHandler(self._lines)
            log.propagate = propagated

    def end(self) -> None:
        """Lets `run` return; from any thread."""
        self._server.should_exit = True

    async def _serve(self, listening: socket.socket) -> None:
        async def end_streams() -> None:
            while not self._server.should_exit:
                await asyncio.sleep(_WATCH_S / 5)
            self._answers.end()

        ending = asyncio.create_task(end_streams())
        try:
            await self._server.serve([listening])
        finally:
            self._answers.end()
            ending.cancel()


@contextlib.contextmanager
def _quiet_signals() -> Iterator[None]:
    """SIGINT and SIGTERM, which uvicorn raises again when it has ended, end nothing else then."""
    before: dict[signal.Signals, Any] = {}
    with contextlib.suppress(ValueError):  # not the main thread
        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, lambda *_: None)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
