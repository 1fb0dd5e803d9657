"""Prints the table; the exit code is 1 where a target is missed."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.validate import Measurement, Row
from tests.validate.from_ct import ROWS as FROM_CT
from tests.validate.knees import ROWS as KNEES
from tests.validate.measured_motion import ROWS as MOTION
from tests.validate.mesh_and_mirror import ROWS as MESH_AND_MIRROR
from tests.validate.neutral_motion import ROWS as NEUTRAL
from tests.validate.paper_objects import ROWS as PAPER_OBJECTS

REPORT = Path("build/validate.json")
ROWS: tuple[Measurement, ...] = (*PAPER_OBJECTS, *KNEES, *MESH_AND_MIRROR, *MOTION, *NEUTRAL, *FROM_CT)


def line(row: Row) -> str:
    """One row as text."""
    return (
        f"{row.name:<44}{row.value:>12.2e} {row.unit:<5} at most {row.target:<8g}{'' if row.met else 'MISSED'}".rstrip()
    )


def main(measurements: Sequence[Measurement]) -> int:
    """Measure, print each row as soon as it is known, and say whether every target was met."""
    met, measured = True, {}
    for measure in measurements:
        row = measure()
        measured[row.key] = row.value
        sys.stdout.write(line(row) + "\n")
        sys.stdout.flush()
        met = met and row.met
    REPORT.parent.mkdir(exist_ok=True)
    REPORT.write_text(json.dumps(measured, indent=1, sort_keys=True) + "\n")
    return 0 if met else 1


if __name__ == "__main__":
    raise SystemExit(main(ROWS))
