"""Rows over a WebSocket: each a text message, a line of JSON as in a ``.jsonl`` table.

A client that does not keep up loses the oldest of the rows that wait for it, and is told of how many by a message
``{"dropped": n}`` in their place. Where there is a token, clients send it as ``Authorization: Bearer TOKEN``.

What clients send is not wanted: the first message ends the connection, and so does
an ``Origin``, which pages in a browser have: a page of anybody could listen on this machine.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections import deque
from collections.abc import Sequence
from http import HTTPStatus
from typing import Any

from torchpose.io.feeds.thread import Feed, Place
from torchpose.io.rows import Row, Schema
from torchpose.io.writers import json_line

_MOST_WAITING = 256  # rows of a client (convention): some batches
_MOST_CLIENTS = 64  # (convention)
_UNSUPPORTED, _LATER = 1003, 1013  # codes of RFC 6455 and of its registry: data that is not wanted; try again later
_GREETING_S = 5.0  # that a client may take for its first request (convention)
_MOST_BYTES = 1024  # of a message from a client, which nobody reads
_SILENT = logging.getLogger("torchpose.feeds")
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False


class WebSocketFeed(Feed):
    """Serves rows at ``ws://host:port``.

    Args:
        place: where to listen.
        schema: columns of the rows.
    """

    option = "--websocket"

    def __init__(self, place: Place, *, schema: Schema) -> None:
        super().__init__(place)
        self._schema = schema
        self._clients: set[_Client] = set()

    def _take(self, rows: Sequence[Row]) -> None:
        if self._clients:
            lines = [json_line(row, self._schema).rstrip("\n") for row in rows]
            for client in self._clients:
                client.offer(lines)

    async def _serve(self) -> None:
        from websockets.asyncio.server import serve

        # the buffer towards a client is short, so that what waits is counted here; no compression: no memory for it
        options: dict[str, Any] = {"max_size": _MOST_BYTES, "compression": None, "origins": [None], "logger": _SILENT}
        options |= {"write_limit": 1 << 15, "close_timeout": 1.0, "open_timeout": _GREETING_S}
        options |= {"process_request": self._admit}
        async with serve(self._attend, self._place.host, self._place.port, **options):
            self._ready()
            await self._stopped.wait()

    def _admit(self, connection: Any, request: Any) -> Any:
        """Refuses, by a response, who does not know the token."""
        given = request.headers.get("Authorization", "").removeprefix("Bearer ")
        return None if self._place.admits(given) else connection.respond(HTTPStatus.UNAUTHORIZED, "token\n")

    async def _attend(self, connection: Any) -> None:
        """One client, from its greeting to its end."""
        if len(self._clients) >= _MOST_CLIENTS:
            await connection.close(_LATER, "too many clients")
            return
        client = _Client(connection)
        self._clients.add(client)
        sending = asyncio.ensure_future(client.send())
        try:
            async for _ in connection:
                await connection.close(_UNSUPPORTED, "this feed only sends")
                break
        finally:
            self._clients.discard(client)
            sending.cancel()


class _Client:
    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self._waiting: deque[str] = deque()
        self._dropped = 0
        self._some = asyncio.Event()

    def offer(self, lines: Sequence[str]) -> None:
        self._waiting.extend(lines)
        while len(self._waiting) > _MOST_WAITING:
            self._waiting.popleft()
            self._dropped += 1
        self._some.set()

    async def send(self) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            while True:
                await self._some.wait()
                self._some.clear()
                while self._waiting or self._dropped:
                    if self._dropped:
                        told, self._dropped = json.dumps({"dropped": self._dropped}), 0
                        await self._connection.send(told)
                    else:
                        await self._connection.send(self._waiting.popleft())
        except ConnectionClosed:
            pass
