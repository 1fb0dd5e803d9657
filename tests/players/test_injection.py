"""Text that wants to be code, in every text field that reaches a page: in Chromium none of it runs, all of it is shown.

Every text of the page's own records is found by its type, so a field that is added later is tried as well. What a
hostile page does is held against what the same page does with harmless words: the same elements, the same attributes,
the words as often as there, and nothing run, asked for or complained of.

``.venv/bin/python -P -m pytest tests/players/test_injection.py``
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any, Literal, get_origin, get_type_hints

import jinja2
import pytest

from pipeline.adapters.pictures import blank, png
from pipeline.engine.outcome import RunOutcome, StageOutcome
from pipeline.engine.stage import Finding, Severity
from pipeline.errors import ExitCode
from pipeline.kinematics.comparison import compare
from pipeline.records import Metric
from pipeline.report import comparison_page
from pipeline.report.build import Page, report_html
from pipeline.report.cohort_page import CaseRow, Links, Number, cohort_html
from pipeline.report.comparison_page import ComparedTable, ComparisonPage, comparison_html
from pipeline.report.figures import Drawn, expected_figures
from pipeline.report.metrics import all_metrics
from pipeline.report.motion import MOTION
from pipeline.report.run_page import run_page
from pipeline.report.settings import RUN_MARK, Limits, PictureSettings
from pipeline.report.verdict import judge
from tests.files.lut_sample import content
from tests.players.browser import CHROMIUM, NEXT_FRAME, SOFTWARE_WEBGL, Browser
from tests.report.sample import sample_evidence

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: hostile pages are tried in none")

PICTURE = png(blank(4, 3))
HARMLESS = "harmless words "
#: What a page of ours asks for beside itself.
OURS = ("data:", "blob:")
#: A text of the program itself that is no words: what the bytes of a picture are.
FIXED = {"media"}
#: Each tries another way out of the text; what succeeds sets ``window.hit``, adds an element or asks for something.
PAYLOADS = (
    "<script>window.hit=1</script>",
    "</script><script>window.hit=1</script>",
    '"><script>window.hit=1</script>',
    "'><script>window.hit=1</script>",
    "<img src=x onerror=window.hit=1>",
    '"><img src=x onerror="window.hit=1">',
    "' autofocus tabindex='0' onfocus='window.hit=1",
    '" autofocus tabindex="0" onfocus="window.hit=1',
    "<svg onload=window.hit=1>",
    "<svg><script>window.hit=1</script></svg>",
    '<a href="javascript:window.hit=1">x</a>',
    "javascript:window.hit=1",
    '<iframe srcdoc="<script>parent.hit=1</script>">',
    '<iframe src="javascript:parent.hit=1">',
    '<object data="data:text/html,<script>parent.hit=1</script>">',
    '<meta http-equiv="refresh" content="0;url=https://example.invalid/">',
    '<base href="https://example.invalid/">',
    '<link rel=stylesheet href="https://example.invalid/x.css">',
    '</style><style>@import "https://example.invalid/x.css";</style>',
    "red}*{background:url(https://example.invalid/x)}",
    "</title><script>window.hit=1</script>",
    "<!--",
    "--><script>window.hit=1</script><!--",
    "{{ 7 * 7 }}{% for x in [1] %}{{ self }}{% endfor %}{# x #}",
    "${window.hit=1}`;window.hit=1;`",
    "\u2028window.hit=1;\u2029//",
    '\\";window.hit=1;//',
    '"},"hit":1}</script><script>window.hit=1</script>',
    "</textarea></td></table><img src=x onerror=window.hit=1>",
    "<details open ontoggle=window.hit=1><summary>x</summary></details>",
    '<form action="https://example.invalid/"><input name=decision>',
    "&lt;img src=x onerror=window.hit=1&gt;",
    "&#60;script&#62;window.hit=1&#60;/script&#62;",
    "\u202e<script>window.hit=1</script>",
    "<math><mtext><table><mglyph><style><img src=x onerror=window.hit=1>",
)
#: What a page is made of: each element with the names of its attributes; how often words are read, and stand in
#: attributes and in the title.
CENSUS = """(words => {
  const all = [...document.querySelectorAll('*')];
  const count = text => text.split(words).length - 1;
  const copy = document.body.cloneNode(true);
  copy.querySelectorAll('script').forEach(one => one.remove());
  return {
    elements: all.map(one => [one.localName, ...one.getAttributeNames()].join(' ')),
    read: count(copy.textContent),
    attributes: all.flatMap(one => [...one.attributes]).filter(one => one.name !== 'data-facts')
      .reduce((sum, one) => sum + count(one.value), 0),
    titles: count(document.title),
    hit: window.hit ?? null,
  };
})"""


@dataclass(frozen=True)
class Seen:
    """What a page was made of in the browser, and everything that it should not have done."""

    census: dict[str, Any]
    ghost: str
    saved: str
    complaints: list[str]


def spoilt(value: Any, words: str, hint: Any = None) -> Any:
    """The same with words before every text of it, also below; one of a fixed set of texts stays."""
    if isinstance(value, Enum) or get_origin(hint) is Literal:
        return value
    if isinstance(value, str):
        return words + value
    if isinstance(value, dict):
        return {spoilt(name, words): spoilt(one, words) for name, one in value.items()}
    if isinstance(value, (tuple, list)):
        return type(value)(spoilt(one, words) for one in value)
    if is_dataclass(value) and not isinstance(value, type):
        hints = get_type_hints(type(value))
        texts = [one.name for one in fields(value) if one.name not in FIXED]
        return replace(value, **{name: spoilt(getattr(value, name), words, hints[name]) for name in texts})
    return value


def page() -> Page:
    """A page that has something in every one of its parts: a review, a picture that is missing, folders of inputs."""
    evidence = sample_evidence()
    facts = replace(evidence.facts, source_files={"labels.nrrd": "ab", "ct/IM1.dcm": "cd"}, found_by=("Finder 1",))
    findings = {**evidence.findings, "mesh": (Finding("W-X-01", Severity.REVIEW, "Look."),)}
    evidence = replace(evidence, facts=facts, findings=findings)
    metrics = (*all_metrics(evidence, Limits()), Metric("own", "Own", 1.0, "mm", "at most 2", "ok", "Means it."))
    figures = [Drawn(one, b"" if one.name == "bones" else PICTURE, "it fails") for one in expected_figures(evidence)]
    figures.append(Drawn(MOTION, b"", "it cannot be drawn"))
    own = (Finding("W-X-02", Severity.REVIEW, "Look here too."),)
    return Page(evidence, judge(metrics, own, evidence.findings), figures, own, PictureSettings())


def comparison_of(words: str) -> bytes:
    """Two tables, of which all that is text is hostile."""
    first, second = content(), content("left")
    tables = [ComparedTable(f"{words}P{k}", f"{words}knee", side, words) for k, side in enumerate(("right", "left"))]
    return comparison_html(ComparisonPage(tables[0], tables[1], compare(first.table, second.table)))


def outcome() -> RunOutcome:
    """A run that was refused after it had found something."""
    found = (Finding("W-X-01", Severity.REVIEW, "Look."),)
    stages = (
        StageOutcome("intake", 10, "ran", "no result yet", 1.0, found, 1.0, {"reading": 0.5}),
        StageOutcome("mesh", 30, "failed", "E-X-01", 1.0, ()),
    )
    return RunOutcome("P001", "REJECTED", ExitCode.REJECTED, stages, "E-X-01", "It does not fit.", "Send another.")


def refused(words: str) -> bytes:
    """The page of a run that left no report."""
    return run_page(spoilt(outcome(), words), None)


def run_of(words: str) -> bytes:
    """The part of a report's page that tells of the run, alone."""
    return run_page(replace(spoilt(outcome(), words), code=None), b"<!DOCTYPE html>" + RUN_MARK)


