from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.engine.inspection import PlanRow, plan_case, read_status, verify_case
from pipeline.engine.lock import case_lock
from pipeline.engine.outcome import CaseJob, RunRecord, save_record
from pipeline.engine.records import record_artifact
from pipeline.errors import CaseRejected
from tests.engine.toy_flow import DEFAULTS, FLOW, GatherParams, MultiplyParams, SumParams, make_case, run


@pytest.fixture
def job(tmp_path: Path) -> CaseJob:
    return make_case(tmp_path)


def test_a_plan_changes_nothing_on_disk(job: CaseJob) -> None:
    assert [row.reason for row in plan_case(job, FLOW, DEFAULTS)] == ["no result yet"] * 3
    assert not job.results.exists()


def test_a_stage_behind_one_that_runs_is_planned_for_its_own_reason_or_that_one(job: CaseJob) -> None:
    run(job)
    settings = {**DEFAULTS, "gather": GatherParams(keep=2), "total": SumParams(title="t")}
    assert plan_case(job, FLOW, settings) == (
        PlanRow("gather", "run", "setting keep 5 -> 2"),
        PlanRow("multiply", "run", "10_gather may change"),
        PlanRow("total", "run", 'setting title "sum" -> "t"'),
    )


def test_what_stands_before_a_change_is_skipped(job: CaseJob) -> None:
    run(job)
    settings = {**DEFAULTS, "multiply": MultiplyParams(factor=9.0)}
    plan = plan_case(job, FLOW, settings)
    assert [row.action for row in plan] == ["skip", "run", "run"]
    outcome, _ = run(job, settings=settings)
    assert [stage.state for stage in outcome.stages] == ["cached", "ran", "ran"]


def test_a_case_that_is_not_there_cannot_be_planned(job: CaseJob) -> None:
    shutil.rmtree(job.source)
    with pytest.raises(CaseRejected, match=r"E-IO-03 The case folder of P1 does not exist\."):
        plan_case(job, FLOW, DEFAULTS)


def test_verify_finds_stages_that_do_not_belong_together(job: CaseJob) -> None:
    assert verify_case(job.results, FLOW) == ()
    run(job)
    assert verify_case(job.results, FLOW) == ()
    run(job, FLOW[:1], {"gather": GatherParams(keep=1)})
    assert verify_case(job.results, FLOW) == ("20_multiply: made from another numbers than the one that is there now",)


def test_verify_says_when_another_version_made_a_result(job: CaseJob) -> None:
    """A later version of the program leaves one more file."""
    run(job)
    later = replace(FLOW[0], writes=(*FLOW[0].writes, record_artifact("more", "more.json", int)))
    problem = "10_gather: made by another version of the program (no more)"
    assert verify_case(job.results, (later, *FLOW[1:])) == (problem,)


def test_verify_names_a_damaged_record(job: CaseJob) -> None:
    run(job)
    (job.results / "10_gather" / "stage.json").write_text("{}")
    assert verify_case(job.results, FLOW) == ("10_gather: record stage.json altered on disk",)


def test_status_of_a_case_never_run_running_killed_and_finished(job: CaseJob) -> None:
    status = read_status(job.results, FLOW)
    assert (status.state, status.last, [stage.state for stage in status.stages]) == ("never", None, ["absent"] * 3)
    outcome, _ = run(job)
    status = read_status(job.results, FLOW)
    assert (status.state, status.last) == ("finished", outcome)
    assert [stage.state for stage in status.stages] == ["done"] * 3
    assert status.stages[1].findings == outcome.stages[1].findings
    with case_lock(job.results):
        assert read_status(job.results, FLOW).state == "running"
    save_record(job.results, RunRecord("running", None))
    assert read_status(job.results, FLOW).state == "interrupted"
    (job.results / "30_total" / "stage.json").write_text("")
    assert read_status(job.results, FLOW).stages[2].state == "damaged"
