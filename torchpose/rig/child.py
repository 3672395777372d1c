"""A process beside ours that answers requests: JSON lines over its pipes, a deadline for each.

Both ends are here: `Child` in the parent, `serve` in the child. It is a fresh interpreter, not a fork, and not
`multiprocessing`, whose children import the user's script again. It has a session of its own, so that a Ctrl-C at the
terminal reaches only the parent, which decides what to do.
"""

import contextlib
import itertools
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import torchpose


class ChildError(Exception):
    """A request failed in the child; its text says how, `reason` names the kind where it is known."""

    def __init__(self, message: str, reason: str | None = None) -> None:
        super().__init__(message)
        self.reason = reason


class ChildLate(ChildError):
    """No answer within the deadline; the child has been killed."""


class ChildEnded(ChildError):
    """The child process has ended by itself."""


class Child:
    """A running ``python -m MODULE``, whose main function calls `serve`.

    Args:
        module: of this package.
        quiet: what it prints is kept for the message of `ChildEnded`; else it goes to our standard error.
    """

    def __init__(self, module: str, *, quiet: bool = False) -> None:
        paths = [str(Path(torchpose.__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
        self._log = tempfile.TemporaryFile() if quiet else None  # noqa: SIM115 - closed in close()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
            start_new_session=True,
        )
        self._numbers = itertools.count(1)
        self._waiting: dict[int, Future[dict[str, Any] | None]] = {}  # requests by their number
        self._ended = False
        self._lock = threading.Lock()
        threading.Thread(target=self._receive, daemon=True).start()

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def call(self, name: str, timeout_s: float, **arguments: Any) -> Any:
        """The result of one request; one of another thread is answered first.

        Raises:
            ChildLate: no answer within `timeout_s`.
            ChildEnded: the child has ended.
            ChildError: the request failed.
        """
        number, reply = next(self._numbers), Future[dict[str, Any] | None]()
        self._waiting[number] = reply
        assert self._process.stdin is not None
        try:
            with self._lock:
                self._process.stdin.write(json.dumps({"call": name, "id": number, **arguments}) + "\n")
                self._process.stdin.flush()
            answer = None if self._ended else reply.result(timeout_s)
        except TimeoutError:
            self.kill()
            raise ChildLate(f"{name}: no answer within {timeout_s:g} s") from None
        except (OSError, ValueError):  # the pipe is broken or closed
            answer = None
        finally:
            self._waiting.pop(number, None)  # a late answer, given up for a Ctrl-C came, is for nobody
        if answer is None:
            raise ChildEnded(self._last_words())
        if "error" in answer:
            raise ChildError(answer["error"], answer["reason"])
        return answer["result"]

    def _receive(self) -> None:
        """Hands answers to whom they belong, in a thread of its own: so they can be waited for with a deadline."""
        assert self._process.stdout is not None
        # a last line may be torn, and what is no answer ends the talk
        with self._process.stdout as stream, contextlib.suppress(ValueError, KeyError, TypeError):
            for line in stream:
                answer = json.loads(line)
                if reply := self._waiting.pop(answer["id"], None):
                    reply.set_result(answer)
        self._ended = True
        for reply in list(self._waiting.values()):
            reply.set_result(None)

    def _last_words(self) -> str:
        """The last line that a quiet child has printed."""
        if self._log is not None and not self._log.closed:
            self._log.seek(0)
            if lines := self._log.read().decode(errors="replace").strip().splitlines():
                return lines[-1].strip()
        return "it printed nothing"

    def kill(self) -> None:
        """Ends the child at once."""
        self._process.kill()

    def close(self, timeout_s: float) -> None:
        """Ends the child by closing its standard input; kills it when that takes longer than `timeout_s`."""
        with contextlib.suppress(OSError):  # what a dead child did not read
            self._process.stdin.close()  # type: ignore[union-attr]
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.kill()
            self._process.wait()
        if self._log is not None:
            self._log.close()


def serve(answer: Callable[..., Any]) -> None:
    """The child's end: calls ``answer(NAME, ...)`` for each request, until the parent closes the pipe or is gone.

    ``{"call": NAME, "id": N, ...}`` is answered with ``{"result": ...}`` or ``{"error": ..., "reason": ...}``.
    """
    pipe = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # whatever else is printed must not be taken for an answer
    for line in sys.stdin:
        request = json.loads(line)
        call, number = request.pop("call"), request.pop("id")
        try:
            message = {"result": answer(call, **request)}
        except Exception as error:
            text = " ".join(str(getattr(error, "strerror", None) or error).split())
            message = {"error": text, "reason": error.reason if isinstance(error, ChildError) else None}
        pipe.write(json.dumps({"id": number, **message}) + "\n")