def cohort_of(words: str) -> bytes:
    """All cases of a folder, one of them with an unusual number."""
    rows = [
        CaseRow(
            f"P{k}", "REVIEW", "RIGHT knee", ("It fails.",), "Look.", review="accepted by AB",
            numbers=(Number("hysteresis_mm", "Hysteresis", "mm", 90.0 if k == 9 else k % 3, over=True),),
        )
        for k in range(10)
    ]  # fmt: skip
    # paths, and the name of the metric, are the program's own
    own = [replace(row, report="", pictures="", numbers=()) for row in rows]
    numbers = [
        tuple(replace(one, title=words + one.title, unit=words + one.unit) for one in row.numbers) for row in rows
    ]
    hostile = [
        replace(spoilt(row, words), report="", pictures="", numbers=n) for row, n in zip(own, numbers, strict=True)
    ]
    return cohort_html(hostile, Links("", ""))


PAGES = {"comparison": comparison_of, "refused": refused, "run": run_of, "cohort": cohort_of}


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """One browser for all pages; what it saves goes nowhere."""
    with Browser(tmp_path_factory.mktemp("profile"), *SOFTWARE_WEBGL) as one:
        one.call("Browser.setDownloadBehavior", behavior="deny")
        yield one


def opened(browser: Browser, file: Path, words: str) -> Seen:
    """What a page is and does when it is opened."""
    browser.events.clear()
    browser.open(file)
    browser.run(NEXT_FRAME)
    census = browser.run(f"{CENSUS}({json.dumps(words)})")
    return Seen(census, "", "", [*browser.complaints(file.as_uri(), *OURS), *(["ran"] if census["hit"] else [])])


