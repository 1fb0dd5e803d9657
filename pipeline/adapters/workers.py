"""Independent tasks over worker processes: the results come back in the order of the tasks."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import forkserver, get_all_start_methods, get_context, parent_process
from multiprocessing.connection import wait
from multiprocessing.context import BaseContext, ForkServerContext
from threading import Thread
from typing import TypeVar

from pipeline.errors import EnvironmentFault

#: What workers use; loading it takes a second or two, once for all workers of a run.
PRELOADED = ("fcl", "matplotlib.figure", "numpy", "scipy.ndimage", "scipy.spatial", "vtkmodules.vtkFiltersCore")

T = TypeVar("T")
R = TypeVar("R")


def map_in_order(
    work: Callable[[T], R],
    tasks: Sequence[T],
    jobs: int,
    done: Callable[[int], None] = lambda _: None,
    prepare: Callable[[], object] | None = None,
) -> list[R]:
    """``[work(task) for task in tasks]`` over ``jobs`` processes.

    Workers take the tasks in the order given: with the longest first, all end at about the same time.

    Parameters
    ----------
    work : callable
        A function of a module (it is sent by name); must not depend on the order of tasks.
    tasks : sequence
    jobs : int
        1 runs here, without a process; so does a single task.
    done : callable
        Told the index of each finished task, in the order they finish.
    prepare : callable, optional
        Called once in each worker process before its first task; not called here.

    Raises
    ------
    EnvironmentFault
        ``E-ENV-30`` when a worker process dies. What ``work`` raises is raised here as well.
    """
    if jobs <= 1 or len(tasks) <= 1:
        return _in_this_process(work, tasks, done)
    begin = partial(_begin, prepare)
    with ProcessPoolExecutor(min(jobs, len(tasks)), _context(), initializer=begin) as pool:
        try:
            futures = [pool.submit(work, task) for task in tasks]
            _report(futures, done)
            return [future.result() for future in futures]
        except BrokenProcessPool as error:
            raise EnvironmentFault(
                "E-ENV-30",
                "A worker process ended before its work was done; most often the memory did not suffice.",
                "Run again with fewer workers (--jobs 1), or on a computer with more memory.",
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def get_ready() -> None:
    """Begin to load what workers use, in the server they are forked from; returns at once."""
    if isinstance(_context(), ForkServerContext):
        forkserver.ensure_running()


def _context() -> BaseContext:
    """Workers are forked from a small server that has loaded the libraries once; started afresh where none can be."""
    if "forkserver" not in get_all_start_methods():
        return get_context("spawn")
    context = get_context("forkserver")
    context.set_forkserver_preload(["__main__", *PRELOADED])
    return context


def _begin(prepare: Callable[[], object] | None) -> None:
    """What a worker does first; from then on it ends with the run, also with one that is killed."""
    parent = parent_process()
    if parent is not None:
        Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    if prepare is not None:
        prepare()


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os.kill(os.getpid(), signal.SIGKILL)


def _in_this_process(work: Callable[[T], R], tasks: Sequence[T], done: Callable[[int], None]) -> list[R]:
    results = []
    for index, task in enumerate(tasks):
        results.append(work(task))
        done(index)
    return results


def _report(futures: list[Future[R]], done: Callable[[int], None]) -> None:
    index = {future: k for k, future in enumerate(futures)}
    for future in as_completed(futures):
        future.result()
        done(index[future])
