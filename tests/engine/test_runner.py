from __future__ import annotations

import errno
import json
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipeline.engine.artifacts import SOURCE
from pipeline.engine.outcome import CaseJob, load_record
from pipeline.engine.records import record_artifact
from pipeline.engine.stage import Findings, Inputs, Outputs, Stage, StrictParams
from pipeline.errors import ConfigError, EnvironmentFault, ExitCode
from tests.engine.toy_flow import (
    FLOW,
    GATHER,
    MULTIPLES,
    MULTIPLY,
    NUMBERS,
    TOTAL,
    GatherParams,
    MultiplyParams,
    artifact_bytes,
    leftovers,
    make_case,
    reasons,
    run,
    states,
)

Body = Callable[[Inputs, Any, Outputs], Findings]


@pytest.fixture
def job(tmp_path: Path) -> CaseJob:
    return make_case(tmp_path)


def flow_with(body: Body) -> tuple[Stage, ...]:
    return (GATHER, replace(MULTIPLY, run=body), TOTAL)


def log_lines(job: CaseJob) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (job.results / "log.jsonl").read_text().splitlines()]


def test_a_first_run_computes_all_and_a_second_nothing(job: CaseJob) -> None:
    first, recorder = run(job)
    assert (first.word, first.exit_code, first.code) == ("PASS", ExitCode.PASS, None)
    assert states(first) == ["ran"] * 3
    assert set(reasons(first).values()) == {"no result yet"}
    assert recorder.started[1] == ("multiply", 2, 3, "no result yet")
    assert recorder.progress == [("multiply", 3, 3)]

    before = artifact_bytes(job.results)
    second, recorder = run(job)
    assert states(second) == ["cached"] * 3
    assert set(reasons(second).values()) == {"up to date"}
    assert recorder.started == []
    assert artifact_bytes(job.results) == before
    assert [stage.findings for stage in second.stages] == [stage.findings for stage in first.stages]


def test_a_stage_tells_how_long_its_parts_took_and_later_runs_know(job: CaseJob) -> None:
    first, _ = run(job)
    assert list(first.stages[1].parts) == ["multiplying"]
    assert 0.004 <= first.stages[1].parts["multiplying"] <= first.stages[1].computing_s <= first.stages[1].seconds
    assert first.stages[0].parts == {}
    second, _ = run(job)
    assert [(one.computing_s, one.parts) for one in second.stages] == [
        (one.computing_s, one.parts) for one in first.stages
    ]
    record = load_record(job.results)
    assert record is not None
    assert record.outcome == second


def test_the_results_lie_where_the_design_says(job: CaseJob) -> None:
    run(job)
    names = {path.relative_to(job.results).as_posix() for path in job.results.rglob("*") if path.is_file()}
    assert names == {
        ".lock",
        "log.jsonl",
        "run.json",
        *(
            f"{folder}/{name}"
            for folder in ("10_gather", "20_multiply", "30_total")
            for name in ("stage.json", "findings.json", "settings.json")
        ),
        "10_gather/numbers.json",
        "20_multiply/multiples.json",
        "20_multiply/parts/0/value.txt",
        "20_multiply/parts/1/value.txt",
        "30_total/summary.txt",
        "30_total/images/0.txt",
    }


def test_the_same_inputs_give_the_same_bytes_anywhere(tmp_path: Path) -> None:
    jobs = [make_case(tmp_path / name) for name in ("one", "two")]
    for job in jobs:
        run(job)
    assert artifact_bytes(jobs[0].results) == artifact_bytes(jobs[1].results)


def test_a_stage_that_writes_the_same_bytes_stops_the_cascade(job: CaseJob) -> None:
    run(job)
    (job.source / "notes.txt").write_text("the case folder changed, the numbers did not")
    outcome, _ = run(job)
    assert states(outcome) == ["ran", "cached", "cached"]
    outcome, _ = run(job, settings={"gather": GatherParams(keep=4)})
    assert states(outcome) == ["ran", "cached", "cached"]


def test_modification_times_mean_nothing(job: CaseJob) -> None:
    run(job)
    for path in job.results.rglob("*"):
        os.utime(path, (1, 1))
    os.utime(job.source / "numbers.txt", (2**33, 2**33))
    assert states(run(job)[0]) == ["cached"] * 3


def test_a_finding_to_review_makes_the_word_also_from_the_cache(job: CaseJob) -> None:
    settings = {"multiply": MultiplyParams(factor=1000.0)}
    for state in ("ran", "cached"):
        outcome, _ = run(job, settings=settings)
        assert (outcome.word, outcome.exit_code) == ("REVIEW", ExitCode.REVIEW)
        assert outcome.stages[1].state == state
        assert outcome.stages[1].findings[1].code == "W-TOY-01"


