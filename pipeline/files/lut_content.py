"""What ``lut.h5`` holds, as one value, and the laws it obeys before it is written and after it is read."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.interpolation import FOUND
from pipeline.kinematics.neutral import NeutralCurve
from pipeline.kinematics.table import Grid, LutTable, PoseTable, RawTable, SmoothTable, Status

Float = NDArray[np.float64]

#: How far the axes of a frame may be from unit length and right angles: rounding of a product of a few rotations.
ORTHONORMAL_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class LutFileContent:
    """A finished table with all that is needed to replay it and to test it again.

    Attributes
    ----------
    joint : str
        Name of the joint file, such as ``knee``.
    side : str
        ``right`` or ``left``.
    software : str
        Name and version of the program that made the table.
    smooth, raw : SmoothTable, RawTable
        On one grid.
    neutral : NeutralCurve
        Over the grid's flexion.
    scan_from_reference, scan_from_moving : (4, 4) float64
        Kinematic frames in scan space (LPS mm); left-handed for a left joint.
    delta : (3,) float64
        Third axis of ``scan_from_moving``.
    scan_attitude : (6,) float64
        Flexion, varus, internal rotation (deg), lateral, anterior, proximal (mm) of the scan itself.
    reference_body, moving_body : TriangleMesh
        Contact surfaces the poses were solved with, scan space, as scanned.
    """

    joint: str
    side: str
    software: str
    smooth: SmoothTable
    raw: RawTable
    neutral: NeutralCurve
    scan_from_reference: Float
    scan_from_moving: Float
    delta: Float
    scan_attitude: Float
    reference_body: TriangleMesh
    moving_body: TriangleMesh

    @property
    def table(self) -> LutTable:
        """The part that playback needs."""
        return LutTable(self.side, self.smooth.grid, self.smooth.poses, self.scan_from_reference, self.scan_from_moving)


def check_content(content: LutFileContent) -> None:
    """Refuse a table that a reader could not trust.

    Raises
    ------
    ValueError
        When the grid does not increase, an array or the neutral curve does not fit it, a usable entry is not finite
        or an unusable one is, a frame is not a rigid frame of the declared side, delta is not the moving frame's z
        axis, or a body is not a triangle mesh.
    """
    _check_grid(content.smooth.grid, content.raw.grid)
    for name, poses in (("lut", content.smooth.poses), ("raw", content.raw.poses)):
        _check_poses(poses, content.smooth.grid, name)
    _check_neutral(content.neutral, content.smooth.grid)
    _check_frames(content)
    for name, body in (("reference", content.reference_body), ("moving", content.moving_body)):
        _check_body(body, name)


def _check_grid(grid: Grid, other: Grid) -> None:
    for name in ("flexion_deg", "varus_deg"):
        axis = getattr(grid, name)
        if axis.ndim != 1 or not len(axis) or not np.isfinite(axis).all() or not np.all(np.diff(axis) > 0):
            raise ValueError(f"grid {name}: expected strictly increasing numbers")
        if not np.array_equal(axis, getattr(other, name)):
            raise ValueError(f"grid {name}: the raw and the smoothed table differ")


def _check_poses(poses: PoseTable, grid: Grid, name: str) -> None:
    _check_fields(poses, grid.shape, name)
    _check_entries(np.stack([getattr(poses, found) for found in FOUND]), poses.status, name)


def _check_neutral(neutral: NeutralCurve, grid: Grid) -> None:
    _check_fields(neutral, grid.shape[:1], "neutral")
    if not np.array_equal(neutral.flexion_deg, grid.flexion_deg):
        raise ValueError("neutral flexion_deg: expected the flexion of the grid")
    known = [getattr(neutral, field) for field in ("varus_deg", *FOUND, "uneven_mm")]
    _check_entries(np.stack(known), neutral.status, "neutral")


def _check_fields(arrays: PoseTable | NeutralCurve, expected: tuple[int, ...], name: str) -> None:
    for field in fields(arrays):
        if (shape := getattr(arrays, field.name).shape) != expected:
            raise ValueError(f"{name} {field.name}: expected shape {expected} of the grid, got {shape}")


def _check_entries(values: Float, status: NDArray[np.uint8], name: str) -> None:
    """``values`` (K, ...) finite where the status (...) is usable, and NaN where it is not."""
    if status.max() > max(Status):
        raise ValueError(f"{name} status: expected 0 to {max(Status):d}, got {status.max()}")
    usable = status <= Status.SMOOTHED
    if not np.isfinite(values[:, usable]).all():
        raise ValueError(f"{name}: a usable entry has a coordinate that is not a finite number")
    if not np.isnan(values[:, ~usable]).all():
        raise ValueError(f"{name}: an entry that is not usable has a coordinate")


def _check_frames(content: LutFileContent) -> None:
    if content.side not in ("right", "left"):
        raise ValueError(f"side: expected right or left, got {content.side!r}")
    hand = 1.0 if content.side == "right" else -1.0
    for name in ("scan_from_reference", "scan_from_moving"):
        _check_frame(getattr(content, name), hand, name)
    if content.delta.shape != (3,) or not np.allclose(
        content.delta, content.scan_from_moving[:3, 2], rtol=0.0, atol=ORTHONORMAL_TOLERANCE
    ):
        raise ValueError("delta: expected the z axis of scan_from_moving")
    if content.scan_attitude.shape != (6,) or not np.isfinite(content.scan_attitude).all():
        raise ValueError("scan_attitude: expected six finite numbers")


def _check_frame(scan_from_frame: Float, hand: float, name: str) -> None:
    if scan_from_frame.shape != (4, 4) or not np.isfinite(scan_from_frame).all():
        raise ValueError(f"{name}: expected a finite 4x4 matrix")
    axes = scan_from_frame[:3, :3]
    straight = np.allclose(axes.T @ axes, np.eye(3), rtol=0.0, atol=ORTHONORMAL_TOLERANCE)
    if not straight or not np.array_equal(scan_from_frame[3], [0.0, 0.0, 0.0, 1.0]):
        raise ValueError(f"{name}: expected a rigid frame of unit axes at right angles")
    if np.linalg.det(axes) * hand < 0.0:
        raise ValueError(f"{name}: expected a {'right' if hand > 0 else 'left'}-handed frame for this side")


def _check_body(body: TriangleMesh, name: str) -> None:
    points, triangles = body.points, body.triangles
    if points.ndim != 2 or points.shape[1:] != (3,) or triangles.ndim != 2 or triangles.shape[1:] != (3,):
        raise ValueError(
            f"{name} body: expected points (N, 3), triangles (M, 3), got {points.shape}, {triangles.shape}"
        )
    if not len(triangles) or not np.isfinite(points).all():
        raise ValueError(f"{name} body: expected finite points and at least one triangle")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise ValueError(f"{name} body: triangle indices outside 0..{len(points) - 1}")
