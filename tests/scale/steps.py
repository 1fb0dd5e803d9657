"""One step of a cohort in a process of its own: ``python -m tests.scale.steps STEP CASES RESULTS`` prints JSON."""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path

from pipeline.cohort.batches import load_plan
from pipeline.cohort.model import CohortRequest
from pipeline.cohort.place import CohortPlace
from pipeline.cohort.progress import Watcher
from pipeline.cohort.start import Order, plan_cohort
from pipeline.cohort.summary import write_summary
from pipeline.flow import FLOW

LOOKS = 20


def plan(cases: Path, place: CohortPlace) -> None:
    """Read the list and write the plan."""
    plan_cohort(Order(CohortRequest(str(cases), "demo")), place, FLOW)


def summary(cases: Path, place: CohortPlace) -> None:
    """Write the summary and bring the overview up to date."""
    write_summary(place, load_plan(place), FLOW)


def watcher(cases: Path, place: CohortPlace) -> None:
    """Begin to follow the ledgers: read the lists and all ledgers."""
    Watcher(place, load_plan(place), time.monotonic)


def looks(cases: Path, place: CohortPlace) -> float:
    """Seconds of one look at ledgers without news."""
    follow = Watcher(place, load_plan(place), time.monotonic)
    begun = time.perf_counter()
    for _ in range(LOOKS):
        follow.look()
    return (time.perf_counter() - begun) / LOOKS


STEPS: dict[str, Callable[[Path, CohortPlace], float | None]] = {
    one.__name__: one for one in (plan, summary, watcher, looks)
}


def main(step: str, cases: Path, results: Path) -> None:
    """Do it and say what it took: wall time, seconds of all processors, the most memory of this process."""
    begun = time.perf_counter()
    own = STEPS[step](cases, CohortPlace(results))
    wall = time.perf_counter() - begun if own is None else own
    used = resource.getrusage(resource.RUSAGE_SELF)
    figures = {"wall_s": wall, "cpu_s": used.ru_utime + used.ru_stime, "peak_mb": used.ru_maxrss * 1024 / 1e6}
    sys.stdout.write(json.dumps(figures) + "\n")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