def used(browser: Browser, file: Path, other: Path, words: str) -> Seen:
    """What a report is and does when it is opened, given another report to compare with, and signed off."""
    seen = opened(browser, file, words)
    browser.choose(".viewer input[type=file]", other)
    said = "document.querySelector('.ghost-who').textContent + document.querySelector('.ghost-problem').textContent"
    ghost = browser.run(
        f"(async () => {{ while (!({said})) await new Promise(d => setTimeout(d, 10)); return {said} }})()"
    )
    for press in ("input[value=accept]", "button"):
        browser.run("document.querySelector('#sign-off [name=initials]').value = 'AB'")
        browser.run(f"document.querySelector('#sign-off {press}').click()")
    saved = browser.run("document.querySelector('#sign-off [role=status]').textContent")
    browser.run(NEXT_FRAME)
    ran = ["ran"] if browser.run("window.hit ?? null") is not None else []
    return Seen(
        browser.run(f"{CENSUS}({json.dumps(words)})"),
        ghost,
        saved,
        [*seen.complaints, *browser.complaints(file.as_uri(), *OURS), *ran],
    )


def written(folder: Path, data: bytes) -> Path:
    """A page alone in a folder."""
    file = folder / "page.html"
    file.write_bytes(data)
    return file


@pytest.fixture(scope="module")
def harmless(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Seen:
    """The report with harmless words in every field."""
    file = written(tmp_path_factory.mktemp("page"), report_html(spoilt(page(), HARMLESS)))
    return used(browser, file, file, HARMLESS)


def test_the_words_reach_the_page_from_every_kind_of_field(harmless: Seen) -> None:
    assert harmless.complaints == []
    assert harmless.ghost.count(HARMLESS) == 4
    assert harmless.saved.startswith(f"The browser saves it as {HARMLESS}")
    assert harmless.census["titles"] == 2
    assert harmless.census["attributes"] > 10
    assert harmless.census["read"] > 150


@pytest.mark.parametrize("payload", PAYLOADS)
def test_nothing_hostile_in_a_report_runs_and_all_of_it_is_shown(
    browser: Browser, harmless: Seen, tmp_path: Path, payload: str
) -> None:
    file = written(tmp_path, report_html(spoilt(page(), payload)))
    seen = used(browser, file, file, payload)
    assert seen.complaints == []
    assert seen.census == harmless.census
    assert seen.ghost.count(payload) == 4
    assert seen.saved.startswith(f"The browser saves it as {payload}")


@pytest.mark.parametrize("payload", PAYLOADS)
def test_nothing_in_the_file_of_another_report_runs(
    browser: Browser, harmless: Seen, tmp_path: Path, payload: str
) -> None:
    good = report_html(spoilt(page(), HARMLESS))
    (tmp_path / "other.html").write_bytes(good.replace(b"<body>", f"<body>{payload}".encode()))
    seen = used(browser, written(tmp_path, good), tmp_path / "other.html", HARMLESS)
    assert seen == harmless


@pytest.mark.parametrize("name", PAGES)
def test_nothing_hostile_in_another_page_runs_and_all_of_it_is_shown(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr(comparison_page, "charts_png", lambda *_: PICTURE)
    good = opened(browser, written(tmp_path, PAGES[name](HARMLESS)), HARMLESS)
    assert good.complaints == []
    assert good.census["read"] >= 5
    for payload in PAYLOADS:
        assert opened(browser, written(tmp_path, PAGES[name](payload)), payload) == good, payload


@pytest.mark.parametrize(
    "payload", [one for one in PAYLOADS if one.startswith(("<script", "</script", "<img", "<svg"))]
)
def test_a_page_that_escapes_nothing_is_caught(
    browser: Browser, harmless: Seen, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, payload: str
) -> None:
    real = jinja2.Environment

    def naive(**options: Any) -> jinja2.Environment:
        made = real(**{**options, "autoescape": False})
        made.filters["tojson"] = json.dumps
        return made

    monkeypatch.setattr(jinja2, "Environment", naive)
    seen = opened(browser, written(tmp_path, report_html(spoilt(page(), payload))), payload)
    assert seen.complaints != []
    assert seen.census["elements"] != harmless.census["elements"]
