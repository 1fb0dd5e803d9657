"""Tasks over processes: order kept, results independent of their number, failures brought home whole."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from pipeline.adapters.workers import map_in_order
from pipeline.errors import CaseRejected, EnvironmentFault
from tests.adapters.worker_tasks import die, prepare, refuse, reject, square

TASKS = [3, 1, 2, 5, 4]
SQUARES = [9, 1, 4, 25, 16]


@pytest.mark.parametrize(("tasks", "jobs"), [(TASKS, 1), (TASKS[:1], 8), ([], 4)])
def test_one_job_or_one_task_needs_no_process(tasks: list[int], jobs: int) -> None:
    finished: list[int] = []
    results = map_in_order(square, tasks, jobs, finished.append, prepare)
    assert results == [(value, os.getpid(), False) for value in SQUARES[: len(tasks)]]
    assert finished == list(range(len(tasks)))


def test_two_jobs_give_the_same_results_in_the_same_order_from_prepared_workers() -> None:
    finished: list[int] = []
    results = map_in_order(square, TASKS, 2, finished.append, prepare)
    assert [value for value, _, _ in results] == SQUARES
    assert sorted(finished) == [0, 1, 2, 3, 4]
    assert os.getpid() not in {process for _, process, _ in results}
    assert all(prepared for _, _, prepared in results)


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_fails_in_a_worker_reaches_the_caller(jobs: int) -> None:
    with pytest.raises(ValueError, match="task 2 cannot be done"):
        map_in_order(refuse, [0, 1, 2, 3], jobs)


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_failure_that_we_understand_comes_home_whole(jobs: int) -> None:
    with pytest.raises(CaseRejected, match=r"E-ABC-01 Task \d is wrong\. Correct it\.") as caught:
        map_in_order(reject, [1, 1], jobs)
    assert (caught.value.code, caught.value.problem, caught.value.action) == (
        "E-ABC-01",
        "Task 1 is wrong.",
        "Correct it.",
    )


def test_a_worker_that_dies_is_the_machines_fault() -> None:
    with pytest.raises(EnvironmentFault, match=r"E-ENV-30 A worker process ended .* fewer workers"):
        map_in_order(die, [1, 2, 3], 2)


def test_workers_end_with_a_run_that_is_killed(tmp_path: Path) -> None:
    """They would hold hundreds of megabytes, and wait for tasks that never come."""
    program = [sys.executable, "-P", "-c", "from tests.adapters.worker_tasks import two_that_linger; two_that_linger()"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "LINGER": str(tmp_path)}
    with subprocess.Popen(program, env=environment, start_new_session=True) as run:
        try:
            pids = when(lambda: [int(path.name) for path in tmp_path.iterdir()], lambda found: len(found) == 2)
            run.kill()
            gone = when(lambda: [pid for pid in pids if Path(f"/proc/{pid}/cmdline").exists()], lambda left: not left)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(run.pid, signal.SIGKILL)
    assert gone == []


def when(look: Callable[[], list[int]], enough: Callable[[list[int]], bool]) -> list[int]:
    """What is seen when it is enough, or after a minute."""
    until = time.monotonic() + 60
    while not enough(found := look()) and time.monotonic() < until:
        time.sleep(0.05)
    return found