def test_a_rejected_case_keeps_its_earlier_results(job: CaseJob) -> None:
    run(job)
    before = artifact_bytes(job.results)
    (job.source / "numbers.txt").write_text("one")
    outcome, recorder = run(job)
    assert (outcome.word, outcome.exit_code, outcome.code) == ("REJECTED", ExitCode.REJECTED, "E-TOY-01")
    assert states(outcome) == ["failed", "not reached", "not reached"]
    assert recorder.finished[-1].reason == "E-TOY-01"
    assert artifact_bytes(job.results) == before
    record = load_record(job.results)
    assert record is not None
    assert record.outcome == outcome


@pytest.mark.parametrize(
    ("error", "exit_code", "code"),
    [
        (ConfigError("E-CFG-09", "wrong.", "right it."), ExitCode.USAGE, "E-CFG-09"),
        (EnvironmentFault("E-ENV-09", "no renderer.", "install it."), ExitCode.ENVIRONMENT, "E-ENV-09"),
        (OSError(errno.ENOSPC, "full", "/secret"), ExitCode.ENVIRONMENT, "E-ENV-01"),
        (MemoryError(), ExitCode.ENVIRONMENT, "E-ENV-04"),
        (FileNotFoundError(errno.ENOENT, "gone", "/secret"), ExitCode.ERROR, "E-BUG-01"),
        (ValueError("bad"), ExitCode.ERROR, "E-BUG-01"),
        (SystemExit(0), ExitCode.ERROR, "E-BUG-01"),
    ],
)
def test_every_failure_has_its_exit_code(job: CaseJob, error: BaseException, exit_code: ExitCode, code: str) -> None:
    def fail(reads: Inputs, params: Any, out: Outputs) -> Findings:
        raise error

    outcome, _ = run(job, flow_with(fail))
    assert (outcome.word, outcome.exit_code, outcome.code) == ("ERROR", exit_code, code)
    assert outcome.problem
    assert "secret" not in outcome.problem
    assert outcome.action
    assert states(outcome) == ["ran", "failed", "not reached"]


def test_a_bug_leaves_its_traceback_in_the_log_without_what_it_quotes(job: CaseJob) -> None:
    def fail(reads: Inputs, params: Any, out: Outputs) -> Findings:
        float("DOE^JOHN")
        return ()

    outcome, _ = run(job, flow_with(fail))
    number = str(outcome.problem).partition("error id ")[2][:8]
    (line,) = [line for line in log_lines(job) if number in line["msg"] and "could not convert" in line["msg"]]
    assert "ValueError: could not convert string to float: …" in line["msg"]
    assert f"engine/{Path(__file__).name}:" in line["msg"]
    assert (line["stage"], line["code"], line["id"]) == ("multiply", "E-BUG-01", "P1")
    for path in job.results.rglob("*"):
        assert path.is_dir() or b"DOE" not in path.read_bytes()
    assert number in str(run(job, flow_with(fail))[0].problem), "the same bug keeps its number"


def test_an_interrupt_is_recorded_and_leaves_nothing_half_made(job: CaseJob) -> None:
    def interrupted(reads: Inputs, params: Any, out: Outputs) -> Findings:
        raise KeyboardInterrupt

    run(job)
    before = artifact_bytes(job.results)
    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        run(job, flow_with(interrupted), {"multiply": MultiplyParams(factor=4.0)})
    record = load_record(job.results)
    assert record is not None
    assert record.state == "interrupted"
    assert artifact_bytes(job.results) == before
    assert leftovers(job.results) == []


def test_reading_what_is_not_declared_names_the_stage(job: CaseJob) -> None:
    def greedy(reads: Inputs, params: Any, out: Outputs) -> Findings:
        with pytest.raises(KeyError, match="stage multiply does not declare source in reads"):
            reads[SOURCE]
        with pytest.raises(KeyError, match="stage multiply does not declare numbers in writes"):
            out[NUMBERS] = (1,)
        out[MULTIPLES] = (1.0,)
        return ()

    outcome, _ = run(job, flow_with(greedy))
    assert outcome.code == "E-BUG-01"
    assert any("RuntimeError: stage multiply did not write parts" in line["msg"] for line in log_lines(job))


