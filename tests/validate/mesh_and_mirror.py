"""What must not change a pose: the mirror image of the joint, and, more and more, the fineness of its meshes."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np

from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.body_frames import scan_pose
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.direct.prepare import prepare
from pipeline.kinematics.direct.solver import DirectSolver
from pipeline.kinematics.joint_coordinates import Float
from tests.bench.knees import REAL_KNEE, Knee, knee
from tests.validate import Measurement, Row

TRIANGLES = (10_000, 20_000, 40_000, 80_000)
FLEXION_DEG = tuple(range(0, 121, 4))


@cache
def _knee(triangles: int) -> Knee:
    with tempfile.TemporaryDirectory() as folder:
        return knee(REAL_KNEE.name, REAL_KNEE, Path(folder), triangles)


def _flexion_curve(one: Knee, *, mirrored: bool = False) -> Float:
    """(F, 4) x, y, z (mm) and theta (rad) along flexion at the scan's varus, each started from the one before."""
    sign = -1.0 if mirrored else 1.0
    reference, moving = (_mirror(mesh) if mirrored else mesh for mesh in (one.pair.reference, one.pair.moving))
    solver = DirectSolver(prepare(reference, moving))
    scan = scan_pose(one.anatomy.scan_attitude)
    start = centre = Pose(sign * scan.x, scan.y, scan.z, sign * scan.theta)
    rows = []
    for flexion in FLEXION_DEG:
        found = solver.at((float(np.radians(flexion)), sign * float(np.radians(one.anatomy.scan_attitude[1]))))
        start = found.solve(start, centre).pose
        rows.append([sign * start.x, start.y, start.z, sign * start.theta])
    return np.array(rows)


def _mirror(mesh: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(mesh.points * [-1.0, 1.0, 1.0], np.ascontiguousarray(mesh.triangles[:, ::-1]))


@cache
def _mirror_difference() -> Float:
    one = _knee(40_000)
    return np.abs(_flexion_curve(one) - _flexion_curve(one, mirrored=True))


def mirror_shift() -> Row:
    """Largest difference of position between a knee and its mirror image."""
    return Row("mirror_mm", "knee_mr_a: mirror image, position", float(_mirror_difference()[:, :3].max()), "mm", 0.02)


def mirror_turn() -> Row:
    """The same for the rotation."""
    worst = float(np.degrees(_mirror_difference()[:, 3].max()))
    return Row("mirror_deg", "knee_mr_a: mirror image, rotation", worst, "deg", 0.02)


@cache
def _curve(triangles: int) -> Float:
    return _flexion_curve(_knee(triangles))


def _convergence() -> Iterator[Measurement]:
    """RMS change of the curve along flexion as the triangles of both bodies double."""
    for coarse, fine, limit in zip(TRIANGLES, TRIANGLES[1:], (1.0, 0.7, 0.5), strict=False):

        def shift(coarse: int = coarse, fine: int = fine, limit: float = limit) -> Row:
            rms = float(np.sqrt(np.mean(np.sum((_curve(fine) - _curve(coarse))[:, :2] ** 2, axis=1))))
            label = f"{coarse // 1000}k to {fine // 1000}k triangles"
            return Row(f"mesh_{fine // 1000}k_mm", f"knee_mr_a: {label}, shift", rms, "mm", limit)

        def turn(coarse: int = coarse, fine: int = fine, limit: float = limit) -> Row:
            rms = float(np.degrees(np.sqrt(np.mean((_curve(fine) - _curve(coarse))[:, 3] ** 2))))
            label = f"{coarse // 1000}k to {fine // 1000}k triangles"
            return Row(f"mesh_{fine // 1000}k_deg", f"knee_mr_a: {label}, rotation", rms, "deg", 4.0 * limit)

        yield from (shift, turn)


ROWS: tuple[Measurement, ...] = (mirror_shift, mirror_turn, *_convergence()) if REAL_KNEE.exists() else ()
