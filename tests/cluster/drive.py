"""Drives a cohort as `ct2lut cohort` does: python -m tests.cluster.drive RESULTS PROFILE."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

from pipeline.cohort.driver import find_engine, run_engine
from pipeline.cohort.place import CohortPlace


def drive(results: Path, profile: str) -> int:
    """Drive it to its end; the exit code."""
    try:
        end = run_engine(CohortPlace(results), find_engine(profile, 0), lambda: None)
    except KeyboardInterrupt:
        return 130
    sys.stdout.write(end.said)
    return int(not end.ok)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(drive(Path(sys.argv[1]), sys.argv[2]))
