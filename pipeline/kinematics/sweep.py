"""The sweep: a stable pose for every attitude of the grid, each started from its neighbour's.

The *spine* is the column of varus nearest to the scan's own, walked along flexion from the scan upwards and downwards.
From each of its cells a *rib* walks out in varus to either side, as an examiner would open the knee at a held flexion.
The spine is walked out to its ends and back again: the way out is kept, because it is connected to the scan; the way
back measures the hysteresis, and steps in only where the way out found nothing. Ribs and the way back depend only on
the spine, so any number of workers gives the same bytes. Then jumps between neighbours are solved again
from both sides (see :mod:`pipeline.kinematics.jumps`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.kinematics.cell import Cell, Certificate, Proof, failed_cell
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.incremental import StablePose
from pipeline.kinematics.solvers import Margin, Solver
from pipeline.kinematics.table import Float, Grid, PoseTable, RawTable, Status

Place = tuple[int, int]

#: So many cells of the spine are walked at a time.
STRETCH = 24


class Walk(NamedTuple):
    """A walk over neighbouring cells: their (row, column) and their (flexion, varus) in degrees, and the start.

    ``centre`` is the middle of the bounds of every cell: the scan pose.
    """

    cells: tuple[Place, ...]
    attitudes_deg: tuple[tuple[float, float], ...]
    start: Pose
    centre: Pose

    def between(self, first: int, last: int) -> Walk:
        """The walk over some of the cells only."""
        return self._replace(cells=self.cells[first:last], attitudes_deg=self.attitudes_deg[first:last])

    def after(self, walked: Walked, count: int) -> Walk:
        """What is left of the walk when its first cells have been walked."""
        return self.between(count, len(self.cells))._replace(start=walked.end(self.start))


class Release(NamedTuple):
    """A body let go at the scan's attitude (deg), away from the scan pose by (dx, dy, dtheta) in mm and rad."""

    flexion_deg: float
    varus_deg: float
    scan: Pose
    away: tuple[float, float, float]


class Found(NamedTuple):
    """A solved cell: where the search was begun, and what it found."""

    start: Pose
    stable: StablePose


class Certified(NamedTuple):
    """What is known of a stable pose by the features it rests on."""

    certificate: Certificate
    margin: Margin


class Walked(NamedTuple):
    """What a walk found, in the order of its cells."""

    cells: tuple[Place, ...]
    found: tuple[Found, ...]

    def end(self, start: Pose) -> Pose:
        """The last usable pose, or the start."""
        poses = [one.stable.pose for one in self.found if one.stable.status.usable]
        return poses[-1] if poses else start


class Ways(NamedTuple):
    """What was found on the ways out, which reach every cell, and on the way back over the spine."""

    out: tuple[Walked, ...]
    back: tuple[Walked, ...]


def walk_grid(
    grid: Grid, scan_deg: tuple[float, float], scan: Pose, walk: Callable[[Sequence[Walk]], list[Walked]]
) -> Ways:
    """Walk the spine by stretches, and beside each the ribs of the stretch before; the way back at the end.

    Parameters
    ----------
    grid : Grid
    scan_deg : (flexion, varus)
        Attitude of the scan.
    scan : Pose
        Found coordinates of the scan itself.
    walk : callable
        Makes the walks given, which do not depend on one another.
    """
    first = spine(grid, scan_deg[0], scan_deg[1], scan)
    ahead, along = first, tuple(Walked((), ()) for _ in first)
    out, ready, begun = list[Walked](), tuple[Walk, ...](), set[int]()
    while any(one.cells for one in ahead):
        stretches = tuple(one.between(0, STRETCH) for one in ahead)
        results = walk((*stretches, *ready))
        out += results[len(ahead) :]
        done = results[: len(ahead)]
        ahead = tuple(one.after(new, STRETCH) for one, new in zip(ahead, done, strict=True))
        along = tuple(
            Walked(old.cells + new.cells, old.found + new.found) for old, new in zip(along, done, strict=True)
        )
        rows = {
            at[0] for one in done for at, found in zip(one.cells, one.found, strict=True) if found.stable.status.usable
        }
        ready, begun = ribs(grid, along, scan, rows), begun | rows
    returns = way_back(first, along)
    rest = walk((*returns, *ready, *ribs(grid, along, scan, set(range(grid.shape[0])) - begun)))
    return Ways((*along, *out, *rest[len(returns) :]), tuple(rest[: len(returns)]))


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


def ribs(grid: Grid, along: Sequence[Walked], scan: Pose, rows: Iterable[int]) -> tuple[Walk, ...]:
    """Walks along varus from the cells of the spine in some rows, to either side.

    A rib whose own cell of the spine failed starts from the nearest row that did not; none can start where all failed.
    """
    starts = {at: one.stable.pose for at, one in _by_cell(along).items() if one.stable.status.usable}
    if not starts:
        return ()
    column = next(iter(starts))[1]
    walks = []
    for row in sorted(rows):
        start = starts[min(starts, key=lambda at: (abs(at[0] - row), at[0]))]
        for way in (range(column + 1, grid.shape[1]), range(column - 1, -1, -1)):
            if way:
                walks.append(_walk_over(grid, [(row, c) for c in way], start, scan))
    return tuple(walks)


def way_back(walks: Sequence[Walk], walked: Sequence[Walked]) -> tuple[Walk, ...]:
    """Each walk from its end to its beginning, started from the last usable pose."""
    return tuple(
        Walk(walk.cells[::-1], walk.attitudes_deg[::-1], one.end(walk.start), walk.centre)
        for walk, one in zip(walks, walked, strict=True)
    )


