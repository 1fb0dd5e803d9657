from __future__ import annotations

import errno
import fcntl
import os
import re
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipeline.engine.inspection import verify_case
from pipeline.engine.lock import case_lock, is_running
from pipeline.engine.outcome import CaseJob
from pipeline.engine.stage import Findings, Inputs, Outputs
from pipeline.errors import EnvironmentFault, ExitCode
from tests.engine.crash_tools import in_child, wait
from tests.engine.toy_flow import FLOW, GATHER, MULTIPLY, TOTAL, artifact_bytes, gather, leftovers, make_case, run


@pytest.fixture
def job(tmp_path: Path) -> CaseJob:
    return make_case(tmp_path)


def test_a_second_run_of_a_case_is_refused_at_once_and_the_first_ends_well(job: CaseJob) -> None:
    inside, let_in = os.pipe()
    proceed, let_go = os.pipe()

    def slow(reads: Inputs, params: Any, out: Outputs) -> Findings:
        os.write(let_in, b"x")
        os.read(proceed, 1)
        return gather(reads, params, out)

    def first() -> None:
        assert run(job, (replace(GATHER, run=slow), MULTIPLY, TOTAL))[0].word == "PASS"

    child = in_child(first)
    os.read(inside, 1)
    outcome, _ = run(job)
    assert (outcome.exit_code, outcome.code) == (ExitCode.ENVIRONMENT, "E-LOCK-01")
    pattern = rf"Case P1 is already running since \d{{4}}-\d\d-\d\d \d\d:\d\d:\d\d UTC on \S+ \(pid {child}\)\."
    assert re.fullmatch(pattern, str(outcome.problem))
    os.write(let_go, b"x")
    assert wait(child) == 0
    assert verify_case(job.results, FLOW) == ()
    for descriptor in (inside, let_in, proceed, let_go):
        os.close(descriptor)


def test_a_killed_run_leaves_no_lock_even_while_its_worker_lives(tmp_path: Path) -> None:
    read, write = os.pipe()

    def holder() -> None:
        with case_lock(tmp_path):
            worker = in_child(signal.pause)
            os.write(write, worker.to_bytes(8, "little"))
            signal.pause()

    child = in_child(holder)
    worker = int.from_bytes(os.read(read, 8), "little")
    assert is_running(tmp_path)
    os.kill(child, signal.SIGKILL)
    wait(child)
    try:
        with case_lock(tmp_path) as alone:
            assert alone
    finally:
        os.kill(worker, signal.SIGKILL)
        os.close(read)
        os.close(write)


def test_the_lock_file_stays_and_holds_nothing_up(tmp_path: Path) -> None:
    for _ in range(2):
        with case_lock(tmp_path):
            assert is_running(tmp_path)
        assert not is_running(tmp_path)
    assert (tmp_path / ".lock").is_file()


def test_somebody_who_only_looks_holds_nobody_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a cohort's progress does, many times while its cases begin."""
    looks = [True, True]
    flock = fcntl.flock

    def busy(descriptor: int, operation: int) -> None:
        if operation & fcntl.LOCK_EX and looks:
            looks.pop()
            raise BlockingIOError(errno.EWOULDBLOCK, "somebody looks")
        flock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", busy)
    with case_lock(tmp_path) as alone:
        assert alone
    assert looks == []


@pytest.mark.parametrize("kind", ["link", "folder"])
def test_something_else_in_the_place_of_the_lock_is_refused(tmp_path: Path, kind: str) -> None:
    if kind == "link":
        (tmp_path / ".lock").symlink_to(tmp_path / "victim")
    else:
        (tmp_path / ".lock").mkdir()
    with (
        pytest.raises(EnvironmentFault, match=r"E-ENV-03 Opening the results folder .* failed"),
        case_lock(tmp_path),
    ):
        pass
    assert not (tmp_path / "victim").exists()


def without_locks(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(descriptor: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, "no locks")

    monkeypatch.setattr(fcntl, "flock", refuse)


def test_without_locks_runs_may_hinder_each_other_loudly_and_never_leave_a_wrong_result(
    tmp_path: Path, job: CaseJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_locks(monkeypatch)
    alone = make_case(tmp_path / "alone")
    run(alone)

    def work() -> None:
        assert run(job)[0].exit_code in {ExitCode.PASS, ExitCode.ENVIRONMENT}

    for _ in range(5):
        children = [in_child(work) for _ in range(4)]
        assert [wait(child) for child in children] == [0] * 4
        assert run(job)[0].word == "PASS"
        assert verify_case(job.results, FLOW) == ()
        assert artifact_bytes(job.results) == artifact_bytes(alone.results)
        for stage in FLOW:
            (job.results / stage.folder).rename(tmp_path / f"done-{os.urandom(4).hex()}")
    monkeypatch.undo()
    run(job)
    assert [name for name in leftovers(job.results) if not name.startswith(".quarantine-")] == []
