"""A coarse phantom knee run for real, and comparisons of what runs leave."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.artifacts import NEUTRAL_CURVE, RAW_TABLE, SMOOTH_TABLE
from pipeline.config import load_settings
from pipeline.engine.artifacts import Artifact
from pipeline.engine.outcome import Execution, RunOutcome
from pipeline.engine.runner import CaseJob, run_case
from pipeline.engine.stage import Stage
from pipeline.files.nrrd_format import encode_nrrd
from pipeline.files.phantom_case import write_phantom_case
from pipeline.flow import FLOW
from pipeline.geometry.phantom import phantom_labels
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.geometry.volume import LabelVolume
from pipeline.kinematics.neutral import NeutralCurve
from pipeline.kinematics.table import PoseTable

T = TypeVar("T")


def up_to(name: str) -> tuple[Stage, ...]:
    """The flow up to a stage."""
    return FLOW[: 1 + [stage.name for stage in FLOW].index(name)]


#: Up to the smoothed table: the numbers, without pictures and package.
NUMBERS = up_to("smooth")

#: A grid and meshes small enough for a test, coarse enough to be quick.
COARSE = (
    "contact.triangles=10000",
    "mesh.triangles_of={femur: 6000, tibia: 6000}",
    "mesh.triangles=3000",
    "mesh.volume_tolerance_fraction=0.08",
    "qa.limits.max_volume_error_percent=8.0",
    "sweep.flexion_max_deg=30.0",
    "sweep.flexion_step_deg=10.0",
    "sweep.varus_min_deg=-2.0",
    "sweep.varus_max_deg=2.0",
    "sweep.varus_step_deg=2.0",
    "sweep.scan_shift_mm=1.0",
    "qa.pictures.panel_px=240",
)
SPACING_MM = (1.0, 1.0, 1.0)

#: Written anew by every run: records of the run itself, not results.
RECORDS = frozenset({"stage.json", "run.json", "log.jsonl", ".lock"})


class Silent:
    """A listener that says nothing."""

    def stage_started(self, stage: str, index: int, total: int, reason: str) -> None: ...

    def stage_progress(self, stage: str, done: int, total: int) -> None: ...

    def stage_finished(self, outcome: object, index: int, total: int) -> None: ...


def phantom_case(cases: Path, name: str, spec: PhantomSpec | None = None) -> Path:
    """A case folder with a phantom knee."""
    write_phantom_case(cases / name, spec or PhantomSpec(spacing_mm=SPACING_MM))
    return cases / name


def mirrored_case(cases: Path, name: str) -> Path:
    """The same voxels with left and right exchanged in the header: a left knee."""
    volume = phantom_labels(PhantomSpec(spacing_mm=SPACING_MM))
    mirrored = LabelVolume(volume.values, np.diag([-1.0, 1.0, 1.0, 1.0]) @ volume.lps_from_index)
    (cases / name).mkdir(parents=True)
    (cases / name / "labels.nrrd").write_bytes(encode_nrrd(mirrored))
    (cases / name / "case.yaml").write_text("side: left\njoint: knee\nlabels: phantom\n")
    return cases / name


def run(
    case: Path, results: Path, flow: Sequence[Stage] = NUMBERS, jobs: int = 1, more: Sequence[str] = ()
) -> RunOutcome:
    """Process a case with the coarse settings; results go to ``results/<ID>``."""
    settings = load_settings(FLOW, case, "clinical", (*COARSE, *more))
    job = CaseJob(case.name, case, results / case.name)
    return run_case(job, flow, settings, Execution(jobs=jobs), Silent())


def files_of(folder: Path) -> dict[str, bytes]:
    """Every result below a folder: relative name -> bytes."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in RECORDS
    }


def left(results: Path, artifact: Artifact[T]) -> T:
    """What a case's results hold of one artifact of one file."""
    (path,) = results.glob(f"[0-9]*_*/{artifact.file}")
    return artifact.decode({"": path.read_bytes()})


def poses(results: Path) -> tuple[PoseTable, PoseTable]:
    """Raw and smoothed poses of a case's results."""
    return left(results, RAW_TABLE).poses, left(results, SMOOTH_TABLE).poses


def neutral(results: Path) -> NeutralCurve:
    """The neutral curve of a case's results."""
    return left(results, NEUTRAL_CURVE)


def largest_difference(first: PoseTable, second: PoseTable) -> tuple[float, float]:
    """Of the coordinates: mm, deg."""
    shifts = [_most(first.lateral_mm, second.lateral_mm), _most(first.anterior_mm, second.anterior_mm)]
    shifts.append(_most(first.proximal_mm, second.proximal_mm))
    return max(shifts), _most(first.internal_rotation_deg, second.internal_rotation_deg)


def _most(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    assert np.array_equal(np.isnan(first), np.isnan(second))
    return float(np.nanmax(np.abs(first - second)))
