"""Which value is which structure, and of which side."""

from __future__ import annotations

import pytest

from pipeline.case_declaration import label_preset, label_presets
from pipeline.errors import CaseRejected
from pipeline.labels.scheme import structure_values
from pipeline.records import Side

WANTED = ("femur", "tibia", "femoral_cartilage")
TOTAL = {"femur_left": 75, "femur_right": 76, "tibia": 5}


@pytest.mark.parametrize(("side", "value", "other"), [("right", 76, "femur_left"), ("left", 75, "femur_right")])
def test_names_with_a_side_are_those_of_the_declared_side(side: Side, value: int, other: str) -> None:
    declared, notes = structure_values({}, TOTAL, WANTED, "labels.nrrd", side)
    assert declared == {"femur": value, "tibia": 5}
    assert [(note.code, note.message) for note in notes] == [
        ("N-LEG-02", f"Labels that are named for the other leg are not used: {other}.")
    ]
    segments = {"Femur Left": 75, "Femur right": 76, "Tibia": 5}
    in_file, notes = structure_values(segments, {"femur": 3}, WANTED, "s.seg.nrrd", side)
    assert in_file == declared
    assert [note.code for note in notes] == ["N-LBL-03", "N-LEG-02"]


def test_a_file_that_names_only_the_other_leg_gives_nothing_of_it() -> None:
    chosen, _ = structure_values({"femur_left": 1, "tibia": 2}, {}, WANTED, "s.seg.nrrd", "right")
    assert chosen == {"tibia": 2}


def test_a_structure_whose_own_name_ends_in_a_side_is_itself() -> None:
    chosen, notes = structure_values({}, {"ramp_left": 1, "ramp_right": 2}, ("ramp_left", "ramp_right"), "f", "right")
    assert chosen == {"ramp_left": 1, "ramp_right": 2}
    assert notes == ()


def test_names_that_nobody_wants_are_no_note() -> None:
    assert structure_values({}, {"femur": 1, "hip_left": 77}, WANTED, "f", "right") == ({"femur": 1}, ())


@pytest.mark.parametrize(
    ("segments", "declared", "problem"),
    [
        (
            {},
            {"femur": 1, "femur_right": 2},
            r"Two labels are declared for the same structure of the right leg: femur\.",
        ),
        ({"femur": 1, "Femur-Right": 2}, {}, r"Two segments of f have the same name: femur\."),
        ({"femur": 1, "FEMUR": 2}, {}, r"Two segments of f have the same name: femur\."),
        ({}, {"femur_right": 2, "tibia": 2}, r"Label 2 is given to more than one structure of f: femur, tibia"),
    ],
)
def test_ambiguous_names(segments: dict[str, int], declared: dict[str, int], problem: str) -> None:
    with pytest.raises(CaseRejected, match=f"E-LBL-03 {problem}"):
        structure_values(segments, declared, WANTED, "f", "right")


def test_the_schemes_of_totalsegmentator() -> None:
    assert label_preset("totalsegmentator_total") == {"femur_left": 75, "femur_right": 76}
    assert label_preset("totalsegmentator_appendicular") == {"patella": 1, "tibia": 2, "fibula": 3}
    assert {"totalsegmentator_total", "totalsegmentator_appendicular"} <= set(label_presets())
    with pytest.raises(ValueError, match=r"the label scheme 'totalsegmentator' is not known \(did you mean 'total"):
        label_preset("totalsegmentator")
