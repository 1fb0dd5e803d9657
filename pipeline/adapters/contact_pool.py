"""Contact work over worker processes: the hierarchies are built once in each, tasks come back in the order given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any, TypeVar

from pipeline.errors import EnvironmentFault
from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.contact import Bodies

if TYPE_CHECKING:
    from pipeline.adapters.fcl_contact import FclBodies

T = TypeVar("T")
R = TypeVar("R")

_bodies: FclBodies | None = None


@dataclass(frozen=True, eq=False)
class ContactPair:
    """What a worker needs to build the two bodies; meshes in their kinematic frames, mm."""

    reference: TriangleMesh
    moving: TriangleMesh
    eminence_mm: float

    def bodies(self) -> FclBodies:
        """The pair with its hierarchies."""
        from pipeline.adapters.fcl_contact import FclBodies  # noqa: PLC0415 - not loaded by a cached run

        return FclBodies(self.reference, self.moving, self.eminence_mm)


def map_contact(
    work: Callable[[Bodies, T], R],
    tasks: Sequence[T],
    pair: ContactPair,
    jobs: int,
    done: Callable[[int], None] = lambda _: None,
) -> list[R]:
    """``[work(bodies, task) for task in tasks]`` over ``jobs`` processes.

    Parameters
    ----------
    work : callable
        A function of a module (it is sent by name); must not depend on the order of tasks.
    tasks : sequence
    pair : ContactPair
    jobs : int
        1 runs here, without a process.
    done : callable
        Told the index of each finished task, in the order they finish.
    """
    if jobs <= 1 or len(tasks) <= 1:
        return _in_this_process(work, tasks, pair, done)
    workers = min(jobs, len(tasks))
    with ProcessPoolExecutor(workers, get_context("spawn"), initializer=_build, initargs=(pair,)) as pool:
        try:
            futures = [pool.submit(_run, work, task) for task in tasks]
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


def _in_this_process(
    work: Callable[[Bodies, T], R], tasks: Sequence[T], pair: ContactPair, done: Callable[[int], None]
) -> list[R]:
    bodies, results = pair.bodies(), []
    for index, task in enumerate(tasks):
        results.append(work(bodies, task))
        done(index)
    return results


def _report(futures: list[Future[R]], done: Callable[[int], None]) -> None:
    index = {future: k for k, future in enumerate(futures)}
    for future in as_completed(futures):
        future.result()
        done(index[future])


def _build(pair: ContactPair) -> None:
    global _bodies  # noqa: PLW0603 - a worker process holds exactly one pair for its whole life
    _bodies = pair.bodies()


def _run(work: Callable[[Bodies, Any], R], task: Any) -> R:
    if _bodies is None:
        raise RuntimeError("a worker was asked before it was given its bodies")
    return work(_bodies, task)
