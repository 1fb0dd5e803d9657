"""Compiled work over threads: kernels let go of the interpreter, so bodies are shared and nothing is sent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def map_threads(
    work: Callable[[T], R], tasks: Sequence[T], jobs: int, done: Callable[[int], None] = lambda _: None
) -> list[R]:
    """``[work(task) for task in tasks]`` over ``jobs`` threads.

    Parameters
    ----------
    work : callable
        Must not depend on the order of tasks.
    tasks : sequence
    jobs : int
    done : callable
        Told the index of each finished task, in the order they finish.
    """
    with ThreadPoolExecutor(max(1, min(jobs, len(tasks)))) as pool:
        futures = {pool.submit(work, task): index for index, task in enumerate(tasks)}
        try:
            for future in as_completed(futures):
                future.result()
                done(futures[future])
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        return [future.result() for future in futures]
