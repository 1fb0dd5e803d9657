"""The cases of the real cohort: the same each time, no two alike, each broken one refused for a reason of its own."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.config import load_settings
from pipeline.engine.outcome import Execution
from pipeline.engine.runner import CaseJob, run_case
from pipeline.errors import CaseRejected, ExitCode
from pipeline.flow import FLOW
from pipeline.geometry.phantom import phantom_labels
from pipeline.geometry.phantom_spec import RANGES
from tests.cohort.breakages import BREAKAGES, Breakage
from tests.cohort.cohort_cases import CohortCases
from tests.cohort.phantoms import ANATOMY, CASES_A_CT, SCAN, PhantomCase, phantom_cases, phantom_spec
from tests.end_to_end.knee_runs import Silent, up_to

COHORT = CohortCases(200, 20)


def test_every_knee_is_one_of_its_own_and_the_same_each_time() -> None:
    cases = list(phantom_cases(200))
    assert cases == list(phantom_cases(200))
    assert len({repr(replace(one.spec, seed=0)) for one in cases}) == 200
    assert {one.spec.side for one in cases} == {"right", "left"}
    assert sum(one.as_ct for one in cases) == 200 // CASES_A_CT == 5


def test_a_longer_cohort_begins_with_the_same_knees() -> None:
    assert list(phantom_cases(300))[:200] == list(phantom_cases(200))


def test_every_number_that_may_vary_does_within_its_range() -> None:
    assert set(ANATOMY) | set(SCAN) == set(RANGES)
    for name, (low, high) in {**ANATOMY, **SCAN}.items():
        assert RANGES[name][0] <= low < high <= RANGES[name][1]
        first, *others = (getattr(phantom_spec(index), name) for index in range(3))
        assert first not in others


def test_equal_indices_give_equal_files(tmp_path: Path) -> None:
    coarse = replace(phantom_spec(7), spacing_mm=(3.0, 3.0, 3.0))
    for name in ("one", "other"):
        PhantomCase("K008", coarse).write(tmp_path / name)
    assert _bytes(tmp_path / "one") == _bytes(tmp_path / "other")
    assert phantom_labels(coarse).values.any()


def test_twenty_breakages_have_twenty_codes_and_lie_between_the_others() -> None:
    assert len({one.code for one in BREAKAGES}) == len({one.name for one in BREAKAGES}) == len(BREAKAGES) == 20
    assert set(COHORT.breakages.values()) == set(BREAKAGES)
    assert len(COHORT.breakages) == 20
    assert not set(COHORT.breakages) & {one.case_id for one in phantom_cases(200) if one.as_ct}


def test_no_more_can_be_broken_than_there_are_ways() -> None:
    with pytest.raises(ValueError, match="broken: expected 0 to 20, got 21"):
        CohortCases(200, 21)
    with pytest.raises(ValueError, match="broken: expected 0 to 3, got 4"):
        CohortCases(3, 4)


@pytest.mark.parametrize("breakage", BREAKAGES, ids=lambda one: one.code)
def test_each_is_refused_for_its_reason(breakage: Breakage, tmp_path: Path) -> None:
    """What the cohort must say of it is what a run says of it."""
    folder = tmp_path / "cases" / "B1"
    breakage.write(folder)
    code, problem = _refusal(folder, tmp_path / "results" / "B1")
    assert code == breakage.code
    assert re.search(breakage.problem, problem)


def _refusal(folder: Path, results: Path) -> tuple[str | None, str]:
    try:
        settings = load_settings(FLOW, folder, "demo", ())
    except CaseRejected as error:
        return error.code, error.problem
    flow = up_to("anatomy")
    outcome = run_case(CaseJob(folder.name, folder, results), flow, settings, Execution(jobs=1), Silent())
    assert outcome.exit_code == ExitCode.REJECTED
    return outcome.code, outcome.problem or ""


def _bytes(folder: Path) -> Mapping[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
