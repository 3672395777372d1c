"""Work shared by processes: results in order, errors in their place, nothing left behind."""

import os
import signal
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchpose.errors import ConfigError
from torchpose.io.journal import Journal
from torchpose.io.processes import Crew


def squares(numbers: Sequence[int]) -> Iterator[tuple[int, int, int]]:
    """Square, process and threads of torch for each number; the even ones take longer."""
    for number in numbers:
        time.sleep(0.01 * (number % 2 == 0))
        if number < 0:
            raise ConfigError(f"{number}: is negative")
        yield number**2, os.getpid(), torch.get_num_threads()


@pytest.mark.parametrize("count", [1, 2, 3, 50])
def test_results_come_in_the_order_of_the_items_from_every_process(count: int) -> None:
    items = list(range(17))
    with Crew(squares, items, count) as crew:
        found = list(crew)
    assert [square for square, _, _ in found] == [item**2 for item in items]
    processes = [process for _, process, _ in found]
    assert len(set(processes)) == min(count, len(items))
    assert (os.getpid() in processes) == (count == 1)
    if count > 1:
        assert processes == [processes[i % count] for i in range(len(items))]
        assert {threads for _, _, threads in found} == {1}
        assert not any(alive(process) for process in processes)


@pytest.mark.timeout(120)
def test_threads_that_are_at_work_are_not_forked() -> None:
    """A caller of the library may have had OpenCV and torch use all cores; it has them again afterwards."""
    before = cv2.getNumThreads(), torch.get_num_threads()
    try:
        cv2.setNumThreads(3)
        torch.set_num_threads(3)
        torch.rand(1000, 1000) @ torch.rand(1000, 1000)  # what starts threads
        cv2.GaussianBlur(np.ones((2000, 2000), np.float32), (9, 9), 2.0)
        with Crew(blurred, list(range(4)), 2) as crew:
            found = list(crew)
        assert (cv2.getNumThreads(), torch.get_num_threads()) == (3, 3)
    finally:
        cv2.setNumThreads(before[0])
        torch.set_num_threads(before[1])
    assert found == [float(number) for number in range(4)]


def blurred(numbers: Sequence[int]) -> Iterator[float]:
    for number in numbers:
        picture = cv2.GaussianBlur(np.full((500, 500), float(number), np.float32), (9, 9), 2.0)
        yield float(torch.from_numpy(picture).mean().round())


def test_fresh_processes_share_the_work_as_forked_ones_do() -> None:
    """As in stores, and on systems that do not fork."""
    items = [torch.tensor(number) for number in range(5)]
    with Crew(partial(scaled, 3), items, 2, fresh=True, let_go=lambda: None) as crew:  # which no pickle takes
        found = list(crew)
    assert [value for value, _, _ in found] == [0, 3, 6, 9, 12]
    assert len({process for _, process, _ in found} | {os.getpid()}) == 3
    assert {threads for _, _, threads in found} == {1}


def scaled(factor: int, numbers: Sequence[torch.Tensor]) -> Iterator[tuple[int, int, int]]:
    yield from ((factor * int(number), os.getpid(), torch.get_num_threads()) for number in numbers)


def tensors(numbers: Sequence[int]) -> Iterator[torch.Tensor]:
    yield from (torch.full((2,), number) for number in numbers)


def test_tensors_outlive_the_process_that_made_them() -> None:
    with Crew(tensors, [1, 2, 3, 4], 2) as crew:
        time.sleep(0.2)  # both have ended
        assert torch.equal(torch.cat(list(crew)), torch.tensor([1, 1, 2, 2, 3, 3, 4, 4]))


def test_no_items_are_no_results() -> None:
    nothing: list[int] = []
    with Crew(squares, nothing, 3) as crew:
        assert list(crew) == []


def test_an_error_is_raised_behind_the_results_before_it() -> None:
    found: list[int] = []
    with pytest.raises(ConfigError, match="-5: is negative"), Crew(squares, [1, 2, 3, 4, -5, 6, 7], 2) as crew:
        found.extend(square for square, _, _ in crew)
    assert found == [1, 4, 9, 16]


def faulty(numbers: Sequence[int]) -> Iterator[int]:
    yield from (1 // number for number in numbers)


def test_an_error_of_the_program_says_where_it_was_raised() -> None:
    with pytest.raises(RuntimeError, match=r"ZeroDivisionError(.|\n)*in faulty"), Crew(faulty, [1, 0], 2) as crew:
        list(crew)


def dying(numbers: Sequence[int]) -> Iterator[int]:
    for number in numbers:
        if number == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        yield number


def test_a_process_that_is_ended_from_outside_is_one_line() -> None:
    found: list[int] = []
    with (
        pytest.raises(ConfigError, match=r"^--threads: one of 2 processes .* \(code -9\)"),
        Crew(dying, range(6), 2) as c,
    ):
        found.extend(c)
    assert found == [0, 1, 2]


def test_a_crew_that_is_left_early_leaves_no_process() -> None:
    with Crew(squares, range(1000), 2) as crew:
        process = next(iter(crew))[1]
        assert alive(process)
    assert not alive(process)


def test_a_lock_does_not_outlive_the_process_that_has_it(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    journal = Journal(path)
    with Crew(squares, range(1000), 2, let_go=journal.close) as crew:
        results = iter(crew)
        processes = [next(results)[1], next(results)[1]]
        with pytest.raises(ConfigError, match="another run"):
            Journal(path)
        journal.close()
        Journal(path).close()
        assert all(alive(process) for process in processes)


def alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True
