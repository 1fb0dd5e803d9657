"""What a batch asks for: above every measurement, more for larger cases, within the limits of the request."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.cohort.model import CaseLimits, CohortRequest
from pipeline.cohort.resources import BESIDE_MB, MEMORY_MARGIN, TIME_MARGIN, batch_resources

MB = 1_000_000
#: Size of the files, peak memory in MB, seconds of all processors: as in the docstring.
MEASURED = [
    (0.03, 712, 42),
    (0.08, 748, 80),
    (0.18, 778, 46),
    (0.33, 790, 84),
    (0.62, 990, 87),
    (34.2, 1140, 180),
    (108.5, 1574, 140),
]
sizes_of_a_batch = st.lists(st.integers(0, 2000 * MB), min_size=1, max_size=60)


def request(jobs: int = 1, memory_mb: int = 0, time_s: float = 0.0) -> CohortRequest:
    return CohortRequest("/data/cases", "clinical", (), jobs, CaseLimits(memory_mb, time_s))


@pytest.mark.parametrize(("size_mb", "memory_mb", "seconds"), MEASURED)
def test_every_measurement_lies_below_with_its_margin(size_mb: float, memory_mb: float, seconds: float) -> None:
    asked = batch_resources([int(size_mb * MB)], request())
    assert asked.mem_mb >= MEMORY_MARGIN * memory_mb + BESIDE_MB
    assert asked.minutes * 60 >= TIME_MARGIN * seconds + 60
    assert asked.mem_mb <= 4 * memory_mb
    assert asked.minutes * 60 <= 10 * seconds


def test_a_second_process_of_a_case_needs_more() -> None:
    two = batch_resources([int(34.2 * MB)], request(jobs=2)).mem_mb
    assert two >= MEMORY_MARGIN * 1831
    assert batch_resources([MB], request(jobs=0)) == batch_resources([MB], request(jobs=1))


def test_cases_of_a_batch_run_one_after_the_other() -> None:
    one, many = batch_resources([30 * MB], request()), batch_resources([30 * MB] * 50, request())
    assert many.mem_mb == one.mem_mb
    assert many.minutes == pytest.approx(1 + 50 * (one.minutes - 1), abs=50)


@given(sizes_of_a_batch)
def test_the_largest_case_decides_the_memory(sizes: list[int]) -> None:
    assert batch_resources(sizes, request()).mem_mb == batch_resources([max(sizes)], request()).mem_mb


@given(sizes_of_a_batch, st.integers(0, 1000 * MB))
def test_more_never_needs_less(sizes: list[int], more: int) -> None:
    before, after = batch_resources(sizes, request()), batch_resources([*sizes, more], request())
    assert after.mem_mb >= before.mem_mb
    assert after.minutes > before.minutes


@given(sizes_of_a_batch, st.integers(1, 100_000), st.floats(1.0, 100_000.0))
def test_limits_of_a_case_bound_its_batch(sizes: list[int], memory_mb: int, time_s: float) -> None:
    free, bounded = batch_resources(sizes, request()), batch_resources(sizes, request(1, memory_mb, time_s))
    assert bounded.mem_mb == memory_mb + BESIDE_MB
    assert 1 < bounded.minutes <= free.minutes
    assert bounded.minutes <= 2 + len(sizes) * time_s / 60


def test_no_case_at_all() -> None:
    assert batch_resources([], request()).minutes == 1
