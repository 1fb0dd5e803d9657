"""How fast the program is: one table, one run, medians and ratios, for this machine is shared and its clock drifts.

``make bench`` prints the table row by row and writes ``build/bench.json``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median


@dataclass(frozen=True)
class Figure:
    """One row: a name, what was measured, its unit, and what it is a multiple of."""

    name: str
    value: float
    unit: str
    ratio: str = ""


def seconds(work: Callable[[], object], repeats: int) -> float:
    """Median wall time of one call."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return median(times)
