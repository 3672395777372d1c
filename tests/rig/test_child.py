"""The line to the child process, without a robot at its other end."""

from __future__ import annotations

import importlib.util
import os
import signal
import time
from collections.abc import Iterator

import pytest

from torchpose.rig.child import Child, ChildEnded, ChildError, ChildLate

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("rtde_control") is None, reason="needs ur-rtde: pip install '.[rig]'"
)


@pytest.fixture
def link() -> Iterator[Child]:
    running = Child("torchpose.rig.robot_child", quiet=True)
    yield running
    running.close(1.0)


def test_answers_to_requests_that_were_given_up_are_dropped(link: Child) -> None:
    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.01)  # Python alone takes longer to start
    try:
        with pytest.raises(KeyboardInterrupt):
            link.call("load", 20.0)
    finally:
        signal.signal(signal.SIGALRM, previous)
    with pytest.raises(ChildError, match="NoneType"):  # its own answer: nothing is connected
        link.call("read", 20.0, fresh=1)
    assert link.call("load", 20.0) is None


def test_a_late_child_is_killed(link: Child) -> None:
    with pytest.raises(ChildLate, match="load: no answer within 0 s"):
        link.call("load", 0.0)
    with pytest.raises(ChildEnded):
        link.call("load", 5.0)


def test_a_dead_child_is_noticed_by_every_later_request(link: Child) -> None:
    link.call("load", 20.0)
    os.kill(link.pid, signal.SIGKILL)
    for _ in range(3):
        begin = time.monotonic()
        with pytest.raises(ChildEnded, match="it printed nothing"):
            link.call("read", 5.0, fresh=1)
        assert time.monotonic() - begin < 2.0
