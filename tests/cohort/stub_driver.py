"""Drives a cohort of stub batches as `ct2lut cohort` does; where another driver is at work, after it.

python -m tests.cohort.stub_driver RESULTS [NUMBER OF BATCHES THAT TAKE NO TIME, WHICH ARE LAID OUT FIRST]
"""

from __future__ import annotations

import json
import shlex
import signal
import sys
from collections.abc import Iterable
from pathlib import Path

from pipeline.cohort.driver import find_engine, run_engine, wait_for_driver
from pipeline.cohort.place import CohortPlace
from tests.cohort import stub_program
from tests.cohort.stub_program import STOPPED, note


def write_plan(place: CohortPlace, names: Iterable[str], *, mem_mb: int = 100, threads: int = 1) -> None:
    """What the engine reads, as `ct2lut cohort` writes it."""
    place.case_list("any").parent.mkdir(parents=True, exist_ok=True)
    for name in names:
        place.case_list(name).write_text("id\n")
    config = {
        "key": "k",
        "program": shlex.join([sys.executable, "-I", "-S", str(stub_program.__file__)]),
        "results": shlex.quote(str(place.results)),
        "threads": threads,
        "retries": 2,
        "batches": {name: {"mem_mb": mem_mb, "minutes": 5} for name in names},
    }
    (place.workflow / "config.json").write_text(json.dumps(config))


def stub(place: CohortPlace, seconds: float = 0.0, **faulty: int) -> None:
    """How the stub behaves."""
    place.results.mkdir(exist_ok=True)
    (place.results / "stub.json").write_text(json.dumps({"seconds": seconds, "faulty": faulty}))


def drive(place: CohortPlace) -> int:
    """Drive it to its end; the exit code."""
    try:
        wait_for_driver(place, lambda: note(place.results, "waited.log", "waited"))
        return int(not run_engine(place, find_engine("workstation", 2), lambda: None).ok)
    except KeyboardInterrupt:
        return STOPPED


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    here = CohortPlace(Path(sys.argv[1]).absolute())
    if len(sys.argv) > 2:
        write_plan(here, [f"b{number:05d}" for number in range(int(sys.argv[2]))])
        stub(here)
    sys.exit(drive(here))
