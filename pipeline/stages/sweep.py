"""Stage 60: a stable pose for every attitude of the grid, by the incremental solver, as found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from pipeline.adapters.contact_pool import ContactPair, map_contact
from pipeline.artifacts import ANATOMY, MOVING_BODY, RAW_TABLE, REFERENCE_BODY, SCAN_RETURNS
from pipeline.contact_params import ContactParams
from pipeline.engine.stage import Finding, Findings, Inputs, Outputs, Severity, Stage
from pipeline.errors import CaseRejected
from pipeline.kinematics.body_frames import scan_pose
from pipeline.kinematics.incremental import IncrementalSettings, StablePose
from pipeline.kinematics.sweep import Release, SweepSettings, Walk, assemble, go, let_go, ribs, spine
from pipeline.kinematics.table import Grid, RawTable, Status
from pipeline.records import Anatomy, ScanReturn

MAX_CELLS = 100_000


class Params(ContactParams):
    """The grid, and the paper's steps and resolutions (step = 10 x resolution)."""

    flexion_min_deg: float = Field(0.0, ge=-30, le=170, description="first flexion of the table")
    flexion_max_deg: float = Field(120.0, ge=-30, le=170, description="last flexion of the table")
    flexion_step_deg: float = Field(5.0, gt=0, le=90, description="spacing in flexion; divides the range")
    varus_min_deg: float = Field(-4.0, ge=-30, le=30, description="first varus angle (valgus is negative)")
    varus_max_deg: float = Field(4.0, ge=-30, le=30, description="last varus angle")
    varus_step_deg: float = Field(2.0, gt=0, le=30, description="spacing in varus; divides the range")
    translation_step_mm: float = Field(1.0, gt=0, le=100, description="step of translations")
    translation_resolution_mm: float = Field(0.1, gt=0, le=5, description="step at which a translation is spent")
    rotation_step_deg: float = Field(1.0, gt=0, le=45, description="step of rotations about delta")
    rotation_resolution_deg: float = Field(0.1, gt=0, le=5, description="step at which a rotation is spent")
    slide_bound_mm: float = Field(30.0, gt=0, le=200, description="farther than this from the scan pose: slid off")
    rotation_bound_deg: float = Field(30.0, gt=0, le=179, description="farther than this from the scan pose: bound")
    max_motions: int = Field(400, ge=10, le=100_000, description="motions after which a cell is not converged")
    scan_shift_mm: float = Field(
        2.0, ge=0, le=20, description="how far from the scan pose the body is let go, as a test"
    )
    scan_turn_deg: float = Field(3.0, ge=0, le=30, description="the same for the rotation")
    classic: bool = Field(default=False, description="the paper's plain rules, without the deeper-only guard")

    @model_validator(mode="after")
    def _grid_is_whole(self) -> Self:
        cells = 1
        for name in ("flexion", "varus"):
            low, high, step = (getattr(self, f"{name}_{part}_deg") for part in ("min", "max", "step"))
            if high < low:
                raise ValueError(f"{name}_max_deg {high} is below {name}_min_deg {low}")
            if abs((high - low) / step - round((high - low) / step)) > 1e-9:
                raise ValueError(f"{name}_step_deg {step} does not divide the range {low} to {high}")
            cells *= round((high - low) / step) + 1
        if cells > MAX_CELLS:
            raise ValueError(f"the grid has {cells} cells, at most {MAX_CELLS}")
        return self

    def grid(self) -> Grid:
        """The attitudes of the table."""
        return Grid(
            _values(self.flexion_min_deg, self.flexion_max_deg, self.flexion_step_deg),
            _values(self.varus_min_deg, self.varus_max_deg, self.varus_step_deg),
        )


