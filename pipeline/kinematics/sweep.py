"""The sweep: a stable pose for every attitude of the grid, each started from its neighbour's.

The *spine* is the column of varus nearest to the scan's own, walked along flexion from the scan upwards and downwards.
From each of its cells a *rib* walks out in varus to either side, as an examiner would open the knee at a held flexion.
Every walk goes out to its end and back again: the way out is kept, because it is connected to the scan; the way back
measures the hysteresis, and steps in only where the way out found nothing. Walks do not depend on one another (ribs
only on the spine), so any number of workers gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from pipeline.kinematics.cell import Cell, ProofSettings, failed_cell, measured_cell
from pipeline.kinematics.contact import AttitudeContact, Bodies, Pose
from pipeline.kinematics.incremental import IncrementalSettings, StablePose, solve_incremental
from pipeline.kinematics.table import Float, Grid, PoseTable, RawTable, Status


@dataclass(frozen=True)
class SweepSettings:
    """Solver and proof of a sweep."""

    solver: IncrementalSettings = field(default_factory=IncrementalSettings)
    proof: ProofSettings = field(default_factory=ProofSettings)


class Walk(NamedTuple):
    """A walk over neighbouring cells: their (row, column) and their (flexion, varus) in degrees, and the start.

    ``centre`` is the middle of the bounds of every cell: the scan pose.
    """

    cells: tuple[tuple[int, int], ...]
    attitudes_deg: tuple[tuple[float, float], ...]
    start: Pose
    centre: Pose


class Release(NamedTuple):
    """A body let go at the scan's attitude (deg), away from the scan pose by (dx, dy, dtheta) in mm and rad."""

    flexion_deg: float
    varus_deg: float
    scan: Pose
    away: tuple[float, float, float]


class Walked(NamedTuple):
    """What a walk found, in the order of its cells: on the way out and on the way back."""

    cells: tuple[tuple[int, int], ...]
    out: tuple[Cell, ...]
    back: tuple[Cell, ...]


def spine(grid: Grid, scan_flexion_deg: float, scan_varus_deg: float, scan: Pose) -> tuple[Walk, ...]:
    """Walks along flexion at the varus nearest the scan's, from its nearest flexion up and down; longest first.

    Parameters
    ----------
    grid : Grid
    scan_flexion_deg, scan_varus_deg : float
        Attitude of the scan.
    scan : Pose
        Found coordinates of the scan itself.
    """
    row, column = _nearest(grid.flexion_deg, scan_flexion_deg), _nearest(grid.varus_deg, scan_varus_deg)
    ways = [[(r, column) for r in range(row, grid.shape[0])], [(r, column) for r in range(row - 1, -1, -1)]]
    walks = [_walk_over(grid, way, scan, scan) for way in ways if way]
    return tuple(sorted(walks, key=lambda walk: -len(walk.cells)))


def ribs(grid: Grid, spine_walked: Sequence[Walked], scan: Pose) -> tuple[Walk, ...]:
    """Walks along varus from every cell of the spine, to either side.

    A rib whose own cell of the spine failed starts from the nearest row that did not; none can start where all failed.
    """
    starts = {at: cell.pose for at, cell in _kept(spine_walked).items() if cell.status.usable}
    if not starts:
        return ()
    column = next(iter(starts))[1]
    walks = []
    for row in range(grid.shape[0]):
        start = starts[min(starts, key=lambda at: (abs(at[0] - row), at[0]))]
        for way in (range(column + 1, grid.shape[1]), range(column - 1, -1, -1)):
            if way:
                walks.append(_walk_over(grid, [(row, c) for c in way], start, scan))
    return tuple(walks)


def _nearest(values: Float, wanted: float) -> int:
    return int(np.argmin(np.abs(values - wanted)))


def _walk_over(grid: Grid, cells: Sequence[tuple[int, int]], start: Pose, centre: Pose) -> Walk:
    attitudes = [(float(grid.flexion_deg[row]), float(grid.varus_deg[column])) for row, column in cells]
    return Walk(tuple(cells), tuple(attitudes), start, centre)


