"""Prints the figures and writes build/validate.json; the exit code is 1 where a target is missed."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from tests.validate import Measurement, Row, Table
from tests.validate.floating_varus import MEASUREMENTS as FLOATING_VARUS
from tests.validate.knees import MEASUREMENTS as KNEES
from tests.validate.measured_motion import MEASUREMENTS as MEASURED_MOTION
from tests.validate.paper_objects import MEASUREMENTS as PAPER_OBJECTS
from tests.validate.real_knee import MEASUREMENTS as REAL_KNEE

REPORT = Path("build/validate.json")
MEASUREMENTS: tuple[Measurement, ...] = (
    *PAPER_OBJECTS,
    *KNEES,
    *REAL_KNEE,
    *MEASURED_MOTION,
    *FLOATING_VARUS,
)


def text(item: Row | Table) -> str:
    """A row as one line, a table as a line for each of its own."""
    return "\n".join(_table_lines(item)) if isinstance(item, Table) else _line(item)


def _line(row: Row) -> str:
    bound = "" if row.target is None else f"at most {row.target:<8g}{'' if row.met else 'MISSED'}"
    return f"{row.name:<66}{row.value:>10.2e} {row.unit:<5}{bound}".rstrip()


def _table_lines(table: Table) -> Iterator[str]:
    width = max(map(len, table.rows), default=0) + 2
    yield f"\n{table.title}"
    yield " " * width + "".join(f"{name:>14}" for name in table.columns)
    for name, values in table.rows.items():
        yield f"{name:<{width}}" + "".join(f"{value:>14.4g}" for value in values)
    yield ""


def noted(item: Row | Table) -> object:
    """What the file holds of a row or of a table; null for what is no number."""
    if isinstance(item, Row):
        return _number(item.value)
    return {
        name: dict(zip(item.columns, map(_number, values), strict=True)) for name, values in item.rows.items()
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def write(measured: Mapping[str, object]) -> None:
    """Write what is known so far."""
    REPORT.parent.mkdir(exist_ok=True)
    REPORT.write_text(json.dumps(measured, indent=1, sort_keys=True) + "\n")


def main(measurements: Sequence[Measurement]) -> int:
    """Measure, print each figure as soon as it is known, and say whether every target was met."""
    met, measured = True, dict[str, object]()
    for measure in measurements:
        for item in measure():
            if item.key in measured:
                raise ValueError(f"two figures are called {item.key}")
            measured[item.key] = noted(item)
            sys.stdout.write(text(item) + "\n")
            sys.stdout.flush()
            met = met and (isinstance(item, Table) or item.met)
        write(measured)
    return 0 if met else 1


if __name__ == "__main__":
    raise SystemExit(main(MEASUREMENTS))
