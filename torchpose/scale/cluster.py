"""A Ray cluster for the time of a command: its own on this machine, or one that is there."""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, cast

from torchpose.errors import ConfigError
from torchpose.io.storage import StorageError

_CONNECT = 5.0  # seconds (convention)


@dataclass(frozen=True)
class Workers:
    """Number of cores of a cluster, and the nodes that it began with."""

    count: int
    nodes: frozenset[str]

    def lost(self) -> int:
        """How many of these nodes are gone."""
        return len(self.nodes - {node["NodeID"] for node in _nodes() if node["Alive"]})


@contextlib.contextmanager
def cluster(address: str | None, workers: int) -> Iterator[Workers]:
    """Connects, or starts a cluster of so many cores that ends with the block.

    Raises:
        ConfigError: Ray is not installed, the address does not answer, or its nodes lack this version of torchpose.
    """
    try:
        import ray
        import ray.data
    except ImportError:
        raise ConfigError("--engine ray: Ray is not installed; install it with pip install 'torchpose[ray]'") from None
    if address is not None:
        _check_answers(address)
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR, "include_dashboard": False}
    own: dict[str, Any] = {"address": address or "local"}  # not one that happens to run here
    if address is None:
        own["num_cpus"] = workers
        os.environ.setdefault("RAY_worker_niceness", "0")  # Ray's own 15 gives way to whatever else runs here
    else:
        del quiet["include_dashboard"]
    try:
        ray.init(**own, **quiet)
    except (ConnectionError, ValueError, RuntimeError, TimeoutError, OSError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        where = "" if address is None else f"{address}: "
        raise ConfigError(f"{where}--address: no Ray cluster answers ({reason}); start one with ray start") from None
    # on standard output Ray prints the logs of nodes that it loses; commands tell their number in one line
    nowhere = open(os.devnull, "w")  # noqa: SIM115  # open for as long as Ray's threads may print
    try:
        _silence()
        if address is not None:
            _check_nodes()
        resources: Any = ray.cluster_resources  # without types
        alive = frozenset(node["NodeID"] for node in _nodes() if node["Alive"])
        with contextlib.redirect_stdout(nowhere):
            yield Workers(int(resources().get("CPU", 1)), alive)
    finally:
        with contextlib.redirect_stdout(nowhere):
            ray.shutdown()  # which prints what is left of them
        nowhere.close()


def _check_answers(address: str) -> None:
    """Raises ConfigError unless something listens there; Ray itself would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdigit()):
        if address in ("auto", "local"):
            return
        raise ConfigError(f"{address}: --address: is none; give HOST:PORT, ray://HOST:PORT or auto")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT).close()
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(
            f"{address}: --address: no Ray cluster answers ({reason}); start one with ray start --head"
        ) from None


def _silence() -> None:
    """Progress is shown by the command itself."""
    import ray.data

    context = ray.data.DataContext.get_current()
    context.enable_progress_bars = False
    context.enable_operator_progress_bars = False
    for name in ("ray", "ray.data"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _nodes() -> list[dict[str, Any]]:
    import ray

    nodes = cast(Any, ray.nodes)  # without types
    return list(nodes())


def _check_nodes() -> None:
    """Raises ConfigError unless every node has this version of torchpose."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    own = version("torchpose")

    def installed() -> str:
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("torchpose")
        except PackageNotFoundError:
            return ""

    asked = {}
    for node in _nodes():
        if node["Alive"] and node["Resources"].get("CPU"):
            strategy = NodeAffinitySchedulingStrategy(node_id=node["NodeID"], soft=True)
            task = ray.remote(installed).options(num_cpus=0, scheduling_strategy=strategy)
            asked[node["NodeManagerHostname"]] = task.remote()
    for name, answer in asked.items():
        found = ray.get(answer)
        if found != own:
            has = f"has torchpose {found}" if found else "lacks torchpose"
            raise ConfigError(f"{name}: --address: this node of the cluster {has}; install torchpose {own} there")


def answered(work: Callable[[], Any]) -> bytes:
    """What a worker sends: ``(True, result)``, or ``(False, error)`` of the user or of a store, as a result.

    What is raised in a worker reaches the command as text alone, without its cause.
    """
    try:
        return pickle.dumps((True, work()))
    except (ConfigError, StorageError) as error:
        return pickle.dumps((False, error))


def answers(data: Any, column: str) -> Iterator[tuple[dict[str, Any], Any]]:
    """The rows of a data set as they are done, with the result in a column (`answered`).

    Raises:
        ConfigError: what a worker has answered or raised, in one line.
    """
    import ray.exceptions

    try:
        for row in data.iter_rows():
            well, result = pickle.loads(row[column])
            if not well:
                raise result
            yield row, result
    except StorageError as error:
        raise ConfigError(f"--out: {error}; add --resume to go on") from None
    except ray.exceptions.RayError as error:
        raise ConfigError(f"--engine ray: a worker ended ({_reason(error)}); add --resume to go on") from None


def _reason(error: Exception) -> str:
    """The line of Ray's text that says what was raised in a worker: the last of the first traceback."""
    first = str(error).partition("\n\nThe above exception")[0]
    lines = [line.strip() for line in first.splitlines() if line.strip()] or [type(error).__name__]
    return lines[-1][:200]
