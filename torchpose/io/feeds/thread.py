"""A server in a thread with an event loop of its own."""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

from torchpose.errors import ConfigError
from torchpose.io.rows import Row

_PATIENCE = 60.0  # s that a server may take to start or to end (convention): OPC UA has a large book of types


@dataclass(frozen=True)
class Place:
    """Where a feed listens, and who may come.

    Attributes:
        port: to listen at.
        host: to listen on; beyond this machine there has to be a token.
        token: that clients have to know; empty: none.

    Raises:
        ConfigError: a host beyond this machine, and no token.
    """

    port: int
    host: str = "127.0.0.1"
    token: str = ""

    def __post_init__(self) -> None:
        if not self.token and not _is_loopback(self.host):
            raise ConfigError(f"--host: {self.host} lets other machines in; add --token, which they have to know")

    def admits(self, token: str | None) -> bool:
        """Whether a client that gives this token may come."""
        return not self.token or hmac.compare_digest((token or "").encode(), self.token.encode())


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Feed:
    """Base of the feeds: `_serve` runs until `_stopped`, and calls `_ready` once clients may come."""

    option = ""  # of the command line, for messages

    def __init__(self, place: Place) -> None:
        self._place = place
        self._stopped = asyncio.Event()
        self._started = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name=f"feed{self.option}", daemon=True)

    def __enter__(self) -> Self:
        """Starts the server. ConfigError: the port is not to be had."""
        self._loop = asyncio.new_event_loop()
        self._thread.start()
        if not self._started.wait(_PATIENCE):
            self._error = TimeoutError("it does not start")
        if self._error is not None:
            reason = getattr(self._error, "strerror", None) or str(self._error)
            raise ConfigError(
                f"{self.option}: {self._place.host}:{self._place.port} cannot be served ({reason}); choose another port"
            ) from None
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._stopped.set)
        self._thread.join(_PATIENCE)

    def publish(self, rows: Sequence[Row]) -> None:
        """Hands rows to the server's thread."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._take, rows)

    def _take(self, rows: Sequence[Row]) -> None:
        """Takes rows, within the loop."""
        raise NotImplementedError

    async def _serve(self) -> None:
        raise NotImplementedError

    def _ready(self) -> None:
        self._started.set()

    def _run(self) -> None:
        try:
            with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
                runner.run(self._serve())
        except Exception as error:
            self._error = error
        finally:
            self._started.set()
