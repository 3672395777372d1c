"""The dashboard client against servers that misbehave."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import pytest

from torchpose.rig import dashboard


@contextmanager
def server(host: str, behaviour: Callable[[socket.socket], None]) -> Iterator[None]:
    """Serves one connection in a thread."""
    listening = socket.create_server((host, dashboard.PORT))

    def serve() -> None:
        connection, _ = listening.accept()
        with connection, suppress(OSError):  # the client may have had enough
            behaviour(connection)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        thread.join()
        listening.close()


def test_answers_belong_to_their_commands_however_they_are_cut(loopback: str) -> None:
    def behaviour(connection: socket.socket) -> None:
        for byte in b"Connected: Universal Robots Dashboard Server\n":
            connection.sendall(bytes([byte]))
        assert connection.recv(100) == b"robotmode\n"
        connection.sendall(b"Robotmode: RUN")
        time.sleep(0.02)
        connection.sendall(b"NING\n")
        assert connection.recv(100) == b"running\n"
        connection.sendall(b"Program running: false\n")

    with server(loopback, behaviour):
        answers = dashboard.ask(loopback, ["robotmode", "running"], 5.0)
    assert answers == ["Robotmode: RUNNING", "Program running: false"]


def test_the_deadline_holds_for_a_server_that_never_ends_its_line(loopback: str) -> None:
    def behaviour(connection: socket.socket) -> None:
        while True:
            connection.sendall(b".")
            time.sleep(0.02)

    begin = time.monotonic()
    with server(loopback, behaviour), pytest.raises(TimeoutError):
        dashboard.ask(loopback, ["robotmode"], 0.3)
    assert 0.3 <= time.monotonic() - begin < 1.5


def test_stop_reports_whether_the_controller_confirmed(loopback: str) -> None:
    def refuses(connection: socket.socket) -> None:
        connection.sendall(b"Connected\n")
        connection.recv(100)
        connection.sendall(b"Failed to execute: stop\n")

    assert dashboard.stop(loopback, 0.2) is False  # nobody there
    with server(loopback, refuses):
        assert dashboard.stop(loopback, 2.0) is False
    with server(loopback, lambda connection: None):  # closes at once
        assert dashboard.stop(loopback, 2.0) is False
