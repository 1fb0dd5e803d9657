"""The report on paper: the same words and pictures, nothing that moves, and sheets that can be told apart and read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
import weasyprint

from pipeline.adapters.pictures import blank, png
from pipeline.engine.stage import Finding, Severity
from pipeline.report import build
from pipeline.report.build import Page, report_html, report_pdf
from pipeline.report.evidence import Evidence
from pipeline.report.figures import Drawn, expected_figures
from pipeline.report.metrics import all_metrics
from pipeline.report.motion import MOTION
from pipeline.report.settings import Limits, PictureSettings
from pipeline.report.verdict import judge
from tests.report.sample import sample_evidence
from tests.report.test_build import HOSTILE, Tags

#: About the shapes of real ones: wide, and nearly square.
SHAPES = {"poses": (152, 135), "neutral": (140, 130)}
MARGIN_PX = 12 / 25.4 * 96


def page(evidence: Evidence, *more: Drawn) -> Page:
    figures = [Drawn(figure, png(blank(*SHAPES.get(figure.name, (158, 57))))) for figure in expected_figures(evidence)]
    verdict = judge(all_metrics(evidence, Limits()), (), evidence.findings)
    return Page(evidence, verdict, [*figures, *more], (), PictureSettings())


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is printed from now on, as HTML."""
    documents: list[str] = []

    def keep(html: str) -> bytes:
        documents.append(html)
        return b"%PDF"

    monkeypatch.setattr(build, "pdf", keep)
    return documents


class Sheet:
    """One sheet as it is laid out."""

    def __init__(self, laid_out: Any) -> None:
        boxes = list(laid_out._page_box.descendants())
        self.texts = [box for box in boxes if hasattr(box, "text")]
        self.text = " ".join(" ".join(box.text for box in self.texts).split())
        self.pictures = [box for box in boxes if box.element_tag == "img"]
        self.width_px: float = laid_out.width


def sheets(html: str) -> Sequence[Sheet]:
    return [Sheet(one) for one in weasyprint.HTML(string=html).render().pages]


def test_the_words_and_pictures_are_those_of_the_screen(printed: list[str]) -> None:
    shown = page(sample_evidence("left", "CASE-7"))
    report_pdf(shown)
    paper, screen = Tags(printed[0]), Tags(report_html(shown).decode())
    assert [a["src"] for tag, a in paper.tags if tag == "img"] == [a["src"] for tag, a in screen.tags if tag == "img"]
    below = "Numbers\nA limit stands"
    assert paper.text[paper.text.index(below) :].strip() in screen.text
    for words in (shown.verdict.word, "CASE-7", "LEFT knee", "What this is", "Sign-off"):
        assert paper.text.count(words) == screen.text.split('{"')[0].count(words) > 0


def test_nothing_on_paper_moves_or_runs(printed: list[str]) -> None:
    report_pdf(page(sample_evidence()))
    tags = {tag for tag, _ in Tags(printed[0]).tags}
    assert not tags & {"script", "canvas", "video"}
    assert 'class="viewer"' not in printed[0]
    words = " ".join(Tags(printed[0]).text.split())
    assert "report.html, the same report for a browser, also shows the joint as a model to turn and move." in words


def test_where_the_film_is_and_that_it_is_missing(printed: list[str]) -> None:
    evidence = sample_evidence()
    report_pdf(page(evidence, Drawn(MOTION, b"film")))
    report_pdf(page(evidence, Drawn(MOTION, b"", "no pose at two flexions")))
    there, missing = (" ".join(Tags(html).text.split()) for html in printed)
    assert "a model to turn and move, and as a film." in there
    assert "film is missing" not in there
    assert "a model to turn and move." in missing
    assert "film is missing: no pose at two flexions." in missing


def test_every_sheet_says_whose_it_is(printed: list[str]) -> None:
    report_pdf(page(sample_evidence("left", "CASE-7")))
    laid_out = sheets(printed[0])
    assert len(laid_out) >= 4
    for number, sheet in enumerate(laid_out, 1):
        assert "Case CASE-7 | LEFT knee" in sheet.text
        assert "Research use - not for diagnosis" in sheet.text
        assert f"page {number} of {len(laid_out)}" in sheet.text


def test_a_picture_stays_whole_with_its_title_and_its_lines(printed: list[str]) -> None:
    shown = page(sample_evidence())
    report_pdf(shown)
    laid_out = sheets(printed[0])
    assert sum(len(sheet.pictures) for sheet in laid_out) == len(shown.figures)
    for sheet in laid_out:
        assert sheet.text.count("What this is") == sheet.text.count("What to do") == len(sheet.pictures)
    for number, drawn in enumerate(shown.figures, 1):
        (home,) = [sheet for sheet in laid_out if f"{number}. {drawn.figure.title}" in sheet.text]
        assert drawn.figure.caption.what.split(",")[0] in home.text


def crowded() -> Evidence:
    """Evidence with names, hashes and words that are too long, and findings for several sheets."""
    evidence = sample_evidence("right", "C" * 64)
    found = tuple(Finding("W-X-01", Severity.REVIEW, f"Finding number {i}. {'m' * 150}") for i in range(90))
    files = {f"{'n' * 140}-{i}.nrrd": f"{i:064x}" for i in range(3)}
    facts = replace(evidence.facts, source_files=files)
    return replace(evidence, facts=facts, findings={**evidence.findings, "mesh": found})


def test_nothing_is_cut_off_at_the_edge(printed: list[str]) -> None:
    report_pdf(page(crowded()))
    for sheet in sheets(printed[0]):
        for box in sheet.texts:
            assert box.position_x >= MARGIN_PX - 1
            assert box.position_x + box.width <= sheet.width_px - MARGIN_PX + 1, box.text


def test_a_table_repeats_its_head_on_every_sheet(printed: list[str]) -> None:
    report_pdf(page(crowded()))
    with_rows = [sheet for sheet in sheets(printed[0]) if "W-X-01" in sheet.text]
    assert len(with_rows) >= 3
    assert all("What was found" in sheet.text for sheet in with_rows)


def test_hostile_text_is_printed_and_not_obeyed(printed: list[str]) -> None:
    evidence = sample_evidence("right", HOSTILE)
    spoiled = replace(evidence, facts=replace(evidence.facts, source_files={HOSTILE: "ab"}, joint=HOSTILE))
    report_pdf(page(spoiled))
    assert not {"script"} & {tag for tag, _ in Tags(printed[0]).tags}
    assert all(HOSTILE.replace("  ", " ") in sheet.text.replace("’", "'") for sheet in sheets(printed[0]))