def _values(low: float, high: float, step: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.linspace(low, high, round((high - low) / step) + 1)


def run(reads: Inputs, params: Params, out: Outputs) -> Findings:
    """Sweep the grid."""
    anatomy, grid = reads[ANATOMY], params.grid()
    pair = params.pair(reads[REFERENCE_BODY], reads[MOVING_BODY], anatomy)
    scan, progress = scan_pose(anatomy.scan_attitude), _Progress(out, int(np.prod(grid.shape)))
    work = partial(go, settings=_settings(params))
    first = spine(grid, anatomy.scan_attitude[0], anatomy.scan_attitude[1], scan)
    along = map_contact(work, first, pair, out.jobs, progress.of(first))
    across = ribs(grid, along, scan)
    table = assemble(grid, [*along, *map_contact(work, across, pair, out.jobs, progress.of(across))])
    if not (table.poses.status == Status.OK).any():
        raise CaseRejected(
            "E-SWP-01",
            f"No stable pose at any of {table.poses.status.size} attitudes: {_counts(table)}.",
            "Check that cartilage and menisci are labelled, and that the bones are those of one joint.",
        )
    out[RAW_TABLE] = table
    out[SCAN_RETURNS] = _scan_returns(anatomy, params, pair, out.jobs)
    return _findings(table)


def _scan_returns(anatomy: Anatomy, params: Params, pair: ContactPair, jobs: int) -> tuple[ScanReturn, ...]:
    """The body let go at the scan's own attitude, at the scan pose and away from it to every side."""
    scan = scan_pose(anatomy.scan_attitude)
    flexion, varus = anatomy.scan_attitude[:2]
    shift, turn = params.scan_shift_mm, float(np.radians(params.scan_turn_deg))
    aways = [(0.0, 0.0, 0.0)]
    aways += [way for s in (1.0, -1.0) for way in ((s * shift, 0.0, 0.0), (0.0, s * shift, 0.0), (0.0, 0.0, s * turn))]
    releases = [Release(flexion, varus, scan, away) for away in aways]
    found = map_contact(partial(let_go, settings=_settings(params)), releases, pair, jobs)
    return tuple(_scan_return(release, stable) for release, stable in zip(releases, found, strict=True))


def _scan_return(release: Release, stable: StablePose) -> ScanReturn:
    settled = stable.status is Status.OK
    dx, dy, dz, turn = np.subtract(stable.pose, release.scan) if settled else np.zeros(4)
    return ScanReturn(
        start_lateral_mm=release.away[0],
        start_anterior_mm=release.away[1],
        start_rotation_deg=float(np.degrees(release.away[2])),
        settled=settled,
        shift_mm=float(np.hypot(dx, dy)),
        rotation_deg=float(np.degrees(abs(turn))),
        sinking_mm=float(dz),
    )


class _Progress:
    """Cells done out of all, told as walks finish."""

    def __init__(self, out: Outputs, total: int) -> None:
        self.out, self.total, self.finished = out, total, 0

    def of(self, walks: Sequence[Walk]) -> Callable[[int], None]:
        """What to call with the index of each finished walk."""

        def done(index: int) -> None:
            self.finished += len(walks[index].cells)
            self.out.progress(self.finished, self.total)

        return done


def _settings(params: Params) -> SweepSettings:
    solver = IncrementalSettings(
        translation_step_mm=params.translation_step_mm,
        translation_resolution_mm=params.translation_resolution_mm,
        rotation_step_rad=float(np.radians(params.rotation_step_deg)),
        rotation_resolution_rad=float(np.radians(params.rotation_resolution_deg)),
        contact_band_mm=params.contact_band_mm,
        slide_bound_mm=params.slide_bound_mm,
        rotation_bound_rad=float(np.radians(params.rotation_bound_deg)),
        max_motions=params.max_motions,
        gain_mm=max(5e-4, 2.5 * params.contact_tolerance_mm),
        classic=params.classic,
        motion=params.motion(),
    )
    return SweepSettings(solver, params.proof())


def _counts(table: RawTable) -> str:
    values, counts = np.unique(table.poses.status, return_counts=True)
    return ", ".join(
        f"{count} {Status(int(value)).name.lower().replace('_', ' ')}"
        for value, count in zip(values, counts, strict=True)
    )


def _findings(table: RawTable) -> Findings:
    note = Finding("N-SWP-01", Severity.NOTE, f"{table.poses.status.size} attitudes: {_counts(table)}.")
    failed = int((table.poses.status != Status.OK).sum())
    if not failed:
        return (note,)
    review = Finding(
        "W-SWP-01",
        Severity.REVIEW,
        f"{failed} of {table.poses.status.size} attitudes have no stable pose ({_counts(table)}).",
    )
    return note, review


STAGE = Stage(60, "sweep", (ANATOMY, REFERENCE_BODY, MOVING_BODY), (RAW_TABLE, SCAN_RETURNS), Params, run)
