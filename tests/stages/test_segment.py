"""Stage 20: bones found in a synthetic CT; given labels held against the CT they came with."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.adapters.bone_segmentation import segment_bones
from pipeline.artifacts import CASE_FACTS, CT, GIVEN_FACTS, GIVEN_LABELS, LABELS
from pipeline.engine.cache import look_up
from pipeline.engine.stage import Findings, Severity
from pipeline.errors import CaseRejected, EnvironmentFault
from pipeline.geometry.label_fit import header_mistakes
from pipeline.geometry.phantom import PHANTOM_LABELS, phantom_labels
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.geometry.synthetic_ct import SyntheticCtSpec, synthetic_ct
from pipeline.geometry.volume import CtVolume, LabelVolume, cropped
from pipeline.labels.site import SiteCommand
from pipeline.records import Side
from pipeline.stages.segment import STAGE, Params
from tests import fake_segmenter
from tests.stages.in_memory import Run, facts
from tests.two_legs import leg, plain_ct, two_legs

BONES = {name: PHANTOM_LABELS[name] for name in ("femur", "tibia", "patella", "fibula")}
SCRIPT = str(Path(fake_segmenter.__file__))


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


def held(labels: LabelVolume, ct: CtVolume, matrix: object = None, params: Params | None = None) -> Findings:
    """Labels moved by a matrix in LPS against the CT they came with."""
    place = labels.lps_from_index if matrix is None else np.asarray(matrix) @ labels.lps_from_index
    given = {
        GIVEN_FACTS.name: facts(structures={"femur": 5, "tibia": 6}),
        GIVEN_LABELS.name: LabelVolume(labels.values, place),
        CT.name: ct,
    }
    return segment(given, params)[1]


def shift(x: float, y: float, z: float) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, 3] = (x, y, z)
    return matrix


@pytest.mark.fault("V11", "V12")
def test_labels_of_another_place_are_refused(labels: LabelVolume, ct: CtVolume) -> None:
    with pytest.raises(CaseRejected, match="E-LBL-08 The label map does not belong to this CT") as refusal:
        held(labels, ct, shift(14.0, 10.0, 12.0))
    assert "when" not in refusal.value.problem


@pytest.mark.fault("V12")
def test_labels_of_another_knee_are_refused(ct: CtVolume) -> None:
    """The same scanner and place, another patient: larger condyles, farther apart, and bent otherwise."""
    larger = PhantomSpec(spacing_mm=(1.0, 1.0, 1.0), medial_radius_mm=25.0, condyle_spacing_mm=52.0, flexion_deg=25.0)
    other = phantom_labels(larger)
    with pytest.raises(CaseRejected, match=r"E-LBL-0[89]"):
        held(other, ct)


@pytest.mark.fault("V11")
def test_labels_a_little_off_are_looked_at_and_farther_off_refused(labels: LabelVolume, ct: CtVolume) -> None:
    assert [one.code for one in held(labels, ct, shift(0.3, 0.0, 0.0))] == ["N-LBL-06"]
    note, look = held(labels, ct, shift(0.0, 0.0, 1.25))
    assert (note.code, look.code, look.severity) == ("N-LBL-06", "W-LBL-09", Severity.REVIEW)
    assert re.search(r"off the bone in the CT: 1\.[1-4] mm to the head", look.message)
    with pytest.raises(CaseRejected, match=r"E-LBL-09 .*: 3\.[0-2] mm to the left.*expected at most 2 mm"):
        held(labels, ct, shift(3.0, 0.0, 0.0))
    assert held(labels, ct, shift(3.0, 0.0, 0.0), Params(most_offset_mm=5.0, offset_review_mm=4.0))


@pytest.mark.fault("V11", "V18")
@pytest.mark.parametrize("words", ["mirrored left to right", "mirrored front to back", "read as RAS instead of LPS"])
def test_labels_that_an_export_turned_are_refused_and_told(labels: LabelVolume, ct: CtVolume, words: str) -> None:
    done = np.linalg.inv(dict(header_mistakes(ct))[words])
    with pytest.raises(CaseRejected, match=f"E-LBL-08 .* It would when {words}"):
        held(labels, ct, done)


def site(mode: str, labels: object, **more: object) -> dict[str, object]:
    return {"command": [sys.executable, SCRIPT, mode, "{ct}", "{labels}", "{side}"], "labels": labels, **more}


def commands(*given: dict[str, object], limit_s: float = 120.0) -> Params:
    return Params(
        commands=tuple(SiteCommand.model_validate(one | {"command": tuple(one["command"])}) for one in given),  # type: ignore[arg-type]
        command_limit_s=limit_s,
    )


def both_tasks() -> Params:
    return commands(
        site("total", "totalsegmentator_total", name="TotalFake", version="2.4.0"),
        site("appendicular", "totalsegmentator_appendicular", name="TotalFake", version="2.4.0"),
    )


def by_command(ct: CtVolume, params: Params, side: Side = "right") -> tuple[Run, Findings]:
    return segment({GIVEN_FACTS.name: facts(source="ct", structures={}, side=side), CT.name: ct}, params)


def bones_only(volume: LabelVolume) -> LabelVolume:
    """Only the bones, numbered in the order of their names."""
    values = np.zeros(volume.values.shape, dtype=np.uint8)
    for number, name in enumerate(sorted(BONES), start=1):
        values[volume.values == BONES[name]] = number
    return cropped(LabelVolume(values, volume.lps_from_index), 2)


@pytest.mark.parametrize("side", ["right", "left"])
def test_two_commands_of_the_site_find_the_declared_leg(side: Side) -> None:
    run, findings = by_command(plain_ct(two_legs()), both_tasks(), side)
    found, labels = run[CASE_FACTS], run[LABELS]
    assert labels is not None
    assert found.structures == {"femur": 1, "fibula": 2, "patella": 3, "tibia": 4}
    assert (found.source, found.found_by) == ("ct", ("TotalFake 2.4.0",))
    np.testing.assert_array_equal(labels.values, bones_only(leg(side)).values)
    for name, number in found.structures.items():
        assert found.voxels[name] == np.count_nonzero(labels.values == number)
    said = [one.code for one in findings]
    assert said.count("N-SEG-04") == 2
    assert {"N-LEG-01", "N-LEG-02", "N-LBL-06"} <= set(said)
    assert {one.severity for one in findings} == {Severity.NOTE}
    other = {"right": "femur_left", "left": "femur_right"}[side]
    assert any(one.message.endswith(f"not used: {other}.") for one in findings)
    assert any("Found in the CT by TotalFake 2.4.0, a program of the site: femur." in one.message for one in findings)
    assert SCRIPT not in "".join(one.message for one in findings)


def test_one_leg_by_command_is_the_label_map_of_that_leg() -> None:
    run, findings = by_command(plain_ct(leg("right")), both_tasks())
    labels = run[LABELS]
    assert labels is not None
    np.testing.assert_array_equal(labels.values, bones_only(leg("right")).values)
    np.testing.assert_allclose(labels.lps_from_index, bones_only(leg("right")).lps_from_index, atol=1e-9)
    assert "N-LEG-01" not in [one.code for one in findings]
    assert run.told == [(0, 2), (1, 2)]


def test_the_first_command_keeps_what_two_of_them_label() -> None:
    params = commands(site("total", {"femur": 76}), site("overlapping", {"tibia": 2}))
    run, findings = by_command(plain_ct(leg("right")), params)
    assert run[CASE_FACTS].voxels["femur"] == np.count_nonzero(leg("right").values == BONES["femur"])
    assert run[CASE_FACTS].voxels["tibia"] == np.count_nonzero(leg("right").values == BONES["tibia"])
    overlap = next(one for one in findings if one.code == "N-SEG-05")
    assert overlap.message.startswith(f"{run[CASE_FACTS].voxels['femur']} voxels were labelled by more than one")
    assert run[CASE_FACTS].found_by == (Path(sys.executable).name,)  # no name was given: that of the program


def test_femora_named_for_the_wrong_legs_are_never_taken() -> None:
    """As of a volume that a program saw mirrored."""
    params = commands(
        site("total", {"femur_left": 76, "femur_right": 75}), site("appendicular", "totalsegmentator_appendicular")
    )
    with pytest.raises(
        CaseRejected, match=r"E-LEG-01 There seems to be more than one leg in the result .*across to the"
    ):
        by_command(plain_ct(two_legs()), params)


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ([site("nothing", {"femur": 1, "tibia": 2}, name="A")], r"E-SEG-07 A found none of femur, tibia in the CT\."),
        ([site("total", {"femur": 76}, name="A")], r"E-SEG-07 A found no tibia in the CT\."),
        (
            [site("moved", {"femur": 76, "tibia": 2}, name="A", version="1")],
            r"E-SEG-08 What A 1 labelled does not lie on bone in the CT: femur at its edge 40 HU",
        ),
    ],
)
def test_labels_that_cannot_be_those_of_the_knee(given: list[dict[str, object]], problem: str) -> None:
    with pytest.raises(CaseRejected, match=problem):
        by_command(plain_ct(leg("right")), commands(*given))


def test_a_missing_program_is_a_fault_of_the_computer() -> None:
    nothing: dict[str, object] = {
        "command": ["no-such-program-here", "{ct}", "{labels}"],
        "labels": {"femur": 1, "tibia": 2},
    }
    with pytest.raises(EnvironmentFault, match=r"E-SEG-02 no-such-program-here cannot be started: No such file"):
        by_command(plain_ct(leg("right")), commands(nothing))


def test_given_labels_are_kept_whatever_the_site_runs(labels: LabelVolume) -> None:
    given = {GIVEN_FACTS.name: facts(structures={"femur": 5, "tibia": 6}), GIVEN_LABELS.name: labels}
    run, _ = segment(given, commands(site("fail", {"femur": 1, "tibia": 2})))
    np.testing.assert_array_equal(run[LABELS].values, labels.values)  # type: ignore[union-attr]


def test_words_values_and_version_of_a_command_are_part_of_the_cache_key(tmp_path: Path) -> None:
    made = [
        Params(),
        commands(site("total", {"femur": 1})),
        commands(site("total", {"femur": 2})),
        commands(site("other", {"femur": 1})),
        commands(site("total", {"femur": 1}, version="2.4.0")),
        commands(site("total", {"femur": 1}, version="2.4.1")),
    ]
    keys = {look_up(tmp_path, STAGE, params, {}).recipe.key for params in made}
    assert len(keys) == len(made)
