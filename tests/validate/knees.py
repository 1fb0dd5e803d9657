"""Knees whose answer is known: the phantom, and a real knee's own scan pose where ../shared/data is present."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from pipeline.artifacts import ANATOMY, RAW_TABLE, SCAN_RETURNS, SMOOTH_TABLE
from pipeline.config import load_settings
from pipeline.engine.outcome import Execution
from pipeline.engine.runner import CaseJob, run_case
from pipeline.flow import FLOW
from pipeline.geometry.directions import angle_deg
from pipeline.geometry.phantom import PhantomTruth, phantom_truth
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.kinematics.table import RawTable, SmoothTable
from pipeline.records import Anatomy, ScanReturn
from tests.end_to_end.knee_runs import NUMBERS, Silent, phantom_case
from tests.validate import Measurement, Row

REAL_KNEE = Path(__file__).resolve().parents[3] / "shared" / "data" / "knee_mr_a"


@cache
def _solved(real: bool) -> tuple[Anatomy, tuple[ScanReturn, ...], SmoothTable, RawTable]:  # noqa: FBT001 - key
    """Anatomy, releases and smoothed table of a knee, on a coarse grid."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        case = REAL_KNEE if real else phantom_case(folder / "cases", "phantom", PhantomSpec())
        settings = load_settings(FLOW, case, "demo", ("sweep.flexion_step_deg=30.0",))
        job = CaseJob(case.name, case, folder / "results" / case.name)
        run_case(job, NUMBERS, settings, Execution(jobs=2), Silent())
        anatomy = ANATOMY.decode({"": (job.results / "40_anatomy" / ANATOMY.file).read_bytes()})
        returns = SCAN_RETURNS.decode({"": (job.results / "60_sweep" / SCAN_RETURNS.file).read_bytes()})
        table = SMOOTH_TABLE.decode({"": (job.results / "70_smooth" / SMOOTH_TABLE.file).read_bytes()})
        raw = RAW_TABLE.decode({"": (job.results / "60_sweep" / RAW_TABLE.file).read_bytes()})
        return anatomy, returns, table, raw


def _truth() -> PhantomTruth:
    return phantom_truth(PhantomSpec())


def phantom_flexion_axis() -> Row:
    """Direction of the flexion axis against the phantom's own."""
    axis = next(a for a in _solved(False)[0].axes if a.name == "flexion_axis")
    return Row(
        "phantom_axis_deg",
        "phantom: flexion axis",
        angle_deg(np.asarray(axis.direction), np.asarray(_truth().flexion_axis)),
        "deg",
        0.5,
    )


def _shift(*, real: bool) -> float:
    return max(one.shift_mm for one in _solved(real)[1])


def _turn(*, real: bool) -> float:
    return max(one.rotation_deg for one in _solved(real)[1])


def phantom_scan_shift() -> Row:
    """Scan pose found again from nine starts, in the plane orthogonal to delta."""
    return Row("phantom_scan_pose_mm", "phantom: scan pose found again, shift", _shift(real=False), "mm", 0.5)


def phantom_scan_turn() -> Row:
    """Scan pose found again from nine starts, rotation."""
    return Row("phantom_scan_pose_deg", "phantom: scan pose found again, rotation", _turn(real=False), "deg", 1.0)


def real_scan_shift() -> Row:
    """The same on a real knee."""
    return Row("scan_pose_mm", "knee_mr_a: scan pose found again, shift", _shift(real=True), "mm", 0.1)


def real_scan_turn() -> Row:
    """The same on a real knee."""
    return Row("scan_pose_deg", "knee_mr_a: scan pose found again, rotation", _turn(real=True), "deg", 0.1)


def phantom_contact() -> Row:
    """Largest error of contact at the entries after smoothing."""
    error = np.nanmax(np.abs(_solved(False)[2].contact_error_mm))
    return Row("phantom_contact_mm", "phantom: contact at entries", float(error), "mm", 0.02)


def certificate() -> Row:
    """Median equilibrium residual of the raw poses of a real knee, or of the phantom where there is none."""
    raw = _solved(REAL_KNEE.exists())[3]
    return Row(
        "certificate_median",
        "raw poses: median residual",
        float(np.nanmedian(raw.poses.equilibrium_residual)),
        "",
        0.02,
    )


ROWS: tuple[Measurement, ...] = (
    phantom_flexion_axis,
    phantom_scan_shift,
    phantom_scan_turn,
    phantom_contact,
    certificate,
    *((real_scan_shift, real_scan_turn) if REAL_KNEE.exists() else ()),
)
