"""The page: self-contained, nothing runs but our own scripts, complete, and the same bytes every time."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from pipeline.adapters.pictures import blank, png
from pipeline.engine.stage import Finding, Severity
from pipeline.kinematics.table import Status
from pipeline.records import Side, SurfaceOrigin
from pipeline.report.build import Page, picture_files, report_html, report_pdf, table_rows
from pipeline.report.evidence import Evidence
from pipeline.report.figure_viewer import viewer_data
from pipeline.report.figures import Drawn, expected_figures
from pipeline.report.metrics import all_metrics
from pipeline.report.settings import Limits, PictureSettings
from pipeline.report.templates import number
from pipeline.report.verdict import judge
from tests.report.sample import sample_evidence, with_status

PICTURE = png(blank(4, 3))
HOSTILE = '"><script>alert(1)</script><img src=x onerror=alert(2)>{{ 7 * 7 }}'


class Tags(HTMLParser):
    """All start tags with their attributes, and the text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data


def page(evidence: Evidence, **missing: str) -> Page:
    """A page with small pictures; ``missing`` is figure name -> why."""
    metrics = all_metrics(evidence, Limits())
    figures = [
        Drawn(figure, b"" if figure.name in missing else PICTURE, missing.get(figure.name, ""))
        for figure in expected_figures(evidence)
    ]
    return Page(evidence, judge(metrics, (), evidence.findings), figures, (), PictureSettings())


def html(evidence: Evidence, **missing: str) -> str:
    """The page as text."""
    return report_html(page(evidence, **missing)).decode()


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_top_of_the_page_says_what_matters(side: Side) -> None:
    text = Tags(html(sample_evidence(side, "CASE-7"))).text
    top = text[: text.index("The joint in motion")]
    for words in ("PASS", "CASE-7", f"{side.upper()} knee", "ct2lut ", "Research use - not for diagnosis"):
        assert words in top


def test_every_expected_picture_is_embedded_with_its_four_lines() -> None:
    evidence = sample_evidence()
    tags = Tags(html(evidence))
    sources = [attributes["src"] or "" for tag, attributes in tags.tags if tag == "img"]
    count = len(expected_figures(evidence))
    assert len(sources) == count >= 6
    assert all(base64.b64decode(source.removeprefix("data:image/png;base64,")) == PICTURE for source in sources)
    for line in ("What this is", "Good looks like", "Bad looks like", "What to do"):
        assert tags.text.count(line) == count


SCRIPT = re.compile(r"<script([^>]*)>(.*?)</script>", re.DOTALL)
#: A name of the language of documents, not an address that is asked.
NAMESPACE = "http://www.w3.org/1999/xhtml"


def test_nothing_is_loaded_and_only_our_own_scripts_run() -> None:
    text = html(sample_evidence())
    tags = Tags(text).tags
    hashes = [
        base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
        for kind, code in SCRIPT.findall(text)
        if "application/json" not in kind
    ]
    policy = [attributes.get("content") for tag, attributes in tags if attributes.get("http-equiv")]
    nothing = "default-src 'none'; base-uri 'none'; form-action 'none'"
    strict = f"{nothing}; img-src data:; style-src 'unsafe-inline'; media-src data:; script-src"
    assert policy == [f"{strict} 'sha256-{hashes[0]}' 'sha256-{hashes[1]}'"]
    scripts = [attributes for tag, attributes in tags if tag == "script"]
    assert scripts == [{"type": "application/json", "id": "viewer-data"}, {}, {"type": "module"}]
    assert not {"link", "iframe", "object", "embed", "form", "base", "a"} & {tag for tag, _ in tags}
    addresses = [v or "" for _, attributes in tags for name, v in attributes.items() if name in ("src", "href")]
    assert all(address.startswith("data:image/png;base64,") for address in addresses)
    assert set(re.findall(r"https?://[\w./]+", text)) <= {NAMESPACE}
    assert not re.search(r"@import|url\(", SCRIPT.sub("", text))


def test_the_model_of_the_page_is_that_of_the_case() -> None:
    evidence = sample_evidence("left", "CASE-7")
    data = next(json.loads(code) for kind, code in SCRIPT.findall(html(evidence)) if "application/json" in kind)
    assert data == viewer_data(evidence, PictureSettings())
    assert data["heading"] == "Case CASE-7  |  LEFT knee (L)"


def test_without_script_a_sentence_stands_in_place_of_the_model() -> None:
    tags = Tags(html(sample_evidence()))
    assert [attributes for _, attributes in tags.tags if attributes.get("class") == "on"] == [
        {"class": "on", "hidden": None}
    ]
    assert [attributes for _, attributes in tags.tags if attributes.get("class") == "off"] == [{"class": "off"}]
    assert "needs a browser with JavaScript and WebGL 2" in tags.text