def go(bodies: Bodies, walk: Walk, settings: SweepSettings) -> Walked:
    """Solve the cells of one walk outwards and back, each started from the last usable pose."""
    contacts = [AttitudeContact(bodies, np.radians(f), np.radians(v)) for f, v in walk.attitudes_deg]
    out, last = _pass(contacts, walk.start, walk.centre, settings)
    back, _ = _pass(contacts[::-1], last, walk.centre, settings)
    return Walked(walk.cells, out, back[::-1])


def let_go(bodies: Bodies, release: Release, settings: SweepSettings) -> StablePose:
    """Where a body comes to rest that was let go near the scan pose, pulled back far enough to be clear."""
    contact = AttitudeContact(bodies, np.radians(release.flexion_deg), np.radians(release.varus_deg))
    return solve_incremental(contact, release.scan.displaced(release.away), settings.solver, release.scan)


def _pass(
    attitudes: Sequence[AttitudeContact], start: Pose, centre: Pose, settings: SweepSettings
) -> tuple[tuple[Cell, ...], Pose]:
    cells = []
    for contact in attitudes:
        solved = solve_incremental(contact, start, settings.solver, centre)
        if solved.status is Status.OK:
            start = solved.pose
        cells.append(_cell(contact, solved, settings))
    return tuple(cells), start


def _cell(contact: AttitudeContact, solved: StablePose, settings: SweepSettings) -> Cell:
    if solved.status is not Status.OK:
        return failed_cell(solved.status, solved.motions)
    return measured_cell(contact, solved.pose, solved.status, settings.proof, solved.motions)


def assemble(grid: Grid, walked: Sequence[Walked]) -> RawTable:
    """The raw table of a whole grid from its walks; cells that no walk reached are NOT_CONVERGED."""
    kept = _kept(walked)
    unreached = failed_cell(Status.NOT_CONVERGED)
    cells = [[kept.get((row, column), unreached) for column in range(grid.shape[1])] for row in range(grid.shape[0])]
    hysteresis_mm, hysteresis_deg = np.full(grid.shape, np.nan), np.full(grid.shape, np.nan)
    for walk in walked:
        for at, out, back in zip(walk.cells, walk.out, walk.back, strict=True):
            hysteresis_mm[at], hysteresis_deg[at] = _difference(out, back)
    return RawTable(
        grid=grid,
        poses=pose_table(cells),
        iterations=np.array([[c.motions for c in row] for row in cells], dtype=np.int32),
        gap_before_mm=np.array([[c.gap_before_mm for c in row] for row in cells]),
        gap_after_mm=np.array([[c.gap_after_mm for c in row] for row in cells]),
        hysteresis_mm=hysteresis_mm,
        hysteresis_deg=hysteresis_deg,
    )


def _kept(walked: Sequence[Walked]) -> dict[tuple[int, int], Cell]:
    return {
        at: back if back.status.usable and not out.status.usable else out
        for walk in walked
        for at, out, back in zip(walk.cells, walk.out, walk.back, strict=True)
    }


def _difference(out: Cell, back: Cell) -> tuple[float, float]:
    """Shift (mm) and rotation (deg) between two passes; NaN when not both are usable."""
    difference = np.subtract(out.pose, back.pose)
    return float(np.linalg.norm(difference[:3])), float(np.degrees(abs(difference[3])))


def pose_table(cells: Sequence[Sequence[Cell]]) -> PoseTable:
    """The table of a grid of cells, rows by flexion and columns by varus."""

    def of(pick: Callable[[Cell], float]) -> Float:
        return np.array([[pick(cell) for cell in row] for row in cells], dtype=np.float64)

    return PoseTable(
        lateral_mm=of(lambda c: c.pose.x),
        anterior_mm=of(lambda c: c.pose.y),
        proximal_mm=of(lambda c: c.pose.z),
        internal_rotation_deg=np.degrees(of(lambda c: c.pose.theta)),
        status=np.array([[c.status for c in row] for row in cells], dtype=np.uint8),
        equilibrium_residual=of(lambda c: c.residual),
        medial_gap_mm=of(lambda c: c.medial_gap_mm),
        lateral_gap_mm=of(lambda c: c.lateral_gap_mm),
        contact_count=np.array([[c.contact_count for c in row] for row in cells], dtype=np.int32),
    )
