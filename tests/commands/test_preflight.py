"""Facts of a case to rows that a radiographer reads: states, numbers with units, what to do, exit codes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pipeline.commands.preflight import (
    Row,
    SeriesFacts,
    State,
    Wanted,
    closing,
    exit_code,
    finding_rows,
    knee_rows,
    lines,
    metal_row,
    refusal_row,
    series_rows,
    side_row,
    structures_rows,
    volume_row,
)
from pipeline.engine.stage import Finding, Severity
from pipeline.errors import CaseRejected, ExitCode
from pipeline.geometry.field_of_view import BoneExtent, KneeExtent
from pipeline.geometry.knee_side import SideSign

MATRIX = np.diag([0.5, 0.5, 0.8, 1.0])
SERIES = SeriesFacts(300, (), ("",), 1.0, 0.0, MATRIX)
LONG = BoneExtent(130.0, 100.0, 80.0)
KNEE = KneeExtent(LONG, LONG, 4.2, 1.8)
WANTED = Wanted(10.0, (), ("femur", "tibia", "femoral_cartilage", "medial_meniscus"), "make")


def said(rows: object) -> dict[str, Row]:
    return {row.title: row for row in rows}  # type: ignore[attr-defined]


def test_a_row_is_one_line_and_what_to_do_a_second() -> None:
    assert lines(Row("metal", "none")) == ["OK    metal         none"]
    first, second = lines(Row("metal", "1 ml", State.LOOK, "Look at it."))
    assert first == "LOOK  metal         1 ml"
    assert second.strip() == "-> Look at it."
    assert second.index("->") == first.index("1 ml")


@pytest.mark.parametrize(
    ("states", "code", "last"),
    [
        ([State.OK], ExitCode.PASS, "OK    P001: nothing speaks against processing it."),
        ([State.OK, State.LOOK, State.LOOK], ExitCode.REVIEW, "LOOK  P001: 2 to look at."),
        ([State.LOOK, State.STOP], ExitCode.REJECTED, "STOP  P001: a run would refuse this case."),
    ],
)
def test_the_worst_row_decides(states: list[State], code: ExitCode, last: str) -> None:
    rows = [Row("x", "y", state) for state in states]
    assert exit_code(rows) == code
    assert closing("P001", rows)[0] == last
    assert any("quick look" in line for line in closing("P001", rows)) is (code != ExitCode.REJECTED)


def test_a_refusal_keeps_its_code_its_words_and_its_subject() -> None:
    row = refusal_row(CaseRejected("E-DCM-09", "2 slices are missing.", "Export again."))
    assert row == Row("CT series", "E-DCM-09  2 slices are missing.", State.STOP, "Export again.")
    assert refusal_row(CaseRejected("E-NEW-01", "a", "b")).title == "case"


def test_findings_ask_to_look_and_notes_stay_in_the_report() -> None:
    review = Finding("W-CT-01", Severity.REVIEW, "No air.")
    knees = Finding("N-SEG-03", Severity.NOTE, "2 knees.")
    rows = list(finding_rows([review, review, knees, Finding("N-CT-01", Severity.NOTE, "Rounded.")]))
    assert [(row.title, row.state) for row in rows] == [("CT numbers", State.LOOK), ("bones", State.OK)]
    assert rows[0].found == "W-CT-01  No air."
    assert rows[0].action


def test_a_series_tells_slices_side_gaps_tilt_and_orientation() -> None:
    rows = said(series_rows(SERIES, "right"))
    assert {title: row.found for title, row in rows.items()} == {
        "CT series": "300 slices of one series; no other files",
        "side": "right, as declared; DICOM does not say",
        "slice gaps": "none missing, 0.8 mm apart; 1 mm thick",
        "gantry tilt": "none in the slices",
        "orientation": "axial slices, 0 deg oblique; stored as LPS",
    }
    assert {row.state for row in rows.values()} == {State.OK}


def test_files_set_aside_are_named_up_to_three() -> None:
    aside = tuple((f"ct/{n}", "localiser") for n in "abcd")
    row = said(series_rows(replace(SERIES, set_aside=aside), "left"))["CT series"]
    assert row.found.endswith("set aside: ct/a (localiser), ct/b (localiser), ct/c (localiser) and 1 more")


def test_a_side_that_dicom_contradicts_is_left_to_the_refusal() -> None:
    assert "DICOM says left" in said(series_rows(replace(SERIES, laterality=("L",)), "left"))["side"].found
    assert "side" not in said(series_rows(replace(SERIES, laterality=("L",)), "right"))
    assert "does not say" in said(series_rows(replace(SERIES, laterality=("L", "R")), "right"))["side"].found


def test_slices_that_are_no_grid_have_no_gaps_to_tell() -> None:
    assert set(said(series_rows(replace(SERIES, lps_from_index=None), "right"))) == {"CT series", "side"}


def test_a_sagittal_reformat_with_a_tilt_taken_out() -> None:
    c, s = math.cos(0.2), math.sin(0.2)
    matrix = np.array([[0, s, c, 0.0], [1, 0, 0, 0], [0, -c, s, 0], [0, 0, 0, 1]])
    rows = said(series_rows(replace(SERIES, lps_from_index=matrix, tilt_deg=8.0), "right"))
    assert rows["orientation"].found == "sagittal slices, 11 deg oblique; stored as PIL"
    assert rows["gantry tilt"].found == "none in the slices (the scanner's 8 deg are taken out)"


def test_the_range_of_a_scan() -> None:
    row = volume_row((512, 512, 300), np.array([0.5, 0.5, 0.8]))
    assert row.found == "256 x 256 x 240 mm: 512 x 512 x 300 voxels of 0.5 x 0.5 x 0.8 mm"


def test_enough_shaft_and_a_joint_space_are_well() -> None:
    rows = said(knee_rows(KNEE, WANTED))
    assert {row.state for row in rows.values()} == {State.OK}
    assert rows["femur"].found == "130 mm above the joint line, 80 mm of it shaft"
    assert rows["tibia"].found.startswith("130 mm below the joint line")
    assert rows["joint space"].found == "about 4.2 mm at its narrowest, in layers of 1.8 mm"


def test_a_short_shaft_is_looked_at_and_a_stump_will_be_refused() -> None:
    short, stump = BoneExtent(60.0, 30.0, 10.0), BoneExtent(30.0, 8.0, 0.0)
    rows = said(knee_rows(replace(KNEE, femur=short, tibia=stump), WANTED))
    assert rows["femur"].state is State.LOOK
    assert "its axis is sure only from 15 mm on" in rows["femur"].found
    assert "more of the femur" in rows["femur"].action
    assert "only 8 mm beyond its widest part, expected at least 12 mm" in rows["tibia"].found
    assert rows["tibia"].action.startswith("A run would refuse this later.")


def test_a_given_landmark_or_frame_takes_the_place_of_the_shaft() -> None:
    knee = replace(KNEE, femur=BoneExtent(60.0, 30.0, 10.0))
    assert said(knee_rows(knee, replace(WANTED, landmarks=("femoral_head_centre",))))["femur"].state is State.OK
    assert said(knee_rows(knee, replace(WANTED, landmarks=("ankle_centre",))))["femur"].state is State.LOOK
    assert said(knee_rows(knee, replace(WANTED, limit_deg=None)))["femur"].state is State.OK


@pytest.mark.parametrize(
    ("space_mm", "words"),
    [
        (0.0, "0.0 mm at its narrowest"),
        (-4.0, "0.0 mm at its narrowest"),
        (14.0, "14.0 mm at its narrowest"),
        (math.nan, "do not lie over each other"),
    ],
)
def test_no_joint_space_is_looked_at(space_mm: float, words: str) -> None:
    row = said(knee_rows(replace(KNEE, space_mm=space_mm), WANTED))["joint space"]
    assert row.state is State.LOOK
    assert words in row.found


def test_the_anatomy_confirms_the_side_or_does_not() -> None:
    outer, inner = SideSign("the fibula lies outside", 30.0, True), SideSign("the fibula lies inside", -30.0, False)
    assert side_row([outer], "right") == Row("side (bones)", "right by its anatomy: the fibula lies outside")
    assert side_row([outer, inner], "right").found == "declared right, but the fibula lies inside"
    assert side_row([outer, inner], "right").state is State.LOOK
    assert side_row([], "left").state is State.LOOK


def test_metal_is_looked_at() -> None:
    assert metal_row(0.0).state is State.OK
    assert metal_row(1500.0).found.startswith("1.5 ml denser than bone")
    assert metal_row(0.4).state is State.LOOK


def test_what_is_missing_and_what_takes_its_place() -> None:
    assert [row.title for row in structures_rows(WANTED.surfaces, WANTED)] == ["structures"]
    bones = {"femur": 1, "tibia": 2}
    made = said(structures_rows(bones, WANTED))
    assert made["structures"].found == "femur, tibia"
    assert made["not there"].found == "femoral cartilage, medial meniscus; made from the bones, not seen in the scan"
    assert "one filler" in said(structures_rows(bones, replace(WANTED, missing="filler")))["not there"].found
    left = said(structures_rows(bones, replace(WANTED, missing="leave")))["not there"]
    assert (left.state, left.found) == (
        State.LOOK,
        "femoral cartilage, medial meniscus; the bones meet without them",
    )
