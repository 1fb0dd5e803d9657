"""Work over threads: order, errors, and what is told."""

from __future__ import annotations

import time

import pytest

from pipeline.adapters.threads import map_threads


def slow_square(number: int) -> int:
    time.sleep(0.002 * (5 - number))
    return number * number


@pytest.mark.parametrize("jobs", [1, 2, 8])
def test_results_come_in_the_order_of_the_tasks(jobs: int) -> None:
    told: list[int] = []
    assert map_threads(slow_square, [0, 1, 2, 3, 4], jobs, told.append) == [0, 1, 4, 9, 16]
    assert sorted(told) == [0, 1, 2, 3, 4]


def test_no_task_is_no_work() -> None:
    assert map_threads(slow_square, [], 4) == []


def test_an_error_is_raised_here() -> None:
    def fail(number: int) -> int:
        raise ValueError(f"no {number}")

    with pytest.raises(ValueError, match="no 1"):
        map_threads(fail, [1], 2)
