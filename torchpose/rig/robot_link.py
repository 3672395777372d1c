"""The parent's end of the robot's child process: one request, one answer, one deadline."""

from __future__ import annotations

import contextlib
import json
import queue
import subprocess
import tempfile
import threading
import time
from typing import IO, Any

from torchpose.rig.processes import start_module

_END_S = 1.0  # for a process that has been told to end


class LinkError(Exception):
    """A request failed in the child; its text says how, `reason` is the name of a `RobotReason` where it is known."""

    def __init__(self, message: str, reason: str | None = None) -> None:
        super().__init__(message)
        self.reason = reason


class LinkLate(LinkError):
    """No answer within the deadline; the child has been killed."""


class LinkEnded(LinkError):
    """The child process has ended by itself."""


class RobotLink:
    """A running child process (`torchpose.rig.robot_child`)."""

    def __init__(self) -> None:
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - closed in close()
        self._process = start_module("torchpose.rig.robot_child", stderr=self._log)
        self._answers: queue.Queue[str] = queue.Queue()
        self._lock = threading.Lock()
        self._requests = 0
        assert self._process.stdout is not None
        threading.Thread(target=_pump, args=(self._process.stdout, self._answers), daemon=True).start()

    @property
    def pid(self) -> int:
        """Number of the child process."""
        return self._process.pid

    def call(self, name: str, timeout_s: float, **arguments: Any) -> Any:
        """The result of one request.

        Raises:
            LinkLate: no answer within `timeout_s`, waiting for a request of another thread included.
            LinkEnded: the child has ended. LinkError: the request failed.
        """
        deadline = time.monotonic() + timeout_s
        if not self._lock.acquire(timeout=timeout_s):
            self.kill()
            raise LinkLate(f"{name}: no answer within {timeout_s:g} s")
        try:
            assert self._process.stdin is not None
            self._requests += 1
            self._process.stdin.write(json.dumps({"call": name, "id": self._requests, **arguments}) + "\n")
            self._process.stdin.flush()
            answer = self._wait(self._requests, deadline)
        except queue.Empty:
            self.kill()
            raise LinkLate(f"{name}: no answer within {timeout_s:g} s") from None
        except (OSError, ValueError):  # the pipe is broken or closed
            answer = None
        finally:
            self._lock.release()
        if answer is None:
            raise LinkEnded(self._last_words())
        if "result" not in answer:
            raise LinkError(answer.get("error", ""), answer.get("reason"))
        return answer["result"]

    def _wait(self, request: int, deadline: float) -> dict[str, Any] | None:
        """The answer to a request; None when the child has ended."""
        while line := self._answers.get(timeout=max(0.0, deadline - time.monotonic())):
            answer: dict[str, Any] = json.loads(line)
            if answer["id"] == request:  # an older one was given up, for a Ctrl-C came
                return answer
        self._answers.put("")  # for whoever asks next
        return None

    def _last_words(self) -> str:
        """The end of what ur-rtde printed, for the message."""
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").split("\n")
        return next((line.strip() for line in reversed(lines) if line.strip()), "it printed nothing")

    def kill(self) -> None:
        """Ends the child at once."""
        self._process.kill()

    def close(self, timeout_s: float) -> None:
        """Has the child disconnect and end; kills it when that takes longer than `timeout_s`."""
        try:
            self.call("close", timeout_s)
            self._process.wait(_END_S)
        except (LinkError, subprocess.TimeoutExpired):
            self.kill()
        self._process.wait()
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # what a dead child did not read
            self._process.stdin.close()
        self._log.close()


def _pump(stream: IO[str], answers: queue.Queue[str]) -> None:
    """Moves lines from the child to the queue, so that they can be waited for with a deadline; "" is the end."""
    with stream:
        for line in stream:
            answers.put(line)
    answers.put("")
