"""Bones found by a program of the site, on their way through the flow."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts import ANATOMY, CASE_FACTS
from pipeline.engine.outcome import RunOutcome
from pipeline.files.nrrd_format import encode_nrrd
from pipeline.geometry.volume import CtVolume
from pipeline.records import Side
from tests import fake_segmenter
from tests.end_to_end.knee_runs import left, run, up_to
from tests.two_legs import leg, plain_ct, two_legs


def command(mode: str, labels: str, version: str) -> dict[str, object]:
    words = [sys.executable, str(Path(fake_segmenter.__file__)), mode, "{ct}", "{labels}", "{side}"]
    return {"command": words, "labels": labels, "name": "Fake", "version": version}


def run_site(folder: Path, ct: CtVolume, side: Side, version: str = "1") -> RunOutcome:
    """Up to the anatomy, by two commands of the site."""
    case = folder / "cases" / "P1"
    case.mkdir(parents=True, exist_ok=True)
    (case / "ct.nrrd").write_bytes(encode_nrrd(ct))
    (case / "case.yaml").write_text(f"side: {side}")
    tasks = {"total": "totalsegmentator_total", "appendicular": "totalsegmentator_appendicular"}
    commands = json.dumps([command(mode, labels, version) for mode, labels in tasks.items()])
    return run(case, folder / "results", up_to("anatomy"), more=(f"segment.commands={commands}",))


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_declared_leg_of_two_has_the_anatomy_of_that_leg_alone(tmp_path: Path, side: Side) -> None:
    assert run_site(tmp_path / "two", plain_ct(two_legs()), side).code is None
    assert run_site(tmp_path / "one", plain_ct(leg(side)), side).code is None
    two, one = (left(tmp_path / name / "results" / "P1", ANATOMY) for name in ("two", "one"))
    assert left(tmp_path / "two" / "results" / "P1", CASE_FACTS).found_by == ("Fake 1",)
    np.testing.assert_allclose(two.scan_attitude, one.scan_attitude, atol=1e-4)
    assert two.side_evidence == one.side_evidence
    assert "lateral of the tibia" in two.side_evidence[0]


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_mirrored_leg_under_the_wrong_side_is_never_accepted(tmp_path: Path, side: Side) -> None:
    """The program calls the femur what the case declares; the fibula tells."""
    other: Side = "left" if side == "right" else "right"
    assert run_site(tmp_path, plain_ct(leg(other)), side).code == "E-SIDE-02"


def test_a_program_is_run_once_and_again_for_a_new_version(tmp_path: Path) -> None:
    ct = plain_ct(leg("right"))
    states = [
        {stage.stage: stage.state for stage in run_site(tmp_path, ct, "right", version).stages}["segment"]
        for version in ("1", "1", "2")
    ]
    assert states == ["ran", "cached", "ran"]