def test_hostile_text_is_shown_and_not_obeyed() -> None:
    evidence = sample_evidence("right", HOSTILE)
    facts = replace(evidence.facts, source_files={HOSTILE: "ab"}, joint=HOSTILE)
    spoiled = replace(
        evidence,
        facts=facts,
        origins=(SurfaceOrigin("moving", HOSTILE, "synthesised"),),
        anatomy=replace(evidence.anatomy, side_evidence=(HOSTILE,)),
        findings={"intake": (Finding("W-X-01", Severity.REVIEW, HOSTILE),)},
    )
    text = html(spoiled, bones=HOSTILE)
    assert [tag for tag, _ in Tags(text).tags if tag in ("script", "img")] == [
        *["img"] * (len(expected_figures(spoiled)) - 1),
        *["script"] * 3,
    ]
    assert HOSTILE in next(json.loads(code) for kind, code in SCRIPT.findall(text) if "json" in kind)["heading"]
    assert not [name for _, attributes in Tags(text).tags for name in attributes if name.startswith("on")]
    assert Tags(text).text.count(HOSTILE) >= 6
    assert "{{ 7 * 7 }}" in text


def test_a_missing_picture_is_a_red_box() -> None:
    text = html(sample_evidence(), poses="no attitude that is shown has a stable pose")
    assert '<p class="missing">This picture is missing: no attitude that is shown has a stable pose.</p>' in text
    assert "This picture is missing" not in html(sample_evidence())


def test_surfaces_that_were_made_are_announced() -> None:
    evidence = sample_evidence()
    assert "Not all surfaces were seen in the scan" in html(evidence)
    labelled = tuple(replace(origin, origin="labelled") for origin in evidence.origins)
    assert "Not all surfaces were seen in the scan" not in html(replace(evidence, origins=labelled))


def test_reasons_are_shown_and_the_rest_is_counted() -> None:
    evidence = sample_evidence()
    reviews = tuple(Finding(f"W-X-0{i}", Severity.REVIEW, f"Reason number {i}.") for i in range(5))
    text = Tags(html(replace(evidence, findings={"mesh": reviews}))).text
    top = text[: text.index("The joint in motion")]
    assert "REVIEW" in top
    assert top.count("Reason number") == 3
    assert "and 2 more, listed under Findings" in top
    assert all(reason.code in text for reason in reviews)


def test_every_metric_and_finding_stands_in_the_page() -> None:
    evidence = sample_evidence()
    text = Tags(html(evidence)).text
    assert all(metric.title in text and metric.meaning in text for metric in all_metrics(evidence, Limits()))
    assert "2 islands of the tibia below 1 % were removed." in text
    assert all(digest in text for digest in evidence.facts.source_files.values())


def test_the_same_result_gives_the_same_bytes() -> None:
    once, again = page(sample_evidence()), page(sample_evidence())
    assert (report_html(once), report_pdf(once)) == (report_html(again), report_pdf(again))


def test_the_pictures_are_files_as_well() -> None:
    evidence = sample_evidence()
    names = {f"images/{figure.name}.png" for figure in expected_figures(evidence)} - {"images/poses.png"}
    assert set(picture_files(page(evidence, poses="none"))) == names


def test_the_table_shows_values_and_says_where_there_are_none() -> None:
    rows = table_rows(with_status(sample_evidence(), (3, 1), Status.SLID_OFF), PictureSettings())
    assert len(rows) == 5 * 3
    assert rows[4] == ["30", "0", "–", "–", "–", "–", "slid off"]
    assert rows[1] == ["0", "0", "0.00", "0.00", "-20.00", "0.00", "stable pose found"]


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (2.2e-16, None, "< 0.0001"),
        (0.0, None, "0"),
        (1e-5, 2, "0.00"),
        (0.012345, None, "0.0123"),
        (1331.0, None, "1331"),
        (-0.001, 2, "0.00"),
        (-0.51, 1, "-0.5"),
        (np.nan, 2, "–"),
    ],
)
def test_numbers_for_people(value: float, digits: int | None, text: str) -> None:
    assert number(value, digits) == text


def test_a_series_of_files_is_one_row_of_the_inputs() -> None:
    evidence = sample_evidence()
    many = {f"ct/IM{k:04}.dcm": f"{k:064x}" for k in range(30)} | {"ligaments.csv": "b" * 64}
    page = html(replace(evidence, facts=replace(evidence.facts, source="ct", source_files=many)))
    assert "ct/ (30 files, one SHA-256 over the list of all)" in page
    assert "IM0001" not in page
    assert "b" * 64 in page
    assert "from a CT</h1>" in page
    assert "found in the CT by the program" in page
    by_site = replace(evidence.facts, source="ct", found_by=("TotalSegmentator 2.4.0",))
    assert "found in the CT by TotalSegmentator 2.4.0" in html(replace(evidence, facts=by_site))
