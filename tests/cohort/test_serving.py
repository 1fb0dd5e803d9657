"""What a watched folder does with a case that is complete; its process is played."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from pipeline.cohort.case_process import CaseWork
from pipeline.cohort.ledger import Ledger, events
from pipeline.cohort.model import CaseEnd, CohortRequest, ListedCase
from pipeline.cohort.place import CohortPlace
from pipeline.cohort.watching import serving
from pipeline.cohort.watching.serving import server
from pipeline.commands.cohort_index import Places
from pipeline.engine.stage import Stage
from pipeline.engine.store import make_folder
from pipeline.errors import EnvironmentFault
from tests.cohort.cohort_sample import planned
from tests.toy_flow import TOY_FLOW

END = CaseEnd("P1", "REJECTED", "E-IO-03", "It holds no files.", "Put some there.", 1.0)


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CaseWork:
    def run_listed(case: ListedCase, work: CaseWork, ledger: Ledger, key: str) -> CaseEnd:
        ledger.started(case.case_id, key)
        make_folder(work.results / case.case_id)
        ledger.ended(END, key)
        return END

    monkeypatch.setattr(serving, "run_listed", run_listed)
    make_folder(tmp_path / "results")
    return CaseWork(tmp_path / "results", CohortRequest(str(tmp_path / "cases"), "demo"), ("ct2lut",))


def test_a_case_has_its_history_and_a_line_in_the_overview(work: CaseWork, tmp_path: Path) -> None:
    assert server(work, TOY_FLOW)(ListedCase("P1", tmp_path / "cases" / "P1")) == END
    told = list(events(CohortPlace(work.results).ledger("P1").read_bytes()))
    assert [(event.id, event.what, event.end) for event in told] == [("P1", "started", None), ("P1", "ended", END)]
    assert "P1" in (work.results / "index.html").read_text()


def test_an_overview_that_cannot_be_written_costs_no_result(work: CaseWork, tmp_path: Path) -> None:
    (work.results / "index.html").mkdir()
    assert server(work, TOY_FLOW)(ListedCase("P1", tmp_path / "cases" / "P1")) == END


def test_a_history_that_cannot_be_written_is_a_fault_of_the_machine(work: CaseWork, tmp_path: Path) -> None:
    (work.results / "cohort.files").write_text("in the way")
    with pytest.raises(EnvironmentFault, match="Beginning a case failed"):
        server(work, TOY_FLOW)(ListedCase("P1", tmp_path / "cases" / "P1"))


def test_where_the_overview_takes_long_it_is_not_written_after_each_case(
    work: CaseWork, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]
    written: list[float] = []

    def write_overview(places: Places, flow: Sequence[Stage]) -> None:
        written.append(clock[0])
        clock[0] += 10.0

    monkeypatch.setattr(serving, "write_overview", write_overview)
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    run = server(work, TOY_FLOW)
    for _ in range(5):
        run(ListedCase("P1", tmp_path / "cases" / "P1"))
        clock[0] += 90.0
    assert written == [0.0, 280.0]


def test_the_overview_of_a_cohort_keeps_the_cases_without_results(work: CaseWork, tmp_path: Path) -> None:
    planned(tmp_path, ["P1", "P2"])
    server(work, TOY_FLOW)(ListedCase("P1", tmp_path / "cases" / "P1"))
    assert "NOT STARTED" in (work.results / "index.html").read_text()
