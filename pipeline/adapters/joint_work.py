"""The work of solvers on one joint over threads and worker processes.

Compiled work runs in threads of this process, where the prepared bodies are shared; work that asks the collision
library runs in worker processes. Every result is in the order of the tasks and the same for any number of jobs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

from pipeline.adapters.contact_pool import ContactPair, map_contact
from pipeline.adapters.threads import map_threads
from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.cell import Claim, Proof, ProofSettings, prove
from pipeline.kinematics.contact import Bodies, Pose
from pipeline.kinematics.cross_check import Recheck, solve_recheck
from pipeline.kinematics.direct.settings import DirectSettings, MapSettings
from pipeline.kinematics.incremental import IncrementalSettings, StablePose
from pipeline.kinematics.jumps import Again, solve_again
from pipeline.kinematics.ligaments import NO_FIBRES, Fibres
from pipeline.kinematics.neutral import (
    NOT_FOUND,
    Compartments,
    NeutralCurve,
    brackets,
    neutral_curve,
    neutral_pose,
)
from pipeline.kinematics.smoothing import Entry, Probe, Settled, settle, way_to_contact
from pipeline.kinematics.solvers import IncrementalSolver, Solver
from pipeline.kinematics.sweep import (
    Certified,
    Found,
    Place,
    Release,
    Walk,
    Walked,
    angles_rad,
    attitude_deg,
    certified,
    go,
    let_go,
)
from pipeline.kinematics.table import Grid, RawTable

if TYPE_CHECKING:
    from pipeline.kinematics.direct.solver import DirectSolver

T = TypeVar("T")
R = TypeVar("R")

SolverName = Literal["direct", "incremental"]


@dataclass(frozen=True, eq=False)
class SolverSettings:
    """Which solver finds the poses, and the settings of both.

    Attributes
    ----------
    name : str
        ``direct`` or ``incremental``.
    fibres : Fibres
        Ligaments, attachments on the reference in its own frame.
    """

    name: SolverName = "direct"
    incremental: IncrementalSettings = IncrementalSettings()  # noqa: RUF009 - frozen
    direct: DirectSettings = DirectSettings()  # noqa: RUF009 - frozen
    map: MapSettings = MapSettings()  # noqa: RUF009 - frozen
    proof: ProofSettings = ProofSettings()  # noqa: RUF009 - frozen
    fibres: Fibres = NO_FIBRES


class Joint:
    """One pair of bodies and all that is asked of its solvers.

    Parameters
    ----------
    pair : ContactPair
    settings : SolverSettings
    jobs : int
        Threads, or worker processes.
    """

    def __init__(self, pair: ContactPair, settings: SolverSettings, jobs: int) -> None:
        self.pair, self.settings, self.jobs = pair, settings, jobs

    @cached_property
    def direct(self) -> DirectSolver:
        """The direct solver of the whole joint."""
        return self._direct(self.pair.moving)

    def walk(self, walks: Sequence[Walk], done: Callable[[int], None]) -> list[Walked]:
        """Solve the cells of every walk."""
        return self._solve(go, walks, done)

    def solve_again(self, cells: Sequence[Again]) -> list[list[Found]]:
        """Solve cells from other starts."""
        return self._solve(solve_again, cells)

    def certify(self, grid: Grid, found: Mapping[Place, Found]) -> dict[Place, Certified]:
        """Certificate and margin of every usable cell."""
        usable = {at: one.stable.pose for at, one in found.items() if one.stable.status.usable}
        tasks = [(attitude_deg(grid, at), pose) for at, pose in usable.items()]
        return dict(zip(usable, self._solve(certified, tasks), strict=True))

    def release(self, releases: Sequence[Release]) -> list[StablePose]:
        """Let the body go near the scan pose."""
        return self._solve(let_go, releases)

    def settle(self, entries: Sequence[Entry]) -> list[Settled]:
        """Bring smoothed entries to contact."""
        return map_threads(partial(settle, self.direct), entries, self.jobs)

    def ways_to_contact(self, probes: Sequence[Probe]) -> list[float]:
        """Signed ways along delta from poses to contact."""
        return map_threads(partial(way_to_contact, self.direct), probes, self.jobs)

    def prove(self, claims: Sequence[Claim], rechecks: Sequence[Recheck] = ()) -> tuple[list[Proof], list[StablePose]]:
        """Test poses by exact collision; solve a sample by the solver that did not make the table."""
        asked: list[Claim | Recheck] = list(rechecks) if self.settings.name == "direct" else []
        results = map_contact(partial(_examine, settings=self.settings), [*asked, *claims], self.pair, self.jobs)
        if self.settings.name == "direct":
            return results[len(asked) :], results[: len(asked)]
        return results, map_threads(partial(solve_recheck, self.direct), rechecks, self.jobs)

    def neutral(self, table: RawTable, varus_deg: float, centre: Pose) -> NeutralCurve:
        """The pose of neutral varus at each flexion, looked for nearest to a varus."""
        wanted, sides = brackets(table, varus_deg, centre), _sides(self.pair)
        found = len(wanted) * [NOT_FOUND]
        if sides is not None and any(wanted):
            parts = Compartments(self.direct, *(self._direct(side) for side in sides))
            found = map_threads(partial(neutral_pose, parts), wanted, self.jobs)
        return neutral_curve(table.grid.flexion_deg, tuple(found))

    def _direct(self, moving: TriangleMesh) -> DirectSolver:
        from pipeline.kinematics.direct.prepare import prepare  # noqa: PLC0415 - the compiler, not for a cached run
        from pipeline.kinematics.direct.solver import DirectSolver  # noqa: PLC0415 - the same

        bodies = prepare(self.pair.reference, moving, self.settings.map)
        return DirectSolver(bodies, self.settings.direct, self.settings.proof, self.settings.fibres)

    def _solve(
        self, work: Callable[[Solver, T], R], tasks: Sequence[T], done: Callable[[int], None] = lambda _: None
    ) -> list[R]:
        if self.settings.name == "direct":
            return map_threads(partial(work, self.direct), tasks, self.jobs, done)
        return map_contact(
            partial(_incrementally, work=work, settings=self.settings), tasks, self.pair, self.jobs, done
        )


def claims(grid: Grid, found: Mapping[Place, Found], known: Mapping[Place, Certified]) -> dict[Place, Claim]:
    """What is to be proven: every certified cell."""
    return {
        at: Claim(angles_rad(attitude_deg(grid, at)), found[at].stable.pose, one.certificate)
        for at, one in known.items()
    }


def _incrementally(bodies: Bodies, task: T, work: Callable[[Solver, T], R], settings: SolverSettings) -> R:
    return work(IncrementalSolver(bodies, settings.incremental, settings.proof, settings.fibres), task)


def _examine(bodies: Bodies, task: Claim | Recheck, settings: SolverSettings) -> Any:
    if isinstance(task, Recheck):
        quick = replace(settings.incremental, early_rejection=True)
        return _incrementally(bodies, task, solve_recheck, replace(settings, incremental=quick))
    return prove(bodies, task, settings.proof.ladder_mm)


def _sides(pair: ContactPair) -> tuple[TriangleMesh, TriangleMesh] | None:
    """Medial and lateral part of the moving body; None where nothing of one of them faces along delta."""
    mesh = pair.moving
    a, b, c = np.moveaxis(mesh.points[mesh.triangles], 1, 0)
    across, facing = (a + b + c)[:, 0] / 3.0, np.cross(b - a, c - a)[:, 2] > 0.0
    medial, lateral = across < -pair.eminence_mm, across > pair.eminence_mm
    if not ((medial & facing).any() and (lateral & facing).any()):
        return None
    return TriangleMesh(mesh.points, mesh.triangles[medial]), TriangleMesh(mesh.points, mesh.triangles[lateral])
