"""A small cohort by the real command, the real engine and real runs, killed once: nothing lost, nothing done twice."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import pipeline
from tests.cohort.checks import problems_of
from tests.cohort.cohort_cases import CohortCases
from tests.cohort.figures import case_spans, repeats
from tests.cohort.real import FASTER, Order, run

ENGINE = Path(pipeline.__file__).parents[1] / ".venv-cohort/bin/snakemake"

pytestmark = pytest.mark.skipif(not ENGINE.exists(), reason="no workflow engine here; type: make setup-cohort")

#: What the last kill, of every process, leaves to the second call.
EVERYTHING = 2


def test_a_cohort_killed_on_the_way_ends_as_if_it_had_not_been(tmp_path: Path) -> None:
    order = Order(CohortCases(6, 2), kills=1, work=tmp_path, settings=FASTER, first_kill=EVERYTHING, limit_s=900.0)
    trial = run(order)
    assert problems_of(order.place, order.cases, trial.code) == []
    assert trial.outlived == ()
    assert re.search(r"4 of 6 cases have a table .*, 2 failed", trial.said)
    killed = [one for one in case_spans(order.place, trial.all_killed) if one.killed]
    assert killed, "the kill met no case at work"
    assert repeats(order.place.results, order.cases.ids).computed >= 4 * 9
