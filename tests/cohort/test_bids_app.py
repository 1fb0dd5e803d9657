"""The BIDS-App call: cases one by one, a refusal is a result, the group's summary; the processes are played."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline import cli
from pipeline.cohort import case_process
from pipeline.cohort.bids import app as bids_app
from pipeline.cohort.bids.app import run_participants, summarise_group
from pipeline.cohort.bids.call import parse_bids_call
from pipeline.cohort.case_process import CaseWork
from pipeline.cohort.ledger import Ledger
from pipeline.cohort.model import CaseEnd, ListedCase
from pipeline.engine.outcome import load_record
from pipeline.errors import ExitCode
from tests.cohort.bids_samples import empty_dataset
from tests.toy_flow import TOY_FLOW

BOTH = ("sub-01/ct/sub-01_ct.nii.gz", "sub-02/ct/sub-02_ct.nii.gz", "sub-02/ct/sub-02_acq-b_ct.nii.gz")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[ListedCase, CaseWork]]:
    """Subject 01 with a CT and 02 with two; gives the cases that a process was started for, which grow."""
    empty_dataset(tmp_path / "in", *BOTH)
    ran: list[tuple[ListedCase, CaseWork]] = []

    def run_listed(case: ListedCase, work: CaseWork, ledger: Ledger, key: str) -> CaseEnd:
        ran.append((case, work))
        ledger.started(case.case_id, key)
        ledger.ended(end := CaseEnd(case.case_id, "ERROR", "E-JOB-04", "It crashed.", "Run it alone.", 7.0), key)
        return end

    monkeypatch.setattr(bids_app, "run_listed", run_listed)
    monkeypatch.chdir(tmp_path)
    return ran


def test_a_case_that_cannot_be_prepared_is_a_result(site: list[tuple[ListedCase, CaseWork]]) -> None:
    said: list[str] = []
    call = parse_bids_call(["in", "out", "participant", "--set", "qa.word=x", "--mem-mb", "900", "--jobs", "2"])
    assert run_participants(call, ("ct2lut",), TOY_FLOW, said.append) == ExitCode.REJECTED
    assert [line.split()[:3] for line in said] == [["[1/2]", "sub-01", "ERROR"], ["[2/2]", "sub-02", "REJECTED"]]
    (case, work), *more = site
    assert (case.case_id, case.folder, more) == ("sub-01", Path("out/.cases/sub-01").resolve(), [])
    assert (work.request.overrides, work.request.limits.memory_mb, work.request.jobs) == (("qa.word=x",), 900, 2)
    last = load_record(Path("out/sub-02"))
    assert last is not None
    assert last.outcome is not None
    assert last.outcome.code == "E-BID-12"


def test_only_the_subjects_that_are_named(site: list[tuple[ListedCase, CaseWork]]) -> None:
    call = parse_bids_call(["in", "out", "participant", "--participant-label", "sub-01"])
    run_participants(call, ("ct2lut",), TOY_FLOW, lambda _: None)
    assert [case.case_id for case, _ in site] == ["sub-01"]
    assert not Path("out/sub-02").exists()


def test_the_group_has_every_case_of_the_dataset(site: list[tuple[ListedCase, CaseWork]]) -> None:
    run_participants(parse_bids_call(["in", "out", "participant"]), ("ct2lut",), TOY_FLOW, lambda _: None)
    summary = summarise_group(parse_bids_call(["in", "out", "group"]), TOY_FLOW)
    rows = Path("out/cohort.csv").read_text(encoding="utf-8-sig").splitlines()[1:]
    assert [row.split(",")[:3] for row in rows] == [["sub-01", "ERROR", "E-JOB-04"], ["sub-02", "REJECTED", "E-BID-12"]]
    assert Path("out/index.html").is_file()
    assert summary.exit_code == ExitCode.REJECTED


def test_the_command_line_knows_a_bids_call(
    site: list[tuple[ListedCase, CaseWork]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli.shared, "flow", lambda: TOY_FLOW)
    assert cli.execute(["in", "out", "participant", "--participant-label", "01"]) == ExitCode.REJECTED
    assert site[0][1].program == case_process.program()
    assert "E-JOB-04  It crashed." in capsys.readouterr().out
    assert cli.execute(["in", "out", "participant", "--participant-label", "09"]) == ExitCode.USAGE
    assert "E-BID-" in capsys.readouterr().err
    assert cli.execute(["in", "out", "group", "--version"]) == ExitCode.PASS
    assert capsys.readouterr().out.startswith("ct2lut ")
    assert cli.execute(["compare", "in", "group"]) == ExitCode.USAGE
    assert "E-CMP-01" in capsys.readouterr().err
