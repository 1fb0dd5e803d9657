"""What a CT alone costs: tables of real knees from bones only and from synthetic CT, against those of labels.

The measure is the RMS over flexion, at the varus of the scan, between two raw tables of the same knee. Cartilage and
menisci of the one are as labelled in MR, of the other made by the program; or bones are labelled, and found in a CT
that was made from them (called synthetic wherever it appears).
"""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.artifacts import RAW_TABLE
from pipeline.config import load_settings
from pipeline.engine.outcome import Execution
from pipeline.engine.runner import CaseJob, run_case
from pipeline.files.nrrd_format import encode_nrrd
from pipeline.files.volumes import read_label_map
from pipeline.flow import FLOW
from pipeline.geometry.synthetic_ct import SyntheticCtSpec, synthetic_ct
from pipeline.geometry.volume import LabelVolume
from pipeline.kinematics.table import Float, RawTable, Status
from tests.end_to_end.knee_runs import Silent, left, up_to
from tests.validate import Measurement, Row
from tests.validate.knee_jam_case import knee_jam_labels
from tests.validate.measured_motion import KNEE as KNEE_JAM

DATA = KNEE_JAM.parent
Knee = Literal["knee_mr_a", "knee_jam"]
Kind = Literal["labelled", "bones", "ct", "fine_ct", "noisy_ct", "thick_ct", "coarse_ct"]
#: Synthetic CTs: voxel size, noise, and one leg or two.
SCANS: dict[str, SyntheticCtSpec] = {
    "ct": SyntheticCtSpec(spacing_mm=(0.6, 0.6, 0.6), noise_hu=15.0),
    "fine_ct": SyntheticCtSpec(spacing_mm=(0.4, 0.4, 0.4), noise_hu=30.0),
    "noisy_ct": SyntheticCtSpec(spacing_mm=(0.6, 0.6, 0.6), noise_hu=60.0),
    "thick_ct": SyntheticCtSpec(spacing_mm=(0.6, 0.6, 1.5), noise_hu=15.0),
    "coarse_ct": SyntheticCtSpec(spacing_mm=(0.6, 0.6, 1.5), noise_hu=40.0, other_leg="left"),
}
#: As ``pipeline/configs/labels/mskt.yaml``.
BONES = {"femur": 5, "tibia": 6, "patella": 7, "fibula": 8}
GRID = (
    "sweep.flexion_step_deg=5.0",
    "sweep.varus_min_deg=-2.0",
    "sweep.varus_max_deg=2.0",
    "sweep.varus_step_deg=2.0",
    "sweep.cross_check_fraction=0.0",
)
CURVES = (
    ("lateral_mm", "mm"),
    ("anterior_mm", "mm"),
    ("proximal_mm", "mm"),
    ("internal_rotation_deg", "deg"),
)
LEGS = ("mean", "m2sd1", "p2sd1", "rnd1", "rnd2")
#: "At least 0 to 100 deg".
WANTED_DEG = 100.0


def _labels(knee: Knee) -> LabelVolume:
    if knee == "knee_jam":
        return knee_jam_labels()
    return read_label_map((DATA / knee / "labels.nrrd").read_bytes(), "labels.nrrd").volume


def _case(folder: Path, knee: Knee, kind: Kind) -> Path:
    """A case folder of one kind of input."""
    folder.mkdir(parents=True)
    labels = _labels(knee)
    present = {name: value for name, value in BONES.items() if (labels.values == value).any()}
    declared = "labels: mskt" if kind == "labelled" else f"labels: {present}"
    if kind in SCANS:
        (folder / "ct.nrrd").write_bytes(encode_nrrd(synthetic_ct(labels, present, SCANS[kind])))
        declared = ""
    else:
        (folder / "labels.nrrd").write_bytes(encode_nrrd(labels))
    (folder / "case.yaml").write_text(f"side: right\njoint: knee\n{declared}\n")
    return folder


def _swept(case: Path, results: Path) -> RawTable:
    job = CaseJob(case.name, case, results / case.name)
    run_case(job, up_to("sweep"), load_settings(FLOW, case, "clinical", GRID), Execution(jobs=2), Silent())
    return left(job.results, RAW_TABLE)


@cache
def _stable_without(name: str) -> float:
    """Share of attitudes with a stable pose where nothing is made: bones alone slide off one another.

    Raises
    ------
    RuntimeError
        When a run ends otherwise than with a table, or with the refusal that everything slid off.
    """
    with tempfile.TemporaryDirectory() as folder:
        case = Path(folder) / "cases" / name
        _ = _leg_case(case, name) if name in LEGS else _case(case, _knee(name), "bones")
        job = CaseJob(name, case, Path(folder) / "results")
        settings = load_settings(FLOW, case, "clinical", (*GRID[4:], "contact.missing_surfaces=leave"))
        outcome = run_case(job, up_to("sweep"), settings, Execution(jobs=2), Silent())
        if outcome.code == "E-SWP-01" and "slid off" in (outcome.problem or ""):
            return 0.0
        if outcome.code is not None:
            raise RuntimeError(f"{name}: {outcome.code} {outcome.problem}")
        status = left(job.results, RAW_TABLE).poses.status
        return float(np.mean(status == Status.OK))


