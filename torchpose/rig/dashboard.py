"""The dashboard server of a UR controller: text commands on port 29999, each answered by one line.

Plain sockets with a deadline and no state: `stop` has to work from a signal handler while everything else hangs.
"""

import socket
import time
from collections.abc import Sequence

PORT = 29999


def ask(host: str, commands: Sequence[str], timeout_s: float) -> list[str]:
    """The answers to the commands, over one new connection, all within `timeout_s`.

    Raises:
        TimeoutError: no complete answer within the time.
        OSError: no connection.
    """
    deadline = time.monotonic() + timeout_s
    with socket.create_connection((host, PORT), timeout_s) as connection:
        answers = [_read_line(connection, deadline)]  # greeting
        for command in commands:
            connection.sendall(command.encode("ascii") + b"\n")
            answers.append(_read_line(connection, deadline))
    return answers[1:]


def _read_line(connection: socket.socket, deadline: float) -> str:
    line = b""
    while not line.endswith(b"\n"):
        if (left := deadline - time.monotonic()) <= 0:
            raise TimeoutError
        connection.settimeout(left)
        line += (byte := connection.recv(1))  # lines are short, and nothing of the next answer may be taken
        if not byte:
            raise ConnectionResetError("the dashboard server closed the connection")
    return line.decode("utf-8", errors="replace").strip()


def stop(host: str, timeout_s: float) -> bool:
    """Ends the robot's program, which brakes the robot; whether the controller confirmed it in time."""
    try:
        return ask(host, ["stop"], timeout_s) == ["Stopped"]
    except OSError:
        return False
