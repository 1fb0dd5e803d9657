"""Cohorts of the stub program whose drivers end with the test, however it ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.cluster.stub_cohort import Behaviour, StubCohort, stub_cohort

LayOut = Callable[[Behaviour], StubCohort]


@pytest.fixture
def lay_out(tmp_path: Path) -> Iterator[LayOut]:
    """Lay out a cohort in the test's folder."""
    made: list[StubCohort] = []

    def lay(behaviour: Behaviour) -> StubCohort:
        made.append(stub_cohort(tmp_path / "results", behaviour))
        return made[-1]

    yield lay
    for cohort in made:
        cohort.end()
