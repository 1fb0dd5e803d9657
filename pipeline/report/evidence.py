"""All that the report judges and shows, in one place, and which attitudes it shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.stage import Findings
from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.volume import LabelVolume
from pipeline.kinematics.joint_coordinates import JointCoordinates, moved_from_scan
from pipeline.kinematics.neutral import NeutralCurve
from pipeline.kinematics.table import Grid, RawTable, SmoothTable, Status
from pipeline.records import Anatomy, CaseFacts, MeshQuality, ScanReturn, SurfaceOrigin, SweepFacts

Float = NDArray[np.float64]

#: The four coordinates that are found, in the order of every table and plot: field, title, unit.
CURVES = (
    ("lateral_mm", "Lateral shift", "mm"),
    ("anterior_mm", "Anterior shift", "mm"),
    ("proximal_mm", "Proximal shift", "mm"),
    ("internal_rotation_deg", "Internal rotation", "deg"),
)


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the stages before left.

    ``ct_cuts`` are the CT numbers (HU) on the planes of the slices picture, None without a CT; ``findings`` is stage
    name -> its findings.
    """

    facts: CaseFacts
    labels: LabelVolume | None
    ct_cuts: tuple[NDArray[np.generic], ...] | None
    meshes: dict[str, TriangleMesh]
    mesh_quality: tuple[MeshQuality, ...]
    anatomy: Anatomy
    reference: TriangleMesh
    moving: TriangleMesh
    origins: tuple[SurfaceOrigin, ...]
    raw: RawTable
    scan_returns: tuple[ScanReturn, ...]
    sweep: SweepFacts
    neutral: NeutralCurve
    smooth: SmoothTable
    findings: Mapping[str, Findings]

    @property
    def scan_from_reference(self) -> Float:
        """(4, 4) kinematic frame of the reference body."""
        return np.asarray(self.anatomy.scan_from_reference, dtype=np.float64)

    @property
    def scan_from_moving(self) -> Float:
        """(4, 4) kinematic frame of the moving body."""
        return np.asarray(self.anatomy.scan_from_moving, dtype=np.float64)


@dataclass(frozen=True)
class Cell:
    """One entry of the table."""

    flexion_index: int
    varus_index: int
    flexion_deg: float
    varus_deg: float
    status: Status


def shown_flexions(grid: Grid, wanted_deg: list[float]) -> tuple[int, ...]:
    """Indices of the grid's flexions nearest to those wanted; its ends and middle where it holds fewer than two."""
    flexion = grid.flexion_deg
    inside = [f for f in wanted_deg if flexion[0] <= f <= flexion[-1]]
    chosen = inside if len(inside) > 1 else [flexion[0], (flexion[0] + flexion[-1]) / 2.0, flexion[-1]]
    return tuple(sorted({int(np.argmin(np.abs(flexion - f))) for f in chosen}))


def neutral_varus(grid: Grid) -> int:
    """Index of the varus nearest to zero."""
    return int(np.argmin(np.abs(grid.varus_deg)))


def shown_cells(table: SmoothTable, wanted_deg: list[float]) -> tuple[Cell, ...]:
    """Entries at neutral varus that pictures show."""
    varus = neutral_varus(table.grid)
    return tuple(cell(table, flexion, varus) for flexion in shown_flexions(table.grid, wanted_deg))


def cell(table: SmoothTable, flexion_index: int, varus_index: int) -> Cell:
    """The entry of the smoothed table at two indices."""
    return Cell(
        flexion_index,
        varus_index,
        float(table.grid.flexion_deg[flexion_index]),
        float(table.grid.varus_deg[varus_index]),
        Status(int(table.poses.status[flexion_index, varus_index])),
    )


def cell_motion(evidence: Evidence, shown: Cell) -> Float:
    """(4, 4) motion in scan space that takes the moving body, as scanned, to its smoothed pose of an entry."""
    at = (shown.flexion_index, shown.varus_index)
    poses = evidence.smooth.poses
    pose = JointCoordinates(
        float(np.radians(shown.flexion_deg)),
        float(np.radians(shown.varus_deg)),
        float(np.radians(poses.internal_rotation_deg[at])),
        float(poses.lateral_mm[at]),
        float(poses.anterior_mm[at]),
        float(poses.proximal_mm[at]),
    )
    return moved_from_scan(evidence.scan_from_reference, evidence.scan_from_moving, pose)
