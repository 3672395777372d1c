"""Work shared by several processes, its results in the order of the items.

Threads share one interpreter, which eager torch keeps busy between its operations, and which kornia_rs holds while it
decodes. Processes share nothing. They are forked where the system does that safely (Linux), after all imports: that
takes milliseconds, where a fresh interpreter needs a second of CPU before its first frame. Work that speaks to a store
has fresh ones everywhere: a connection cannot be forked.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import pickle
import signal
import sys
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.context import BaseContext
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

import cv2
import torch

from torchpose.errors import ConfigError
from torchpose.kernels.memory import keep_memory

Item = TypeVar("Item")
Result = TypeVar("Result")
_AHEAD = 4  # results of a process that wait for their turn (convention): none idles while another has a slow item


def _nothing() -> None:
    pass


class Crew(Generic[Item, Result]):
    """Iterates over the results of items; a context manager, whose processes end with it.

    Item k goes to process k modulo ``count``, so that no result depends on who is quicker; with one process, or one
    item, the work is done here. Every process has one thread of torch.

    Args:
        work: from a share of the items to their results, one by one and in order. Its state is that of the moment the
            crew is made, a copy for every process. Its errors are raised here, behind the results before them.
        items: all of them.
        count: of processes, at most.
        let_go: called in every process that is forked, at first: closes what is this process's alone, such as a
            locked file.
        fresh: whether none may be forked, see above; ``work`` is pickled then.
    """

    def __init__(
        self,
        work: Callable[[Sequence[Item]], Iterator[Result]],
        items: Sequence[Item],
        count: int,
        let_go: Callable[[], None] = _nothing,
        *,
        fresh: bool = False,
    ) -> None:
        self._work, self._items = work, items
        count = min(count, len(items))
        self._ends: list[Connection] = []
        self._processes: list[Any] = []
        if count < 2:
            return
        context = _context(fresh)
        forked = context.get_start_method() == "fork"
        with _without_threads() if forked else contextlib.nullcontext():
            for number in range(count):
                end, theirs = context.Pipe(duplex=False)
                self._ends.append(end)
                # forked, a process has the ends of all before it: unless it closes them, none notices that this is gone
                what: _Share = (work, items[number::count])
                arguments = (what, theirs, self._ends, let_go) if forked else (pickle.dumps(what), theirs, [], _nothing)
                process: Any = context.Process(target=_serve, args=arguments, daemon=True)  # type: ignore[attr-defined]
                process.start()
                self._processes.append(process)
                theirs.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        for process in self._processes:
            process.terminate()
            process.join()
        for end in self._ends:
            end.close()

    def __iter__(self) -> Iterator[Result]:
        """
        Raises:
            ConfigError: a process was ended from outside.
        """
        if not self._processes:
            yield from self._work(self._items)
            return
        count = len(self._ends)
        waiting: list[deque[Any]] = [deque() for _ in self._ends]
        left = [len(self._items[number::count]) for number in range(count)]
        for number in range(len(self._items)):
            mine = waiting[number % count]
            while not mine:
                self._receive(waiting, left)
            well, result = mine.popleft()
            if not well:
                raise result
            yield result

    def _receive(self, waiting: list[deque[Any]], left: list[int]) -> None:
        """Takes what has come from those processes that are not far ahead; ``left`` is what each has yet to send."""
        numbers = {end: k for k, end in enumerate(self._ends) if left[k] and len(waiting[k]) < _AHEAD}
        for end in wait(list(numbers)):
            number = numbers[end]  # type: ignore[index]
            try:
                message = pickle.loads(self._ends[number].recv_bytes())
            except EOFError:
                message = False, self._ended(number)
            left[number] = left[number] - 1 if message[0] else 0
            waiting[number].append(message)

    def _ended(self, number: int) -> ConfigError:
        self._processes[number].join()
        return ConfigError(
            f"--threads: one of {len(self._ends)} processes was ended from outside (code "
            f"{self._processes[number].exitcode}), for want of memory perhaps; give fewer --threads or a smaller "
            "--batch, and --resume to go on"
        )


def one_thread() -> None:
    """Has torch and OpenCV use one thread in this process, and OpenCV print nothing; freed memory is kept."""
    keep_memory()
    _set_threads(1, 1)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


@contextlib.contextmanager
def _without_threads() -> Iterator[None]:
    """Ends the threads of OpenCV and torch meanwhile: a forked process has none of them, and waits for them in vain."""
    before = torch.get_num_threads(), cv2.getNumThreads()
    _set_threads(1, 1)
    try:
        yield
    finally:
        _set_threads(*before)


def _set_threads(of_torch: int, of_opencv: int) -> None:
    torch.set_num_threads(of_torch)
    cv2.setNumThreads(of_opencv)


def _context(fresh: bool) -> BaseContext:
    """Forking is safe on Linux, where the libraries of the system start no threads of their own."""
    return multiprocessing.get_context("spawn" if fresh or sys.platform != "linux" else "fork")


_Share = tuple[Callable[[Sequence[Any]], Iterator[Any]], Sequence[Any]]  # work and its items


def _serve(
    what: _Share | bytes,
    end: Connection,
    inherited: Sequence[Connection],
    let_go: Callable[[], None],
) -> None:
    """Sends ``(True, result)`` for each item of a share, or ``(False, error)`` and no more.

    A fresh process is given its share as bytes: tensors that are handed over otherwise have an open file each.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal interrupts all processes; the first one ends the others
    for other in inherited:
        other.close()
    let_go()
    one_thread()
    with contextlib.suppress(BrokenPipeError):  # nobody waits for the results any more
        try:
            work, share = pickle.loads(what) if isinstance(what, bytes) else what
            for result in work(share):
                _send(end, (True, result))
        except BrokenPipeError:
            raise
        except Exception as error:
            _send(end, (False, _portable(error)))


def _send(end: Connection, message: tuple[bool, Any]) -> None:
    """As bytes: `Connection.send` leaves tensors with this process, which may be gone when they are fetched."""
    end.send_bytes(pickle.dumps(message))


def _portable(error: Exception) -> Exception:
    """The error as it arrives in another process; with where it was raised, if it is none of a user's."""
    if isinstance(error, ConfigError | OSError | MemoryError):
        return error
    trace = "".join(traceback.format_exception(error))
    return RuntimeError(f"{type(error).__name__}: {error}\n{trace}")
