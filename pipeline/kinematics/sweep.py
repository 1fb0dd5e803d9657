"""The sweep: a stable pose for every attitude of the grid, each started from its neighbour's.

A column is one varus value. From the flexion nearest the scan's own, one arm walks up the column and one down; each
walks out to its end and back again, so that every cell is reached from both sides: the difference is the hysteresis,
and the deeper of the two is kept. Arms do not depend on one another, so any number of workers gives the same bytes.
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


class Arm(NamedTuple):
    """One walk over a column: the attitudes in order of the way out, degrees, and the pose to start from."""

    column: int
    rows: tuple[int, ...]
    flexion_deg: tuple[float, ...]
    varus_deg: float
    start: Pose


class Release(NamedTuple):
    """A body let go at the scan's attitude (deg), away from the scan pose by (dx, dy, dtheta) in mm and rad."""

    flexion_deg: float
    varus_deg: float
    scan: Pose
    away: tuple[float, float, float]


class ArmResult(NamedTuple):
    """Cells of one arm in the order of its rows: on the way out and on the way back."""

    column: int
    rows: tuple[int, ...]
    out: tuple[Cell, ...]
    back: tuple[Cell, ...]


def arms(grid: Grid, scan_flexion_deg: float, scan: Pose) -> tuple[Arm, ...]:
    """The independent walks that cover the grid, longest first.

    Parameters
    ----------
    grid : Grid
    scan_flexion_deg : float
        Flexion of the scan; its nearest row is where every column starts.
    scan : Pose
        Found coordinates of the scan itself.
    """
    middle = int(np.argmin(np.abs(grid.flexion_deg - scan_flexion_deg)))
    up, down = tuple(range(middle, grid.shape[0])), tuple(range(middle, -1, -1))
    walks = [rows for rows in (up, down) if len(rows) > 1] or [up]
    built = [
        Arm(column, rows, tuple(float(grid.flexion_deg[r]) for r in rows), float(varus), scan)
        for rows in walks
        for column, varus in enumerate(grid.varus_deg)
    ]
    return tuple(sorted(built, key=lambda arm: -len(arm.rows)))


def walk(bodies: Bodies, arm: Arm, settings: SweepSettings) -> ArmResult:
    """Solve the cells of one arm outwards and back, each started from the last usable pose."""
    attitudes = [AttitudeContact(bodies, np.radians(f), np.radians(arm.varus_deg)) for f in arm.flexion_deg]
    out, last = _pass(attitudes, arm.start, arm.start, settings)
    back, _ = _pass(attitudes[::-1], last, arm.start, settings)
    return ArmResult(arm.column, arm.rows, out, back[::-1])


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


def assemble(grid: Grid, results: Sequence[ArmResult]) -> RawTable:
    """The raw table of a whole grid from its arms; the deeper of the two passes is kept, the way out on a tie."""
    kept: dict[tuple[int, int], Cell] = {}
    hysteresis_mm, hysteresis_deg = np.full(grid.shape, np.nan), np.full(grid.shape, np.nan)
    for result in results:
        for row, out, back in zip(result.rows, result.out, result.back, strict=True):
            at = (row, result.column)
            hysteresis_mm[at], hysteresis_deg[at] = _worst(hysteresis_mm[at], hysteresis_deg[at], out, back)
            for cell in (out, back):
                if at not in kept or _better(cell, kept[at]):
                    kept[at] = cell
    cells = [[kept[(row, column)] for column in range(grid.shape[1])] for row in range(grid.shape[0])]
    return RawTable(
        grid=grid,
        poses=pose_table(cells),
        iterations=np.array([[c.motions for c in row] for row in cells], dtype=np.int32),
        gap_before_mm=np.array([[c.gap_before_mm for c in row] for row in cells]),
        gap_after_mm=np.array([[c.gap_after_mm for c in row] for row in cells]),
        hysteresis_mm=hysteresis_mm,
        hysteresis_deg=hysteresis_deg,
    )


def _better(cell: Cell, held: Cell) -> bool:
    if cell.status.usable != held.status.usable:
        return cell.status.usable
    return cell.status.usable and cell.pose.z > held.pose.z


def _worst(mm: float, deg: float, out: Cell, back: Cell) -> tuple[float, float]:
    """The larger of what is known and what these two passes differ by (NaN when not both are usable)."""
    difference = np.subtract(out.pose, back.pose)
    way, turn = float(np.linalg.norm(difference[:3])), float(np.degrees(abs(difference[3])))
    return float(np.fmax(mm, way)), float(np.fmax(deg, turn))


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