def _nearest(values: Float, wanted: float) -> int:
    return int(np.argmin(np.abs(values - wanted)))


def _walk_over(grid: Grid, cells: Sequence[Place], start: Pose, centre: Pose) -> Walk:
    attitudes = [attitude_deg(grid, at) for at in cells]
    return Walk(tuple(cells), tuple(attitudes), start, centre)


def attitude_deg(grid: Grid, at: Place) -> tuple[float, float]:
    """Flexion and varus of a cell."""
    return float(grid.flexion_deg[at[0]]), float(grid.varus_deg[at[1]])


def angles_rad(attitude: tuple[float, float]) -> tuple[float, float]:
    """(flexion, varus) in radians, from degrees."""
    return float(np.radians(attitude[0])), float(np.radians(attitude[1]))


def go(solver: Solver, walk: Walk) -> Walked:
    """Solve the cells of one walk, each started from the last usable pose."""
    start, found = walk.start, list[Found]()
    for attitude in walk.attitudes_deg:
        stable = solver.at(angles_rad(attitude)).solve(start, walk.centre)
        found.append(Found(start, stable))
        start = stable.pose if stable.status.usable else start
    return Walked(walk.cells, tuple(found))


def certified(solver: Solver, at: tuple[tuple[float, float], Pose]) -> Certified:
    """Certificate and margin of a stable pose at (flexion, varus) in degrees."""
    attitude = solver.at(angles_rad(at[0]))
    margin = attitude.margin(at[1])  # first: what it prepares serves the certificate
    return Certified(attitude.certify(at[1]), margin)


def let_go(solver: Solver, release: Release) -> StablePose:
    """Where a body comes to rest that was let go near the scan pose."""
    attitude = solver.at(angles_rad((release.flexion_deg, release.varus_deg)))
    return attitude.solve(release.scan.displaced(release.away), release.scan)


def kept(ways: Ways) -> dict[Place, Found]:
    """What each cell keeps: the way out, or the way back where only that found a pose."""
    found = _by_cell(ways.out)
    for at, back in _by_cell(ways.back).items():
        if back.stable.status.usable and not found[at].stable.status.usable:
            found[at] = back
    return found


def _by_cell(walked: Sequence[Walked]) -> dict[Place, Found]:
    return {at: one for walk in walked for at, one in zip(walk.cells, walk.found, strict=True)}


class Hysteresis(NamedTuple):
    """Way out against way back, (F, V): mm and deg; NaN where not both are usable."""

    shift_mm: Float
    rotation_deg: Float


def hysteresis(grid: Grid, ways: Ways) -> Hysteresis:
    """What the way out and the way back differ by."""
    shift, rotation, outwards = np.full(grid.shape, np.nan), np.full(grid.shape, np.nan), _by_cell(ways.out)
    for at, back in _by_cell(ways.back).items():
        out = outwards[at]
        if out.stable.status.usable and back.stable.status.usable:
            difference = np.subtract(out.stable.pose, back.stable.pose)
            shift[at] = float(np.linalg.norm(difference[:3]))
            rotation[at] = float(np.degrees(abs(difference[3])))
    return Hysteresis(shift, rotation)


class Evidence(NamedTuple):
    """What is known of the usable cells: by the features they rest on, and by exact collision."""

    certified: Mapping[Place, Certified]
    proofs: Mapping[Place, Proof]


def assemble(grid: Grid, found: Mapping[Place, Found], evidence: Evidence, passes: Hysteresis) -> RawTable:
    """The raw table of a whole grid; cells that no walk reached are NOT_CONVERGED."""

    def cell(at: Place) -> Cell:
        if at not in found:
            return failed_cell(Status.NOT_CONVERGED)
        stable = found[at].stable
        if not stable.status.usable:
            return failed_cell(stable.status, stable.motions)
        return Cell(stable.pose, stable.status, stable.motions, evidence.certified[at].certificate, evidence.proofs[at])

    def margin(pick: Callable[[Margin], float]) -> Float:
        out = np.full(grid.shape, np.nan)
        for at, one in evidence.certified.items():
            out[at] = pick(one.margin)
        return out

    cells = [[cell((row, column)) for column in range(grid.shape[1])] for row in range(grid.shape[0])]
    return RawTable(
        grid=grid,
        poses=pose_table(cells),
        iterations=np.array([[c.motions for c in row] for row in cells], dtype=np.int32),
        gap_before_mm=np.array([[c.proof.gap_before_mm for c in row] for row in cells]),
        gap_after_mm=np.array([[c.proof.gap_after_mm for c in row] for row in cells]),
        hysteresis_mm=passes.shift_mm,
        hysteresis_deg=passes.rotation_deg,
        margin_lateral_mm=margin(lambda one: one.lateral_mm),
        margin_anterior_mm=margin(lambda one: one.anterior_mm),
        margin_rotation_deg=margin(lambda one: one.rotation_deg),
    )


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
        equilibrium_residual=of(lambda c: c.certificate.residual),
        medial_gap_mm=of(lambda c: c.proof.medial_gap_mm),
        lateral_gap_mm=of(lambda c: c.proof.lateral_gap_mm),
        contact_count=np.array([[c.certificate.contact_count for c in row] for row in cells], dtype=np.int32),
    )
