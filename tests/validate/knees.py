"""Knees whose answer is known: the phantom, and a real knee's own scan pose where ../shared/data is present."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path
from typing import Literal

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
from tests.end_to_end.knee_runs import NUMBERS, Silent, left, phantom_case
from tests.validate import Measurement, Row
from tests.validate.knee_jam_case import write_case
from tests.validate.measured_motion import KNEE as KNEE_JAM

Which = Literal["phantom", "knee_mr_a", "knee_jam"]
REAL_KNEE = Path(__file__).resolve().parents[3] / "shared" / "data" / "knee_mr_a"


def _case(which: Which, cases: Path) -> Path:
    if which == "knee_mr_a":
        return REAL_KNEE
    return write_case(cases) if which == "knee_jam" else phantom_case(cases, "phantom", PhantomSpec())


@cache
def _solved(which: Which) -> tuple[Anatomy, tuple[ScanReturn, ...], SmoothTable, RawTable]:
    """Anatomy, releases and smoothed table of a knee, on a coarse grid."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        case = _case(which, folder / "cases")
        settings = load_settings(FLOW, case, "demo", ("sweep.flexion_step_deg=30.0",))
        job = CaseJob(case.name, case, folder / "results" / case.name)
        run_case(job, NUMBERS, settings, Execution(jobs=2), Silent())
        anatomy = left(job.results, ANATOMY)
        returns = left(job.results, SCAN_RETURNS)
        table = left(job.results, SMOOTH_TABLE)
        raw = left(job.results, RAW_TABLE)
        return anatomy, returns, table, raw


def _truth() -> PhantomTruth:
    return phantom_truth(PhantomSpec())


def phantom_flexion_axis() -> Row:
    """Direction of the flexion axis against the phantom's own."""
    axis = next(a for a in _solved("phantom")[0].axes if a.name == "flexion_axis")
    return Row(
        "phantom_axis_deg",
        "phantom: flexion axis",
        angle_deg(np.asarray(axis.direction), np.asarray(_truth().flexion_axis)),
        "deg",
        0.5,
    )


def _shift(which: Which) -> float:
    return max(one.shift_mm for one in _solved(which)[1])


def _turn(which: Which) -> float:
    return max(one.rotation_deg for one in _solved(which)[1])


def phantom_scan_shift() -> Row:
    """Scan pose found again from nine starts, in the plane orthogonal to delta."""
    return Row("phantom_scan_pose_mm", "phantom: scan pose found again, shift", _shift("phantom"), "mm", 0.5)


def phantom_scan_turn() -> Row:
    """Scan pose found again from nine starts, rotation."""
    return Row("phantom_scan_pose_deg", "phantom: scan pose found again, rotation", _turn("phantom"), "deg", 1.0)


def real_scan_shift() -> Row:
    """The same on a real knee."""
    return Row("scan_pose_mm", "knee_mr_a: scan pose found again, shift", _shift("knee_mr_a"), "mm", 0.1)


def real_scan_turn() -> Row:
    """The same on a real knee."""
    return Row("scan_pose_deg", "knee_mr_a: scan pose found again, rotation", _turn("knee_mr_a"), "deg", 0.1)


def phantom_contact() -> Row:
    """Largest error of contact at the entries after smoothing."""
    error = np.nanmax(np.abs(_solved("phantom")[2].contact_error_mm))
    return Row("phantom_contact_mm", "phantom: contact at entries", float(error), "mm", 0.02)


def certificate() -> Row:
    """Median equilibrium residual of the raw poses of a real knee, or of the phantom where there is none."""
    raw = _solved("knee_mr_a" if REAL_KNEE.exists() else "phantom")[3]
    return Row(
        "certificate_median",
        "raw poses: median residual",
        float(np.nanmedian(raw.poses.equilibrium_residual)),
        "",
        0.02,
    )


def jam_contact() -> Row:
    """Largest error of contact at the entries of a second real knee, made into a label map from its meshes."""
    error = np.nanmax(np.abs(_solved("knee_jam")[2].contact_error_mm))
    return Row("jam_contact_mm", "knee_jam as labels: contact at entries", float(error), "mm", 0.02)


def jam_residual() -> Row:
    """Median equilibrium residual of its raw poses."""
    residual = np.nanmedian(_solved("knee_jam")[3].poses.equilibrium_residual)
    return Row("jam_residual", "knee_jam as labels: median residual", float(residual), "", 0.02)


ROWS: tuple[Measurement, ...] = (
    phantom_flexion_axis,
    phantom_scan_shift,
    phantom_scan_turn,
    phantom_contact,
    certificate,
    *((real_scan_shift, real_scan_turn) if REAL_KNEE.exists() else ()),
    *((jam_contact, jam_residual) if KNEE_JAM.exists() else ()),
)
