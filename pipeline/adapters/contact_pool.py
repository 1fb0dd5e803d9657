"""Contact work over worker processes: the hierarchies are built once in each, tasks come back in the order given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from pipeline.adapters.workers import map_in_order
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
        return map_in_order(partial(work, pair.bodies()), tasks, 1, done)
    return map_in_order(partial(_run, work), tasks, jobs, done, partial(_build, pair))


def _build(pair: ContactPair) -> None:
    global _bodies  # noqa: PLW0603 - a worker process holds exactly one pair for its whole life
    _bodies = pair.bodies()


def _run(work: Callable[[Bodies, Any], R], task: Any) -> R:
    if _bodies is None:
        raise RuntimeError("a worker was asked before it was given its bodies")
    return work(_bodies, task)