def _knee(name: str) -> Knee:
    return "knee_jam" if name == "knee_jam" else "knee_mr_a"


@cache
def _table(knee: Knee, kind: Kind) -> RawTable:
    with tempfile.TemporaryDirectory() as name:
        return _swept(_case(Path(name) / "cases" / knee, knee, kind), Path(name) / "results")


@cache
def _leg(name: str) -> RawTable:
    """A leg of ../shared/data/legs_ssm: bones as meshes."""
    with tempfile.TemporaryDirectory() as folder:
        return _swept(_leg_case(Path(folder) / "cases" / name, name), Path(folder) / "results")


def _leg_case(case: Path, name: str) -> Path:
    (case / "meshes").mkdir(parents=True)
    for file in (DATA / "legs_ssm" / name).iterdir():
        (case / "meshes" / file.name).write_bytes(file.read_bytes())
    (case / "case.yaml").write_text("side: right\njoint: knee\n")
    return case


def _curve(table: RawTable, name: str) -> Float:
    """(F,) one coordinate at the varus of the scan; NaN without a pose."""
    middle = len(table.grid.varus_deg) // 2
    found = np.asarray(getattr(table.poses, name)[:, middle], dtype=np.float64)
    return np.where(table.poses.status[:, middle] == Status.OK, found, np.nan)


def _difference(knee: Knee, kinds: tuple[Kind, Kind], curve: tuple[str, str], limit: float) -> Measurement:
    def row() -> Row:
        first, second = (_curve(_table(knee, kind), curve[0]) for kind in kinds)
        rms = float(np.sqrt(np.nanmean((first - second) ** 2)))
        words = curve[0].rsplit("_", 1)[0].replace("_", " ")
        title = f"{knee}, {kinds[0].replace('_', ' ')} against {kinds[1]}: {words}"
        return Row(f"{knee}_{kinds[0]}_{curve[0]}", title, rms, curve[1], limit)

    return row


def _lost(table: RawTable) -> float:
    """Share of attitudes up to 100 deg, at the varus of the scan, without a stable pose."""
    near = table.grid.flexion_deg <= WANTED_DEG
    return float(np.mean(np.isnan(_curve(table, "proximal_mm"))[near]))


def _knee_lost(knee: Knee, kind: Kind) -> Measurement:
    def row() -> Row:
        title = f"{knee}, {kind.replace('_', ' ')}: without a pose, 0 to 100 deg"
        return Row(f"{knee}_{kind}_lost", title, _lost(_table(knee, kind)), "", 0.0)

    return row


def _leg_lost(name: str) -> Measurement:
    def row() -> Row:
        return Row(f"leg_{name}_lost", f"legs_ssm/{name}: without a pose, 0 to 100 deg", _lost(_leg(name)), "", 0.0)

    return row


def _nothing_made(name: str) -> Measurement:
    def row() -> Row:
        where = f"legs_ssm/{name}" if name in LEGS else name
        return Row(f"{name}_bare_stable", f"{where}, nothing made: stable", _stable_without(name), "", 0.5)

    return row


def _differences(knee: Knee, kinds: tuple[Kind, Kind], limits: tuple[float, ...]) -> list[Measurement]:
    return [_difference(knee, kinds, curve, limit) for curve, limit in zip(CURVES, limits, strict=True)]


def _of_a_scan(knee: Knee, kind: Kind) -> list[Measurement]:
    """A synthetic CT against the bones it was made from."""
    return [_knee_lost(knee, kind), *_differences(knee, (kind, "bones"), (1.5, 4.0, 1.0, 10.0))]


KINDS_OF_CT: tuple[Kind, ...] = ("ct", "fine_ct", "noisy_ct", "thick_ct", "coarse_ct")
ROWS: tuple[Measurement, ...] = (
    (
        _knee_lost("knee_mr_a", "bones"),
        *_differences("knee_mr_a", ("bones", "labelled"), (2.0, 5.0, 1.5, 15.0)),
        _knee_lost("knee_jam", "bones"),
        *_differences("knee_jam", ("bones", "labelled"), (2.5, 7.0, 3.0, 18.0)),
        *(row for kind in KINDS_OF_CT for row in _of_a_scan("knee_mr_a", kind)),
        *(_leg_lost(name) for name in LEGS),
        *(_nothing_made(name) for name in ("knee_mr_a", "knee_jam", *LEGS)),
    )
    if KNEE_JAM.exists()
    else ()
)
