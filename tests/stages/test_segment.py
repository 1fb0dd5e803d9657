"""Stage 20: bones found in a synthetic CT; given labels held against the CT they came with."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.adapters.bone_segmentation import segment_bones
from pipeline.artifacts import CASE_FACTS, CT, GIVEN_FACTS, GIVEN_LABELS, LABELS
from pipeline.engine.stage import Findings, Severity
from pipeline.errors import CaseRejected
from pipeline.geometry.phantom import PHANTOM_LABELS, phantom_labels
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.geometry.synthetic_ct import SyntheticCtSpec, synthetic_ct
from pipeline.geometry.volume import CtVolume, LabelVolume
from pipeline.stages.segment import STAGE, Params
from tests.stages.in_memory import Run, facts

BONES = {name: PHANTOM_LABELS[name] for name in ("femur", "tibia", "patella", "fibula")}


@pytest.fixture(scope="module")
def labels() -> LabelVolume:
    return phantom_labels(PhantomSpec(spacing_mm=(1.0, 1.0, 1.0)))


@pytest.fixture(scope="module")
def ct(labels: LabelVolume) -> CtVolume:
    return synthetic_ct(labels, BONES, SyntheticCtSpec(spacing_mm=(1.0, 1.0, 1.0)))


def segment(given: dict[str, Any], params: Params | None = None) -> tuple[Run, Findings]:
    run = Run(STAGE, {GIVEN_LABELS.name: None, CT.name: None, **given})
    return run, run.go(params or Params())


def test_the_bones_of_a_ct_alone_are_found(ct: CtVolume) -> None:
    run, findings = segment({GIVEN_FACTS.name: facts(source="ct", structures={}), CT.name: ct})
    found = run[CASE_FACTS]
    assert set(found.structures) == set(BONES)
    assert found.shape == run[LABELS].values.shape  # type: ignore[union-attr]
    for name, value in found.structures.items():
        assert found.voxels[name] == np.count_nonzero(run[LABELS].values == value)  # type: ignore[union-attr]
    assert found.clipped_mm2["femur"] > 100.0  # its shaft is cut by the scan
    assert found.clipped_mm2["patella"] == 0.0
    assert [(one.code, one.severity) for one in findings] == [("N-SEG-01", Severity.NOTE)]


def test_doubt_metal_another_knee_and_what_is_missing_are_told(ct: CtVolume, monkeypatch: pytest.MonkeyPatch) -> None:
    found = segment_bones(ct, "right")
    told = replace(
        found,
        confidence={**found.confidence, "tibia": 0.79},
        facts=replace(found.facts, knees=2, metal_mm3=1500.0, missing=("fibula",)),
    )
    monkeypatch.setattr("pipeline.adapters.bone_segmentation.segment_bones", lambda *_: told)
    _, findings = segment({GIVEN_FACTS.name: facts(source="ct", structures={}), CT.name: ct})
    said = {one.code: one for one in findings}
    assert said["W-SEG-01"].message.startswith("Found without certainty in the CT: tibia.")
    assert said["W-SEG-02"].message.startswith("There is metal in the CT (1.5 ml)")
    assert {code for code, one in said.items() if one.severity is Severity.REVIEW} == {"W-SEG-01", "W-SEG-02"}
    assert "fibula" in said["N-SEG-02"].message
    assert said["N-SEG-03"].message.startswith("2 knees are in the CT")


def test_no_knee_is_refused() -> None:
    nothing = CtVolume(np.full((60, 60, 60), 40, dtype=np.int16), np.eye(4))
    with pytest.raises(CaseRejected, match="E-SEG-01 The bones cannot be found: there is no knee in this CT"):
        segment({GIVEN_FACTS.name: facts(source="ct", structures={}), CT.name: nothing})


def test_labels_without_a_ct_pass_as_they_are(labels: LabelVolume) -> None:
    given = facts(structures={"femur": 5, "tibia": 6})
    run, findings = segment({GIVEN_FACTS.name: given, GIVEN_LABELS.name: labels})
    assert run[CASE_FACTS] == given
    np.testing.assert_array_equal(run[LABELS].values, labels.values)  # type: ignore[union-attr]
    assert findings == ()


def test_labels_that_lie_on_bone_are_said_to(labels: LabelVolume, ct: CtVolume) -> None:
    given = {GIVEN_FACTS.name: facts(structures={"femur": 5, "tibia": 6}), GIVEN_LABELS.name: labels, CT.name: ct}
    _, findings = segment(given)
    assert [one.code for one in findings] == ["N-LBL-06"]


def test_labels_of_another_place_are_refused(labels: LabelVolume, ct: CtVolume) -> None:
    moved = labels.lps_from_index.copy()
    moved[:3, 3] += [14.0, 10.0, 12.0]
    given = {
        GIVEN_FACTS.name: facts(structures={"femur": 5, "tibia": 6}),
        GIVEN_LABELS.name: LabelVolume(labels.values, moved),
        CT.name: ct,
    }
    with pytest.raises(CaseRejected, match="E-LBL-06 The label map does not belong to this CT"):
        segment(given)
