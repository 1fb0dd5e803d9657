"""The page of a run: the report and how it went, or why there is none."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from pipeline.commands.run_report import report_page, tells_last_run, write_run_page
from pipeline.commands.summary import earlier_page_lines
from pipeline.engine.inspection import CaseStatus
from pipeline.engine.outcome import RunOutcome, StageOutcome
from pipeline.engine.stage import Finding, Severity, Stage
from pipeline.errors import EnvironmentFault, ExitCode
from pipeline.report.build import Page, report_html
from pipeline.report.run_page import run_page
from pipeline.report.settings import RUN_MARK, PictureSettings
from pipeline.report.verdict import judge
from tests.engine.toy_flow import FLOW
from tests.report.sample import sample_evidence

FOUND = Finding("W-TOY-01", Severity.REVIEW, "200 <is> large")
DONE = (
    StageOutcome("gather", 10, "cached", "up to date", 0.01, (), 2.0),
    StageOutcome("multiply", 20, "ran", "no result yet", 3.25, (FOUND,), 3.21, {"multiplying": 1.5}),
)
GOOD = RunOutcome("P1", "REVIEW", ExitCode.REVIEW, DONE, None, None, None)
FAILED = (DONE[1], StageOutcome("total", 30, "failed", "E-TOY-01", 0.5, ()))
REFUSED = RunOutcome("P1", "REJECTED", ExitCode.REJECTED, FAILED, "E-TOY-01", "numbers <txt> is odd.", "Correct it.")


def report() -> bytes:
    return report_html(Page(sample_evidence(), judge((), (), {}), [], (), PictureSettings()))


def test_the_report_has_room_for_the_run_once() -> None:
    assert report().count(RUN_MARK) == 1


def test_the_report_says_how_the_run_went() -> None:
    before, page = report(), run_page(GOOD, report())
    head, _, tail = before.partition(RUN_MARK)
    assert page.startswith(head)
    assert page.endswith(RUN_MARK + tail)
    section = page[len(head) : -len(RUN_MARK + tail)].decode()
    assert "<td>10 gather</td>" in section
    assert "up to date, not computed again" in section
    assert '<td class="n">2.0</td>' in section
    assert "of that: multiplying" in section
    assert '<th class="n">3.3</th><th class="n">5.2</th>' in section


def test_a_refusal_is_a_page_with_the_reason_and_what_was_found() -> None:
    page = run_page(REFUSED, report()).decode()
    assert "numbers &lt;txt&gt; is odd." in page
    assert "Correct it." in page
    assert "200 &lt;is&gt; large" in page
    assert "Research use" in page
    assert "<script" not in page
    assert len(page) < 20_000


def leave(results: Path, stages: Sequence[Stage], text: bytes) -> None:
    folder = results / stages[-1].folder
    folder.mkdir(parents=True)
    (folder / "report.html").write_bytes(text)


def test_the_page_lies_in_the_folder_of_the_case(tmp_path: Path) -> None:
    leave(tmp_path, FLOW, b"<p>made</p>" + RUN_MARK)
    assert report_page(tmp_path, FLOW) == tmp_path / FLOW[-1].folder / "report.html"
    assert write_run_page(GOOD, tmp_path, FLOW) == tmp_path / "report.html"
    assert report_page(tmp_path, FLOW) == tmp_path / "report.html"
    assert (tmp_path / "report.html").read_bytes().startswith(b"<p>made</p><section")


def test_a_run_with_nothing_to_do_leaves_the_page_as_it_is(tmp_path: Path) -> None:
    leave(tmp_path, FLOW, RUN_MARK)
    cached = RunOutcome("P1", "PASS", ExitCode.PASS, DONE[:1], None, None, None)
    write_run_page(GOOD, tmp_path, FLOW)
    before = (tmp_path / "report.html").read_bytes()
    assert write_run_page(cached, tmp_path, FLOW) == tmp_path / "report.html"
    assert (tmp_path / "report.html").read_bytes() == before
    write_run_page(REFUSED, tmp_path, FLOW)
    write_run_page(cached, tmp_path, FLOW)
    assert RUN_MARK in (tmp_path / "report.html").read_bytes(), "the page of a refusal stays after a good run"


def test_a_run_that_did_not_begin_leaves_the_page_of_another(tmp_path: Path) -> None:
    unreached = (StageOutcome("gather", 10, "not reached", "", 0.0, ()),)
    locked = RunOutcome("P1", "ERROR", ExitCode.ENVIRONMENT, unreached, "E-LOCK-01", "It runs already.", "Wait.")
    assert write_run_page(locked, tmp_path, FLOW) is None
    assert not list(tmp_path.iterdir())


def test_a_page_that_cannot_be_written_is_told_unless_the_run_failed_already(tmp_path: Path) -> None:
    leave(tmp_path, FLOW, RUN_MARK)
    (tmp_path / "report.html").mkdir()
    (tmp_path / "report.html" / "in the way").touch()
    with pytest.raises(EnvironmentFault, match=r"report\.html"):
        write_run_page(GOOD, tmp_path, FLOW)
    assert write_run_page(REFUSED, tmp_path, FLOW) is None


STOPPED = RunOutcome("P1", "ERROR", ExitCode.ERROR, (), "E-JOB-01", "P1 did not end within 30 min.", "Give it more.")


@pytest.mark.parametrize(
    ("status", "lines"),
    [
        (
            CaseStatus((), "finished", STOPPED),
            [
                "The last run left no report (ERROR E-JOB-01); this is the report of an earlier run.",
                "P1 did not end within 30 min.",
                "Give it more.",
            ],
        ),
        (CaseStatus((), "interrupted", None), ["The last run was interrupted; this is the report of an earlier run."]),
        (CaseStatus((), "running", None), ["A run is at work; this is the report of an earlier run."]),
    ],
)
def test_the_page_of_an_earlier_run_is_told_as_such(tmp_path: Path, status: CaseStatus, lines: list[str]) -> None:
    leave(tmp_path, FLOW, RUN_MARK)
    page = write_run_page(GOOD, tmp_path, FLOW)
    assert page is not None
    assert tells_last_run(page, CaseStatus((), "finished", GOOD))
    assert not tells_last_run(page, status)
    assert earlier_page_lines(status) == lines


def test_the_page_of_a_refusal_tells_that_run_and_no_other(tmp_path: Path) -> None:
    page = write_run_page(REFUSED, tmp_path, FLOW)
    assert page is not None
    assert tells_last_run(page, CaseStatus((), "finished", REFUSED))
    assert not tells_last_run(page, CaseStatus((), "finished", STOPPED))


def test_a_page_without_records_is_taken_as_it_is(tmp_path: Path) -> None:
    """A package that was copied from elsewhere has no ``run.json``."""
    leave(tmp_path, FLOW, RUN_MARK)
    assert tells_last_run(tmp_path / FLOW[-1].folder / "report.html", CaseStatus((), "never", None))