@pytest.mark.parametrize("name", ["../escape.txt", "/abs.txt", "stage.json", ".hidden", "a//b", "a/../b", "a\nb", ""])
def test_a_folder_artifact_cannot_leave_its_folder(job: CaseJob, name: str) -> None:
    def hostile(reads: Inputs, params: Any, out: Outputs) -> Findings:
        out[TOTAL.writes[0]] = {name: b"x"}
        return ()

    outcome, _ = run(job, (GATHER, MULTIPLY, replace(TOTAL, run=hostile)))
    assert outcome.code == "E-BUG-01"
    assert not (job.results / "30_total").exists()
    assert not (job.results / "escape.txt").exists()


def test_two_artifacts_cannot_share_a_file(job: CaseJob) -> None:
    def clash(reads: Inputs, params: Any, out: Outputs) -> Findings:
        out[TOTAL.writes[0]] = {"findings.json": b"x"}
        return ()

    run(job, (GATHER, MULTIPLY, replace(TOTAL, run=clash)))
    assert any("stage total writes findings.json twice" in line["msg"] for line in log_lines(job))


def test_results_inside_the_case_folder_are_refused(job: CaseJob) -> None:
    for results in (job.source / "results", job.source, job.source.parent):
        outcome, _ = run(replace(job, results=results))
        assert (outcome.exit_code, outcome.code) == (ExitCode.USAGE, "E-RES-01")
    assert [path.name for path in job.source.iterdir()] == ["numbers.txt"]


def test_results_that_cannot_be_made_are_an_environment_fault(job: CaseJob, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    outcome, _ = run(replace(job, results=tmp_path / "file" / "P1"))
    assert (outcome.exit_code, outcome.code) == (ExitCode.ENVIRONMENT, "E-ENV-03")
    assert str(tmp_path) not in f"{outcome.problem}{outcome.action}"


def test_a_flow_that_cannot_run_is_refused(job: CaseJob) -> None:
    with pytest.raises(ValueError, match="stage total reads multiples"):
        run(job, (GATHER, TOTAL))
    with pytest.raises(ValueError, match="numbers is written twice"):
        run(job, (GATHER, replace(GATHER, number=20, name="again")))
    with pytest.raises(ValueError, match="numbers must increase"):
        run(job, (GATHER, replace(MULTIPLY, number=10), TOTAL))


def test_a_result_altered_during_the_run_is_noticed(job: CaseJob) -> None:
    def vandal(reads: Inputs, params: Any, out: Outputs) -> Findings:
        (job.results / "10_gather" / "numbers.json").write_text("[9]")
        reads[NUMBERS]
        return ()

    outcome, _ = run(job, flow_with(vandal))
    assert outcome.code == "E-ENV-05"
    assert "10_gather/numbers.json" in str(outcome.problem)


def test_the_log_holds_one_object_a_line_also_after_a_torn_one(job: CaseJob) -> None:
    run(job)
    with (job.results / "log.jsonl").open("a") as stream:
        stream.write('{"ts": "torn')
    run(job)
    lines = (job.results / "log.jsonl").read_text().splitlines()
    assert sum(line == '{"ts": "torn' for line in lines) == 1
    good = [json.loads(line) for line in lines if not line.endswith("torn")]
    assert all(set(line) == {"ts", "id", "stage", "level", "code", "msg", "seconds"} for line in good)
    assert good[-1]["msg"] == "PASS"


def test_a_cached_run_of_eight_stages_is_fast(job: CaseJob) -> None:
    flow: list[Stage] = [GATHER]
    for index in range(2, 9):
        before, after = flow[-1].writes[0], record_artifact(f"step{index}", "step.json", tuple[int, ...])

        def step(reads: Inputs, params: Any, out: Outputs, before: Any = before, after: Any = after) -> Findings:
            out[after] = reads[before]
            return ()

        flow.append(Stage(10 * index, f"step{index}", (before,), (after,), StrictParams, step))
    settings = {stage.name: stage.Params() for stage in flow}
    assert states(run(job, flow, settings)[0]) == ["ran"] * 8
    start = time.perf_counter()
    assert states(run(job, flow, settings)[0]) == ["cached"] * 8
    assert time.perf_counter() - start < 0.5


def test_files_and_folders_have_their_permissions_at_any_umask(tmp_path: Path) -> None:
    for umask in (0o000, 0o022, 0o077):
        job = make_case(tmp_path / oct(umask))
        before = os.umask(umask)
        try:
            run(job)
        finally:
            os.umask(before)
        modes = {path.stat().st_mode & 0o777 for path in job.results.rglob("*") if path.is_file()}
        folders = {path.stat().st_mode & 0o777 for path in [job.results, *job.results.rglob("*")] if path.is_dir()}
        assert folders == {0o750}
        assert modes == {0o640}


def test_flow_is_as_the_tests_believe() -> None:
    assert [stage.folder for stage in FLOW] == ["10_gather", "20_multiply", "30_total"]
