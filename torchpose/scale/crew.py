"""Items worked on by a Ray cluster, as `torchpose.io.processes.Crew` has them worked on by processes."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, Self, TypeVar

import numpy as np

from torchpose.io.processes import one_thread
from torchpose.scale.cluster import answered, answers

Item = TypeVar("Item")
Result = TypeVar("Result")


class RayCrew(Generic[Item, Result]):
    """Iterates over the results of items, in their order; for a program that is connected to a cluster.

    Args:
        work: from some of the items to their results, one by one and in order. A worker that is lost costs its items'
            time: another does them again, so doing one twice must leave what doing it once leaves.
        items: all of them.
        count: of workers, at most.
        fresh: as of `Crew`; these workers always are.
    """

    def __init__(
        self,
        work: Callable[[Sequence[Item]], Iterator[Result]],
        items: Sequence[Item],
        count: int,
        *,
        fresh: bool = True,
    ) -> None:
        self._work, self._items, self._count = work, items, count

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def __iter__(self) -> Iterator[Result]:
        """
        Raises:
            ConfigError: what a worker raised, in one line.
        """
        if not self._items:
            return
        import ray.data

        count = min(self._count, len(self._items))
        rows = [{"number": number, "item": pickle.dumps(item)} for number, item in enumerate(self._items)]
        data: ray.data.Dataset = ray.data.from_items(rows, override_num_blocks=len(rows))
        data = data.map_batches(
            _Worker,
            fn_constructor_args=(self._work,),
            batch_size=1,
            num_cpus=1,
            compute=ray.data.ActorPoolStrategy(min_size=1, max_size=count, initial_size=count),
        )
        early: dict[int, Any] = {}
        following = 0
        for row, result in answers(data, "result"):
            early[row["number"]] = result
            while following in early:
                yield early.pop(following)
                following += 1


class _Worker:
    """Holds what the work needs, and does one item at a time."""

    def __init__(self, work: Callable[[Sequence[Any]], Iterator[Any]]) -> None:
        one_thread()
        self._work = work

    def __call__(self, batch: dict[str, np.ndarray]) -> dict[str, Any]:
        result = answered(lambda: next(iter(self._work([pickle.loads(batch["item"][0])]))))
        return {"number": batch["number"], "result": np.array([result], dtype=object)}
