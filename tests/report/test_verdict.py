"""The word and its reasons."""

from __future__ import annotations

from typing import Literal

import pytest

from pipeline.engine.stage import Finding, Findings, Severity
from pipeline.records import Metric
from pipeline.report.verdict import guarantees, judge, metric_findings, picture_findings

NOTE = Finding("N-LBL-01", Severity.NOTE, "A note.")


def metric(name: str, state: Literal["ok", "review", "info"]) -> Metric:
    """A metric in a state."""
    return Metric(name, f"Title of {name}", 0.0312345, "mm", "at most 0.02", state, "Its meaning.")


def review(number: int) -> Finding:
    """A review finding of a stage before."""
    return Finding(f"W-TST-0{number}", Severity.REVIEW, f"Reason {number}.")


OWN = metric_findings([metric("contact_error", "review")])


@pytest.mark.parametrize(
    ("own", "earlier", "word", "reasons"),
    [
        ((), (), "PASS", 0),
        ((), (NOTE,), "PASS", 0),
        ((), (review(1),), "REVIEW", 1),
        (OWN, (), "REVIEW", 1),
        (OWN, (NOTE, review(1)), "REVIEW", 2),
        (OWN, (review(1), review(2), review(3)), "REVIEW", 3),
        ((), (review(1), review(1)), "REVIEW", 1),
    ],
)
def test_the_word_follows_the_findings(own: Findings, earlier: Findings, word: str, reasons: int) -> None:
    verdict = judge((), own, {"mesh": earlier})
    assert verdict.word == word
    assert len(verdict.reasons) == reasons


def test_our_own_guarantees_are_named_first() -> None:
    verdict = judge((), OWN, {"mesh": (review(1), review(2), review(3))})
    assert verdict.reasons[0] == OWN[0].message
    assert verdict.reasons[1:] == ("Reason 1.", "Reason 2.")


def test_a_failed_metric_says_number_and_limit_in_a_sentence() -> None:
    (finding,) = metric_findings(
        [metric("contact_error", "review"), metric("midpoint_error", "ok"), metric("x", "info")]
    )
    assert finding.code == "W-QA-05"
    assert finding.severity is Severity.REVIEW
    assert finding.message == (
        "An entry of the table leaves a gap or an overlap: 0.03123 mm, expected at most 0.02 mm."
    )


def test_every_guarantee_has_a_code_of_its_own() -> None:
    codes = [guarantee.code for guarantee in guarantees().values()]
    assert len(set(codes)) == len(codes)


def test_a_missing_picture_asks_for_a_person() -> None:
    (finding,) = picture_findings({"Bones": "the mesh is empty"})
    assert (finding.code, finding.severity) == ("W-QA-10", Severity.REVIEW)
    assert finding.message == "The picture 'Bones' is missing: the mesh is empty."
