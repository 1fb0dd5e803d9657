"""A small made-up table: smooth curves, oblique frames, a box and a slab as bodies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.files.lut_content import LutFileContent
from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.joint_coordinates import rigid, rotation_x, rotation_y, rotation_z
from pipeline.kinematics.neutral import NeutralCurve
from pipeline.kinematics.table import CurveFit, Grid, PoseTable, RawTable, SmoothTable, Status

Float = NDArray[np.float64]

GRID = Grid(np.arange(0.0, 61.0, 5.0), np.array([-4.0, -1.0, 0.0, 2.5]))

_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_FACES = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip  # noqa: E501


def box(half_size_mm: tuple[float, float, float], centre_mm: tuple[float, float, float]) -> TriangleMesh:
    """A closed box, outward normals."""
    return TriangleMesh(_CORNERS * half_size_mm + centre_mm, np.array(_FACES, dtype=np.int32))


def poses(grid: Grid, bad: tuple[tuple[int, int], ...] = ()) -> PoseTable:
    """Curves that are no polynomial of low degree; ``bad`` entries slid off."""
    f, v = np.meshgrid(grid.flexion_deg, grid.varus_deg, indexing="ij")
    status = np.zeros(grid.shape, dtype=np.uint8)
    for cell in bad:
        status[cell] = Status.SLID_OFF
    gone = status > Status.SMOOTHED
    curves = {
        "lateral_mm": 2 * np.sin(f / 40) + 0.1 * v,
        "anterior_mm": -f / 20 + np.cos(f / 25),
        "proximal_mm": 0.5 * np.cos(f / 30) - 0.05 * v,
        "internal_rotation_deg": 12 * np.sin(f / 50) + v,
        "equilibrium_residual": np.full(grid.shape, 0.02),
        "medial_gap_mm": 0.01 * np.abs(v),
        "lateral_gap_mm": 0.5 + 0.01 * np.abs(v),
    }
    return PoseTable(
        **{name: np.where(gone, np.nan, curve) for name, curve in curves.items()},
        status=status,
        contact_count=np.full(grid.shape, 4, np.int32),
    )


def frames(side: str) -> tuple[Float, Float]:
    """Oblique kinematic frames far from the origin; left-handed for a left joint."""
    hand = np.diag([1.0 if side == "right" else -1.0, 1.0, 1.0])
    reference = rotation_x(0.3) @ rotation_y(-0.2) @ rotation_z(2.8)
    moving = rotation_z(0.1) @ reference @ rotation_x(-0.15)
    return rigid(reference @ hand, np.array([120.0, -80.0, 640.0])), rigid(
        moving @ hand, np.array([118.0, -79.0, 601.0])
    )


def neutral(grid: Grid) -> NeutralCurve:
    """Straight lines, each its own; no neutral varus at the last flexion where there are several."""
    along = np.linspace(-1.0, 1.0, grid.shape[0])
    status = np.zeros(grid.shape[0], dtype=np.uint8)
    status[1:][-1:] = Status.NO_CONTACT
    names = ("varus_deg", "lateral_mm", "anterior_mm", "proximal_mm", "internal_rotation_deg", "uneven_mm")
    lines = {name: np.where(status == Status.OK, along + k, np.nan) for k, name in enumerate(names)}
    return NeutralCurve(grid.flexion_deg, **lines, status=status)


def content(side: str = "right", grid: Grid = GRID, bad: tuple[tuple[int, int], ...] = ()) -> LutFileContent:
    """A whole table file."""
    table = poses(grid, bad)
    count = np.ones(grid.shape, dtype=np.int32)
    number = np.full(grid.shape, 0.25)
    raw = RawTable(grid, table, count, number, number, np.full(grid.shape, np.nan), number, *3 * (2.0 * number,))
    smooth = SmoothTable(
        grid,
        table,
        (
            CurveFit("lateral_mm", "mm", np.arange(6.0).reshape(3, 2), 0.1, 0.3),
            CurveFit("internal_rotation_deg", "deg", np.ones((2, 3)), 0.2, 0.4),
        ),
        np.array([0.0, 60.0]),
        np.array([-4.0, 2.5]),
        np.zeros(grid.shape),
        np.zeros((grid.shape[0] - 1, grid.shape[1])),
    )
    reference, moving = frames(side)
    return LutFileContent(
        joint="knee",
        side=side,
        software="ct2lut 0.0.0",
        smooth=smooth,
        raw=raw,
        neutral=neutral(grid),
        scan_from_reference=reference,
        scan_from_moving=moving,
        delta=moving[:3, 2].copy(),
        scan_attitude=np.array([8.0, 1.0, 3.0, 0.5, -1.0, 2.0]),
        reference_body=box((30.0, 20.0, 5.0), (120.0, -80.0, 640.0)),
        moving_body=box((35.0, 25.0, 8.0), (118.0, -79.0, 620.0)),
    )
