"""From a DICOM series without labels to the numbers: bones found, cartilage and menisci made, stable poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts import CASE_FACTS, SURFACE_ORIGINS
from pipeline.engine.outcome import RunOutcome
from pipeline.errors import ExitCode
from pipeline.files.phantom_case import write_phantom_case
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.kinematics.table import Status
from tests.end_to_end.knee_runs import SPACING_MM, left, poses, run


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunOutcome]:
    """A run of the coarse phantom's synthetic CT up to the smoothed table."""
    folder = tmp_path_factory.mktemp("ct")
    write_phantom_case(folder / "cases" / "scanned", PhantomSpec(spacing_mm=SPACING_MM), as_ct=True)
    outcome = run(folder / "cases" / "scanned", folder / "results", jobs=2)
    return folder / "results" / "scanned", outcome


def test_the_case_is_computed(done: tuple[Path, RunOutcome]) -> None:
    results, outcome = done
    review = [f.message for s in outcome.stages for f in s.findings if f.severity == "review"]
    assert outcome.exit_code in (ExitCode.PASS, ExitCode.REVIEW), review
    assert set(left(results, CASE_FACTS).structures) == {"femur", "tibia", "patella", "fibula"}


def test_cartilage_and_menisci_are_made_and_said_to_be(done: tuple[Path, RunOutcome]) -> None:
    origins = {one.structure: one.origin for one in left(done[0], SURFACE_ORIGINS)}
    assert {name for name, origin in origins.items() if origin == "labelled"} == {"femur", "tibia"}
    assert {origin for name, origin in origins.items() if name not in ("femur", "tibia")} == {"synthesised"}


def test_every_pose_is_stable_and_near_the_phantoms_own(done: tuple[Path, RunOutcome]) -> None:
    """Other surfaces than the phantom's, on the same bones: the same place along delta within a millimetre."""
    raw, _ = poses(done[0])
    assert (raw.status == Status.OK).all()
    assert np.nanmax(raw.equilibrium_residual) < 0.02
    assert np.ptp(raw.proximal_mm) < 3.0
    assert np.abs(raw.lateral_mm).max() < 5.0
