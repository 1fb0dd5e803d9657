"""A small cohort by the real command, the real engine and real runs, killed once: nothing lost, nothing done twice."""

from __future__ import annotations

import os
import re
import signal
import subprocess
from pathlib import Path

import pytest

import pipeline
from pipeline.cohort.ledger import Ledger
from tests.cohort.checks import problems_of
from tests.cohort.cohort_cases import CohortCases
from tests.cohort.figures import case_spans, repeats
from tests.cohort.marked_processes import VARIABLE
from tests.cohort.real import FASTER, KILLS, Order, Trial, run

ENGINE = Path(pipeline.__file__).parents[1] / ".venv-cohort/bin/snakemake"

needs_engine = pytest.mark.skipif(not ENGINE.exists(), reason="no workflow engine here; type: make setup-cohort")

#: What the last kill, of every process, leaves to the second call.
EVERYTHING = 2


def test_everything_is_killed_only_while_a_case_is_at_work(tmp_path: Path) -> None:
    trial, how = Trial(Order(CohortCases(2, 0), kills=1, work=tmp_path)), KILLS[EVERYTHING][1]
    ledger = Ledger(trial.order.place.ledger("b0"))
    ledger.path.parent.mkdir(parents=True)
    with subprocess.Popen(["sleep", "10"], env={**os.environ, VARIABLE: trial.mark}) as process:
        assert not how(trial, process.pid)
        assert process.poll() is None
        ledger.started("P1", "key")
        assert how(trial, process.pid)
    assert process.returncode == -signal.SIGKILL
    assert [one.killed for one in case_spans(trial.order.place, trial.all_killed)] == [True]


@needs_engine
def test_a_cohort_killed_on_the_way_ends_as_if_it_had_not_been(tmp_path: Path) -> None:
    order = Order(CohortCases(6, 2), kills=1, work=tmp_path, settings=FASTER, first_kill=EVERYTHING, limit_s=900.0)
    trial = run(order)
    assert problems_of(order.place, order.cases, trial.code) == []
    assert trial.outlived == ()
    assert re.search(r"4 of 6 cases have a table .*, 2 failed", trial.said)
    killed = [one for one in case_spans(order.place, trial.all_killed) if one.killed]
    assert killed, "the kill met no case at work"
    assert repeats(order.place.results, order.cases.ids).computed >= 4 * 9
