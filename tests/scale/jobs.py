"""What a job of the simulation types for ct2lut: ``jobs.py TEMPLATE batch ...``; all is real but the cases."""

from __future__ import annotations

import sys
from pathlib import Path

from pipeline.cohort.batch import Batch, run_batch
from pipeline.cohort.batches import load_plan
from pipeline.cohort.place import CohortPlace

STUB = Path(__file__).with_name("case.sh")


def main(template: str, words: list[str]) -> None:
    """Do what a job asks for."""
    match words:
        case ["batch", "--results", results, "--attempt", attempt, "--", name]:
            run_batch(Batch(CohortPlace(Path(results)), name, ("/bin/sh", str(STUB), template), int(attempt)))
        case ["cohort-summary", "--results", results]:
            from pipeline.cohort.summary import write_summary  # noqa: PLC0415 -- no batch should wait for it
            from pipeline.flow import FLOW  # noqa: PLC0415

            place = CohortPlace(Path(results))
            write_summary(place, load_plan(place), FLOW)
        case _:
            raise SystemExit(2)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
