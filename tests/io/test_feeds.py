"""Feeds of rows, by clients as the programs of a cell would have them."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import socket
import time
from collections.abc import Callable
from typing import Any

import pytest

from torchpose.errors import ConfigError
from torchpose.io.feeds import Place
from torchpose.io.feeds.opcua import OpcUaFeed
from torchpose.io.feeds.websocket import WebSocketFeed
from torchpose.io.rows import POSE_SCHEMA, Row, fault_row
from torchpose.results import Status


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
    return port


def row(frame: str, target: str = "plate", **cells: Any) -> Row:
    return fault_row(frame, target, Status.OK, None) | cells


def until(done: Callable[[], bool]) -> None:
    end = time.monotonic() + 20
    while not done() and time.monotonic() < end:
        time.sleep(0.01)
    assert done()


def test_a_websocket_client_reads_rows_as_they_are_made() -> None:
    """The client example of docs/shell.md."""
    client = pytest.importorskip("websockets.sync.client")
    port = free_port()
    with WebSocketFeed(Place(port), schema=POSE_SCHEMA) as feed:
        with client.connect(f"ws://127.0.0.1:{port}") as one, client.connect(f"ws://127.0.0.1:{port}") as other:
            until(lambda: len(feed._clients) == 2)
            feed.publish([row("a", tz=250.5), row("b")])
            for connection in (one, other):
                first = json.loads(connection.recv(timeout=20))
                assert (first["frame"], first["tz"], list(first)) == ("a", 250.5, list(POSE_SCHEMA))
                assert json.loads(connection.recv(timeout=20))["frame"] == "b"
        until(lambda: not feed._clients)
        feed.publish([row("nobody listens")])


def test_a_slow_websocket_client_loses_rows_and_is_told_and_holds_up_nobody() -> None:
    client = pytest.importorskip("websockets.sync.client")
    port, count = free_port(), 20000
    text = "x" * 500
    with WebSocketFeed(Place(port), schema=POSE_SCHEMA) as feed, client.connect(f"ws://127.0.0.1:{port}") as slow:
        until(lambda: len(feed._clients) == 1)
        with client.connect(f"ws://127.0.0.1:{port}") as quick:
            until(lambda: len(feed._clients) == 2)
            start = time.process_time()
            for number in range(0, count, 100):
                feed.publish([row(f"{i}", reason=text) for i in range(number, number + 100)])
            assert time.process_time() - start < 10.0
            seen, dropped = set(), 0
            while str(count - 1) not in seen:
                message = json.loads(quick.recv(timeout=30))
                dropped += message.get("dropped", 0)
                seen.add(message.get("frame", ""))
            assert len(seen - {""}) + dropped == count
        seen, dropped = set(), 0
        while str(count - 1) not in seen:
            message = json.loads(slow.recv(timeout=30))
            dropped += message.get("dropped", 0)
            seen.add(message.get("frame", ""))
        assert dropped > 0
        assert len(seen - {""}) + dropped == count


def test_a_websocket_refuses_what_it_should() -> None:
    client = pytest.importorskip("websockets.sync.client")
    exceptions = pytest.importorskip("websockets.exceptions")
    port = free_port()
    address = f"ws://127.0.0.1:{port}"
    with WebSocketFeed(Place(port, token="secret"), schema=POSE_SCHEMA) as feed:
        for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "Bearer sécret"}):
            with pytest.raises(exceptions.InvalidStatus, match="401"):
                client.connect(address, additional_headers=headers)
        known = {"Authorization": "Bearer secret"}
        with pytest.raises(exceptions.InvalidStatus, match="403"):  # a page of anybody in a browser on this machine
            client.connect(address, additional_headers=known, origin="http://example.org")
        with client.connect(address, additional_headers=known) as talker:
            talker.send("hello")
            with pytest.raises(exceptions.ConnectionClosed, match="only sends"):
                talker.recv(timeout=20)
        with socket.create_connection(("127.0.0.1", port)) as rude:
            rude.sendall(b"\0" * 100000)
        with client.connect(address, additional_headers=known) as good:
            until(lambda: len(feed._clients) == 1)
            feed.publish([row("a")])
            assert json.loads(good.recv(timeout=20))["frame"] == "a"
        with pytest.raises(ConfigError, match=f"--websocket: 127.0.0.1:{port} cannot be served"):
            WebSocketFeed(Place(port), schema=POSE_SCHEMA).__enter__()


def test_a_flood_of_websockets_holds_up_nobody() -> None:
    """Connections that never greet, greetings beyond what is let in, messages and frames that are too long."""
    client = pytest.importorskip("websockets.sync.client")
    exceptions = pytest.importorskip("websockets.exceptions")
    port = free_port()
    address = f"ws://127.0.0.1:{port}"
    with WebSocketFeed(Place(port), schema=POSE_SCHEMA) as feed, contextlib.ExitStack() as stack:
        for number in range(100):
            silent = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10))
            silent.sendall((b"", b"GET / HT", b"GET / HTTP/1.1\r\nX: ")[number % 3])
        talker = stack.enter_context(client.connect(address, compression=None))
        with contextlib.suppress(exceptions.ConnectionClosed):
            talker.send("x" * 1_000_000)
        with pytest.raises(exceptions.ConnectionClosed):
            talker.recv(timeout=20)
        clients = [stack.enter_context(client.connect(address)) for _ in range(64)]
        until(lambda: len(feed._clients) == 64)
        with client.connect(address) as late, pytest.raises(exceptions.ConnectionClosed, match="too many"):
            late.recv(timeout=20)
        feed.publish([row("a")])
        assert all(json.loads(one.recv(timeout=20))["frame"] == "a" for one in clients)


@pytest.mark.parametrize(("host", "good"), [("::1", True), ("localhost", True), ("0.0.0.0", False), ("cell", False)])
def test_beyond_this_machine_there_has_to_be_a_token(host: str, good: bool) -> None:
    assert Place(1, host, "token").admits("token")
    if good:
        assert Place(1, host).admits(None)
    else:
        with pytest.raises(ConfigError, match="add --token"):
            Place(1, host)


def test_an_opcua_client_reads_the_latest_row_of_each_target() -> None:
    """The client example of docs/shell.md, with a token."""
    asyncua = pytest.importorskip("asyncua")
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    port = free_port()
    address = f"opc.tcp://127.0.0.1:{port}/torchpose"

    async def read(target: str, count: int) -> dict[str, Any]:
        client = asyncua.Client(address)
        client.set_user("torchpose")
        client.set_password("secret")
        async with client:
            space = await client.get_namespace_index("urn:torchpose")
            names = ("count", "frame", "status", "reason", "tx", "tz", "markers", "row")
            nodes = [client.get_node(f"ns={space};s=torchpose/{target}/{name}") for name in names]
            for _ in range(1000):
                values = dict(zip(names, [await node.read_value() for node in nodes], strict=True))
                if values["count"] == count:
                    break
                await asyncio.sleep(0.02)
            with pytest.raises(asyncua.ua.UaStatusCodeError):
                await nodes[1].write_value("mine")
            return values

    async def refused() -> None:
        client = asyncua.Client(address)
        with pytest.raises(Exception, match=r"BadUser|BadIdentity|identity"):
            async with client:
                pass

    with OpcUaFeed(Place(port, token="secret"), targets=["plate", "a b"], schema=POSE_SCHEMA) as feed:
        feed.publish([row("1", tz=250.5, tx=1.0, markers=4), row("1", "a b", reason="residual")])
        feed.publish([row("2", tz=251.5, instance=0), row("2", tz=1.0, instance=1)])
        plate = asyncio.run(read("plate", 3))
        assert (plate["count"], plate["frame"], plate["tz"], plate["status"]) == (3, "2", 251.5, "ok")
        assert math.isnan(plate["tx"])
        assert [one["tz"] for one in json.loads(plate["row"])] == [251.5, 1.0]
        other = asyncio.run(read("a b", 1))
        assert (other["frame"], other["reason"]) == ("1", "residual")
        assert json.loads(other["row"]) == row("1", "a b", reason="residual")
        asyncio.run(refused())
