"""A made-up knee of two simple bodies, right or left, with everything that the report reads, held in memory.

The reference is two condyles that turn about the flexion axis, with a shaft; the moving body is a plateau with a stem.
The table is made up too: smooth curves with a little seeded noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.stage import Finding, Findings, Severity
from pipeline.geometry.mesh import TriangleMesh, merged, transformed
from pipeline.geometry.volume import LabelVolume
from pipeline.kinematics.neutral import NeutralCurve
from pipeline.kinematics.table import CurveFit, Grid, PoseTable, RawTable, SmoothTable, Status
from pipeline.records import (
    Anatomy,
    AxisEstimate,
    BaselineCost,
    CaseFacts,
    CheckedAttitude,
    CrossCheck,
    JumpCount,
    Landmark,
    Matrix,
    MeshQuality,
    ScanReturn,
    Side,
    SurfaceOrigin,
    SweepFacts,
)
from pipeline.report.evidence import Evidence

Float = NDArray[np.float64]

SPACING_MM = 2.0
CONDYLE_MM = 20.0
RETURNS = (ScanReturn(0.0, 0.0, 0.0, True, 0.02, 0.04, -0.1), ScanReturn(2.0, 0.0, 0.0, True, 0.05, 0.02, -0.1))
SWEEP = SweepFacts(
    solver="direct",
    push_n=0.0,
    reference_strain=0.0,
    jumps_before=JumpCount(5, 1.9, 4.0),
    jumps_after=JumpCount(2, 1.2, 3.5),
    cross_check=CrossCheck(
        cells=20,
        unsolved=0,
        agreeing=19,
        shallower=1,
        shift_mm=0.3,
        rotation_deg=0.7,
        deeper_mm=0.05,
        shallower_mm=0.02,
        attitudes=(CheckedAttitude(20.0, 0.0, 0.3, 0.2), CheckedAttitude(70.0, -4.0, 0.1, 0.7)),
    ),
    baselines=(
        BaselineCost("hinge", (0.0, 60.0, 120.0), (0.0, -1.25, 0.5)),
        BaselineCost("walker", (0.0, 60.0), (0.0, -4.0)),
    ),
)
STAGES = ("intake", "segment", "mesh", "anatomy", "contact", "sweep", "smooth")


def sample_evidence(side: Side = "right", case_id: str = "SAMPLE-1") -> Evidence:
    """Evidence of a knee on which nothing is wrong."""
    frame = frame_of(side)
    meshes = {name: transformed(mesh, frame) for name, mesh in _meshes().items()}
    grid = Grid(np.arange(0.0, 121.0, 10.0), np.array([-4.0, 0.0, 4.0]))
    fitted = _poses(grid)
    return Evidence(
        facts=_facts(side, case_id),
        labels=_labels(frame),
        ct_cuts=None,
        meshes=meshes,
        mesh_quality=tuple(MeshQuality(name, 1000, 1010.0, 1000.0, 0.1, 0.4, 0, 0) for name in meshes),
        anatomy=_anatomy(side, frame),
        reference=merged([meshes["femur"], meshes["femoral_cartilage"]]),
        moving=merged([meshes["tibia"], meshes["medial_meniscus"]]),
        origins=_origins(),
        raw=_raw(grid, fitted),
        scan_returns=RETURNS,
        sweep=SWEEP,
        neutral=_neutral(grid),
        smooth=_smooth(grid, fitted),
        findings={name: _findings(name) for name in STAGES},
    )


def with_status(evidence: Evidence, at: tuple[int, int], status: Status) -> Evidence:
    """The same evidence with one entry of both tables unusable."""
    raw, smooth = _failed(evidence.raw.poses, at, status), _failed(evidence.smooth.poses, at, status)
    return replace(evidence, raw=replace(evidence.raw, poses=raw), smooth=replace(evidence.smooth, poses=smooth))


def only_one_attitude(evidence: Evidence) -> Evidence:
    """The same bodies as a test object has them: given meshes, no landmarks, one flexion and one varus."""
    grid = Grid(np.array([0.0]), np.array([0.0]))
    fitted = _poses(grid)
    return replace(
        evidence,
        facts=replace(evidence.facts, source="meshes"),
        labels=None,
        mesh_quality=(),
        anatomy=replace(evidence.anatomy, landmarks=(), axes=(), side_evidence=()),
        raw=_raw(grid, fitted),
        neutral=_neutral(grid),
        smooth=_smooth(grid, fitted),
    )


def frame_of(side: Side) -> Float:
    """(4, 4) anatomical frame in LPS, x lateral, y anterior, z proximal, a little oblique; det -1 for a left knee."""
    lateral = -1.0 if side == "right" else 1.0
    c, s = np.cos(0.15), np.sin(0.15)
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    frame = np.eye(4)
    frame[:3, :3] = tilt @ np.diag([lateral, -1.0, 1.0])
    frame[:3, 3] = [40.0, -10.0, 300.0]
    return frame


def revolved(profile: list[tuple[float, float]], count: int = 48) -> TriangleMesh:
    """Closed surface of revolution about z: ``profile`` is (z upwards, radius), poles excluded."""
    z, radius = np.array(profile).T
    turn = 2.0 * np.pi * np.arange(count) / count
    ring = np.stack([np.cos(turn), np.sin(turn), np.zeros(count)], axis=1)
    points = (radius[:, None, None] * ring + z[:, None, None] * [0.0, 0.0, 1.0]).reshape(-1, 3)
    poles = np.array([[0.0, 0.0, z[0]], [0.0, 0.0, z[-1]]])
    low, high, next_ = len(points), len(points) + 1, np.roll(np.arange(count), -1)
    here, triangles = np.arange(count), []
    for row in range(len(profile) - 1):
        a, b = row * count, (row + 1) * count
        triangles += [np.stack([a + here, a + next_, b + next_], 1), np.stack([a + here, b + next_, b + here], 1)]
    top = (len(profile) - 1) * count
    triangles += [
        np.stack([next_, here, np.full(count, low)], 1),
        np.stack([top + here, top + next_, np.full(count, high)], 1),
    ]
    return TriangleMesh(np.vstack([points, poles]), np.vstack(triangles).astype(np.int32))


def _condyle(z: float) -> float:
    return float(CONDYLE_MM - 0.02 * (abs(z) - 22.0) ** 2)


def _meshes() -> dict[str, TriangleMesh]:
    spin = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    condyles = revolved([(float(z), _condyle(z)) for z in np.linspace(-36.0, 36.0, 37)])
    shaft = revolved([(5.0, 12.0), (25.0, 13.0), (50.0, 12.0), (90.0, 12.0)])
    layer = revolved([(float(z), _condyle(z) + 0.2) for z in np.linspace(-30.0, -14.0, 9)])
    plateau = revolved([(-100.0, 12.0), (-60.0, 13.0), (-35.0, 30.0), (-CONDYLE_MM, 33.0)])
    rim = revolved([(-CONDYLE_MM, 8.0), (-CONDYLE_MM + 3.0, 8.0)])
    return {
        "femur": merged([TriangleMesh(condyles.points @ spin.T, condyles.triangles), shaft]),
        "femoral_cartilage": TriangleMesh(layer.points @ spin.T, layer.triangles),
        "tibia": plateau,
        "medial_meniscus": TriangleMesh(rim.points - [20.0, 24.0, 0.0], rim.triangles),
        "fibula": TriangleMesh(
            revolved([(-100.0, 6.0), (-45.0, 8.0)]).points + np.array([38.0, -10.0, 0.0]),
            revolved([(0.0, 1.0), (1.0, 1.0)]).triangles,
        ),
        "patella": TriangleMesh(
            revolved([(-8.0, 12.0), (12.0, 14.0)]).points + np.array([0.0, 38.0, 0.0]),
            revolved([(0.0, 1.0), (1.0, 1.0)]).triangles,
        ),
    }


def _labels(frame: Float) -> LabelVolume:
    axes = [np.arange(-44.0, 45.0, SPACING_MM), np.arange(-36.0, 53.0, SPACING_MM), np.arange(-80.0, 81.0, SPACING_MM)]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    profile = CONDYLE_MM - 0.02 * (np.abs(x) - 22.0) ** 2
    femur = ((np.hypot(y, z) < profile) & (np.abs(x) < 36.0)) | ((np.hypot(x, y) < 12.0) & (z > 5.0))
    tibia = (np.hypot(x, y) < np.where(z > -35.0, 32.0, 12.0)) & (z < -CONDYLE_MM)
    values = np.where(femur, 2, np.where(tibia, 6, 0)).astype(np.uint8)
    index = np.eye(4)
    index[:3, :3] *= SPACING_MM
    index[:3, 3] = [axis[0] for axis in axes]
    lps_from_index = frame @ index
    if np.linalg.det(lps_from_index[:3, :3]) < 0.0:
        values, lps_from_index = values[::-1].copy(), lps_from_index @ _reversed_first_axis(len(axes[0]))
    return LabelVolume(values, lps_from_index)


def _reversed_first_axis(count: int) -> Float:
    flip = np.eye(4)
    flip[0, 0], flip[0, 3] = -1.0, count - 1.0
    return flip


def _facts(side: Side, case_id: str) -> CaseFacts:
    names = sorted(_meshes())
    return CaseFacts(
        case_id=case_id,
        joint="knee",
        side=side,
        source="labels",
        source_files={"labels.nrrd": "0123456789abcdef" * 4},
        structures={name: i + 1 for i, name in enumerate(names)},
        voxels=dict.fromkeys(names, 1000),
        spacing_mm=(SPACING_MM,) * 3,
        shape=(45, 45, 81),
        clipped_mm2=dict.fromkeys(names, 0.0),
        landmarks={},
    )


def _anatomy(side: Side, frame: Float) -> Anatomy:
    def at(x: float, y: float, z: float) -> tuple[float, float, float]:
        a, b, c = (frame @ [x, y, z, 1.0])[:3].tolist()
        return a, b, c

    def along(column: int) -> tuple[float, float, float]:
        a, b, c = frame[:3, column].tolist()
        return a, b, c

    landmarks = (
        Landmark("lateral_epicondyle", at(36.0, 0.0, 0.0), 1.2, "found"),
        Landmark("medial_epicondyle", at(-36.0, 0.0, 0.0), 1.0, "given"),
        Landmark("femur_shaft_centre", at(0.0, 0.0, 60.0), 0.7, "found"),
    )
    axes = (
        AxisEstimate("flexion_axis", along(0), 0.8, "fit to the condyles"),
        AxisEstimate("femoral_long_axis", along(2), 1.5, "shaft"),
        AxisEstimate("tibial_long_axis", along(2), 1.7, "shaft"),
    )
    plateau = frame.copy()
    plateau[:3, 3] = at(0.0, 0.0, -CONDYLE_MM)
    return Anatomy(
        side, landmarks, axes, matrix(frame), matrix(plateau), along(2),
        (0.0, 0.0, 0.0, 0.0, 0.0, -CONDYLE_MM), ("The fibula lies on the lateral side.",),
    )  # fmt: skip


def matrix(array: Float) -> Matrix:
    """A (4, 4) array as nested tuples."""
    a, b, c, d = ((row[0], row[1], row[2], row[3]) for row in array.tolist())
    return a, b, c, d


def _origins() -> tuple[SurfaceOrigin, ...]:
    return (
        SurfaceOrigin("reference", "femur", "labelled"),
        SurfaceOrigin("reference", "femoral_cartilage", "labelled"),
        SurfaceOrigin("moving", "tibia", "labelled"),
        SurfaceOrigin("moving", "medial_meniscus", "labelled"),
        SurfaceOrigin("moving", "lateral_meniscus", "synthesised"),
    )


def _poses(grid: Grid) -> PoseTable:
    flexion, varus = np.meshgrid(np.radians(grid.flexion_deg), np.radians(grid.varus_deg), indexing="ij")
    shape = grid.shape
    return PoseTable(
        lateral_mm=0.8 * np.sin(flexion) + 5.0 * varus,
        anterior_mm=-3.0 * np.sin(flexion / 2.0),
        proximal_mm=-CONDYLE_MM - 0.3 * np.sin(flexion) - 20.0 * np.abs(varus),
        internal_rotation_deg=8.0 * np.sin(flexion) + 10.0 * varus,
        status=np.zeros(shape, dtype=np.uint8),
        equilibrium_residual=np.full(shape, 0.02),
        medial_gap_mm=np.maximum(0.0, 30.0 * varus),
        lateral_gap_mm=np.maximum(0.0, -30.0 * varus),
        contact_count=np.full(shape, 4, dtype=np.int32),
    )


def _raw(grid: Grid, fitted: PoseTable) -> RawTable:
    noise = np.random.default_rng(1)
    names = ("lateral_mm", "anterior_mm", "internal_rotation_deg")
    rough = {name: getattr(fitted, name) + 0.1 * noise.standard_normal(grid.shape) for name in names}
    shape = grid.shape
    return RawTable(
        grid=grid,
        poses=replace(fitted, **rough),
        iterations=np.full(shape, 30, dtype=np.int32),
        gap_before_mm=np.full(shape, 0.01),
        gap_after_mm=np.full(shape, 0.01),
        hysteresis_mm=np.full(shape, 0.2),
        hysteresis_deg=np.full(shape, 0.3),
        margin_lateral_mm=np.full(shape, 4.0),
        margin_anterior_mm=np.full(shape, 3.0),
        margin_rotation_deg=np.full(shape, 8.0),
    )


def _neutral(grid: Grid) -> NeutralCurve:
    """The knee stands straight, both compartments in contact."""
    along = np.radians(grid.flexion_deg)
    zeros = np.zeros_like(along)
    return NeutralCurve(
        flexion_deg=grid.flexion_deg,
        varus_deg=zeros,
        lateral_mm=0.8 * np.sin(along),
        anterior_mm=-3.0 * np.sin(along / 2.0),
        proximal_mm=-CONDYLE_MM - 0.3 * np.sin(along),
        internal_rotation_deg=8.0 * np.sin(along),
        uneven_mm=zeros,
        status=np.zeros(len(along), dtype=np.uint8),
    )


def _smooth(grid: Grid, fitted: PoseTable) -> SmoothTable:
    units = {"lateral_mm": "mm", "anterior_mm": "mm", "internal_rotation_deg": "deg"}
    return SmoothTable(
        grid=grid,
        poses=fitted,
        fits=tuple(CurveFit(name, unit, np.zeros((7, 3)), 0.1, 0.3) for name, unit in units.items()),
        flexion_range_deg=grid.flexion_deg[[0, -1]],
        varus_range_deg=grid.varus_deg[[0, -1]],
        contact_error_mm=np.full(grid.shape, 0.005),
        midpoint_error_mm=np.full((grid.shape[0] - 1, grid.shape[1]), -0.05),
    )


def _failed(poses: PoseTable, at: tuple[int, int], status: Status) -> PoseTable:
    changes: dict[str, NDArray[np.generic]] = {}
    for name in ("lateral_mm", "anterior_mm", "proximal_mm", "internal_rotation_deg"):
        changes[name] = getattr(poses, name).copy()
        changes[name][at] = np.nan
    changes["status"] = poses.status.copy()
    changes["status"][at] = status
    return replace(poses, **changes)  # type: ignore[arg-type]


def _findings(stage: str) -> Findings:
    return (
        (Finding("N-LBL-01", Severity.NOTE, "2 islands of the tibia below 1 % were removed."),)
        if stage == "intake"
        else ()
    )
