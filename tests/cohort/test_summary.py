"""The summary of a cohort: the table, the overview with cases that have no results, the last lines, the exit code."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from pipeline.cohort import summary as product
from pipeline.cohort.batches import PlanInputs, write_plan
from pipeline.cohort.model import CaseEnd, ListedCase, Plan
from pipeline.cohort.place import CohortPlace
from pipeline.cohort.summary import (
    NUMBERS,
    CaseSummary,
    History,
    Summary,
    failed_ids,
    summary_csv,
    summary_lines,
    write_summary,
)
from pipeline.commands.cohort_index import Places, write_overview
from pipeline.engine.lock import case_lock
from pipeline.engine.outcome import RunRecord, save_record
from pipeline.engine.store import make_folder
from pipeline.errors import ExitCode
from pipeline.flow import FLOW
from pipeline.records import Verdict
from pipeline.report import cohort_page
from pipeline.report.cohort_page import CaseRow, Number
from tests.cohort.cohort_sample import REFUSED, Batches, lost, planned, refused
from tests.report.cohort_sample import metrics, write_finished, write_stopped

PASSED = Verdict("PASS", (), metrics(-1.25))
REVIEW = Verdict("REVIEW", ("The first reason.", "The second reason."), metrics(2.0))
IDS = ("0012", "P2", "P3", "P4", "P5", "P6")


@pytest.fixture
def cohort(tmp_path: Path) -> tuple[CohortPlace, Plan, Batches]:
    """0012 passed, P2 is for review, P3 was refused in its run, P4 before it; P5 was killed; P6 did not begin."""
    place, plan = planned(tmp_path, IDS)
    write_finished(place.results, "0012", PASSED, "left")
    write_finished(place.results, "P2", REVIEW)
    write_stopped(place.results, "P3", "REJECTED", REFUSED)
    make_folder(place.results / "P5")
    save_record(place.results / "P5", RunRecord("running", None))
    batches = Batches(place, plan)
    finished = CaseEnd("0012", "PASS", seconds=12.34, peak_mb=345.6)
    batches.run(finished, CaseEnd("P2", "REVIEW"), refused("P3"), CaseEnd("P4", "ERROR", "E-CFG-01", "No.", "Do."))
    batches.run(lost("P5"))
    return place, plan, batches


def summarised(cohort: tuple[CohortPlace, Plan, Batches]) -> Summary:
    return write_summary(cohort[0], cohort[1], FLOW)


def rows(place: CohortPlace) -> dict[str, dict[str, str]]:
    text = place.summary.read_bytes().decode("utf-8-sig")
    return {row["id"]: row for row in csv.DictReader(io.StringIO(text, newline=""))}


def test_every_listed_case_has_a_row(cohort: tuple[CohortPlace, Plan, Batches]) -> None:
    found = summarised(cohort)
    told = rows(cohort[0])
    assert {name: row["word"] for name, row in told.items()} == {
        "0012": "PASS",
        "P2": "REVIEW",
        "P3": "REJECTED",
        "P4": "ERROR",
        "P5": "ERROR",
        "P6": "NOT STARTED",
    }
    assert [case.row.case_id for case in found.cases] == sorted(IDS)
    assert (told["P3"]["code"], told["P3"]["problem"], told["P3"]["action"]) == REFUSED
    assert (told["P4"]["code"], told["P4"]["problem"], told["P4"]["action"]) == ("E-CFG-01", "No.", "Do.")
    assert (told["P5"]["code"], told["P5"]["package"], told["P5"]["computing_s"]) == ("E-JOB-03", "", "")
    assert told["P2"]["reasons"] == "The first reason. | The second reason."


def test_a_finished_case_has_its_history_and_its_numbers(cohort: tuple[CohortPlace, Plan, Batches]) -> None:
    place, _, batches = cohort
    batches.start("0012")
    batches.end(CaseEnd("0012", "PASS", seconds=1.26, peak_mb=99.7))
    summarised(cohort)
    first = rows(place)["0012"]
    assert (first["wall_s"], first["peak_mb"], first["attempts"]) == ("1.3", "100", "2")
    assert (first["package"], first["body_part"]) == ("0012/90_package", "LEFT knee")
    assert (place.results / first["package"]).is_dir()
    assert first["host"]
    assert first["finished_at"].startswith("20")
    assert {first[column] for column in NUMBERS.values()} == {"-1.25"}


def test_the_numbers_are_those_of_the_overview() -> None:
    assert list(NUMBERS) == list(cohort_page.COLUMNS)


def test_an_older_request_is_history_and_no_result(cohort: tuple[CohortPlace, Plan, Batches]) -> None:
    place, _, batches = cohort
    old = batches.line("P6", "ended", "node-7", CaseEnd("P6", "PASS", seconds=77.0), key="0" * 16)
    batches.add("P6", old)
    summarised(cohort)
    last = rows(place)["P6"]
    assert (last["word"], last["wall_s"], last["host"], last["attempts"]) == ("NOT STARTED", "77", "node-7", "")


def test_a_failure_of_this_request_is_not_hidden_by_an_older_result(cohort: tuple[CohortPlace, Plan, Batches]) -> None:
    place, _, batches = cohort
    batches.run(refused("0012"))
    summarised(cohort)
    first = rows(place)["0012"]
    assert (first["word"], first["code"], first["package"], first["hysteresis_mm"]) == ("REJECTED", REFUSED[0], "", "")
    assert 'data-case="0012" data-rank="2" data-state="REJECTED"' in (place.results / "index.html").read_text()


def test_results_that_are_gone_are_no_pass(cohort: tuple[CohortPlace, Plan, Batches]) -> None:
    place = cohort[0]
    shutil.rmtree(place.results / "0012")
    assert summarised(cohort).exit_code == ExitCode.ENVIRONMENT
    assert rows(place)["0012"]["word"] == "NOT STARTED"


def test_a_damaged_result_is_no_pass(cohort: tuple[CohortPlace, Plan, Batches]) -> None:
    place = cohort[0]
    (place.results / "0012" / "80_qa" / "verdict.json").write_text("{}")
    assert summarised(cohort).cases[0].unfinished
    assert (rows(place)["0012"]["word"], rows(place)["0012"]["package"]) == ("UNREADABLE", "")


def test_a_case_at_work_is_running(cohort: tuple[CohortPlace, Plan, Batches]) -> None:
    place, _, batches = cohort
    batches.start("P5")
    with case_lock(place.results / "P5"):
        summarised(cohort)
    assert rows(place)["P5"]["word"] == "RUNNING"


def test_the_overview_shows_cases_without_results_and_others_of_the_folder(
    cohort: tuple[CohortPlace, Plan, Batches],
) -> None:
    place = cohort[0]
    write_finished(place.results, "Z9", PASSED)
    summarised(cohort)
    page = (place.results / "index.html").read_text()
    assert page.count("<tr data-case=") + page.count('<tr class="bare" data-case=') == 7
    assert 'data-case="P6" data-rank="5" data-state="NOT STARTED"' in page
    assert "No run of it has begun." in page
    assert "Z9" not in rows(place)


def test_without_a_change_nothing_is_written_again(cohort: tuple[CohortPlace, Plan, Batches]) -> None:
    place = cohort[0]
    summarised(cohort)
    files = [place.summary, place.results / "index.html", place.results / "index.json"]
    before = [(path.stat().st_mtime_ns, path.read_bytes()) for path in files]
    summarised(cohort)
    assert [(path.stat().st_mtime_ns, path.read_bytes()) for path in files] == before
    assert write_overview(Places(place.results, place.results / "index.html"), FLOW).read == 0


def test_pandas_reads_it_and_keeps_the_zeros(cohort: tuple[CohortPlace, Plan, Batches]) -> None:
    pd = pytest.importorskip("pandas")
    place = cohort[0]
    summarised(cohort)
    frame = pd.read_csv(place.summary, dtype={"id": "string"})
    assert frame["id"].tolist() == sorted(IDS)
    assert frame.columns[0] == "id"
    assert frame["hysteresis_mm"].tolist()[:2] == [-1.25, 2.0]
    assert frame["hysteresis_mm"].isna().sum() == 4


def case(name: str, state: cohort_page.State = "PASS", reason: str = "", action: str = "") -> CaseSummary:
    return CaseSummary(CaseRow(name, state, reasons=(reason,) if reason else (), action=action), History(), "")


@pytest.mark.fault("X12")
@pytest.mark.parametrize("sign", ["=", "+", "-", "@", "\t", "\r"])
def test_no_text_is_a_formula_and_negative_numbers_are_numbers(sign: str) -> None:
    row = CaseRow(
        "P1",
        "PASS",
        reasons=(f'{sign}HYPERLINK("http://x")',),
        numbers=(Number("jump_mm", "", "mm", -2.5, over=False),),
    )
    data = summary_csv([CaseSummary(row, History(), "")])
    _, only = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""))
    assert not [text for text in only if text.startswith(("=", "+", "@", "\t", "\r"))]
    assert [text for text in only if text.startswith("-")] == ["-2.5"]
    assert any(text.startswith("'") and "HYPERLINK" in text for text in only)


def test_the_table_is_what_rfc_4180_says() -> None:
    reason = 'E-X-01  Quote " comma , line\nbreak \x1b[0m é'
    data = summary_csv([case("P1", "REJECTED", reason), case("P2")])
    assert data.startswith(b"\xef\xbb\xbfid,word,code,")
    assert data.count(b"\r\n") == 3
    assert data.count(b"\n") == 3
    assert b'"Quote "" comma , line\\nbreak \\x1b[0m \xc3\xa9"' in data


def summary_of(cases: Sequence[CaseSummary]) -> Summary:
    return Summary(tuple(cases), Path("r/cohort.csv"), Path("r/index.html"))


def machine(name: str) -> CaseSummary:
    row = CaseRow(name, "ERROR", reasons=("E-JOB-03  Its process was killed.",))
    return CaseSummary(row, History(lost(name), 3), "")


@pytest.mark.parametrize(
    ("cases", "code"),
    [
        ([], 0),
        ([case("P1"), case("P2")], 0),
        ([case("P1"), case("P2", "REVIEW")], 11),
        ([case("P1", "REVIEW"), case("P2", "REJECTED", "E-X-01  No.")], 10),
        ([case("P1", "REVIEW"), case("P2", "ERROR", "E-BUG-01  No.")], 10),
        ([case("P1", "REJECTED", "E-X-01  No."), machine("P2")], 30),
        ([case("P1", "ERROR", "E-ENV-02  No.")], 30),
        ([case("P1", "NOT STARTED")], 30),
        ([case("P1", "NOT FINISHED")], 30),
        ([case("P1", "UNREADABLE")], 30),
        ([case("P1", "RUNNING")], 30),
    ],
)
def test_the_exit_code_is_that_of_the_worst_case(cases: list[CaseSummary], code: int) -> None:
    assert summary_of(cases).exit_code == code


def test_the_last_lines_group_failures_by_their_reason() -> None:
    refusals = [case(f"P{n}", "REJECTED", "E-SIDE-01  The side is not given.", "Add it.") for n in range(7)]
    others = [case("Q1"), case("Q2", "REVIEW"), case("Q3", "ERROR", "E-BUG-01  Oh."), case("Q4", "NOT STARTED", "Why.")]
    assert summary_lines(summary_of([*refusals, *others])) == [
        "2 of 11 cases have a table (1 PASS, 1 REVIEW), 8 failed, 1 without a result",
        "    7 x E-SIDE-01  The side is not given.",
        "        Add it.",
        "        P0 P1 P2 P3 P4 and 2 more",
        "    1 x E-BUG-01  Oh.",
        "        Q3",
        "    1 x NOT STARTED  Why.",
        "        Q4",
        "table: r/cohort.csv",
        "page: r/index.html",
    ]
    assert summary_lines(summary_of([case("P1")]))[0] == "1 of 1 cases have a table (1 PASS, 0 REVIEW)"


def test_what_failed_or_is_gone_is_tried_again(cohort: tuple[CohortPlace, Plan, Batches], tmp_path: Path) -> None:
    place = cohort[0]
    assert failed_ids(place) == {"P3", "P4", "P5"}
    shutil.rmtree(place.results / "0012")
    assert failed_ids(place) == {"0012", "P3", "P4", "P5"}
    assert failed_ids(CohortPlace(tmp_path / "nowhere")) == frozenset()


def test_after_it_was_asked_for_again_a_failure_is_of_an_older_request(
    cohort: tuple[CohortPlace, Plan, Batches], tmp_path: Path
) -> None:
    place, plan, _ = cohort
    cases = tuple(ListedCase(name, tmp_path / "cases" / name) for name in IDS)
    again = write_plan(place, PlanInputs(plan.request, plan.key, cases, "ct2lut", retry=frozenset({"P4"})))
    found = write_summary(place, again, FLOW)
    assert {one.row.case_id: one.row.state for one in found.cases}["P4"] == "NOT STARTED"


def test_a_ledger_that_cannot_be_read_takes_no_result_away(
    cohort: tuple[CohortPlace, Plan, Batches], monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(path: Path) -> bytes:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(product, "read_file", failing)
    words = [one.row.state for one in summarised(cohort).cases]
    assert words == ["PASS", "REVIEW", "REJECTED", "NOT STARTED", "NOT FINISHED", "NOT STARTED"]
