"""``ligaments.csv`` of a case: one fibre a line, by the two points it runs between, strictly read.

Columns in any order: ``name``, ``reference_x``, ``reference_y``, ``reference_z``, ``moving_x``, ``moving_y``,
``moving_z`` (attachments at the pose of the scan, LPS, mm); optional ``slack_mm``, ``stiffness_n`` (pull per unit of
strain) and ``kind`` (``spring`` or ``cord``). A cell of an optional column may be empty.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping
from typing import NamedTuple

from pipeline.errors import CaseRejected
from pipeline.records import LigamentFibre, Vector

#: Its name in the case folder.
LIGAMENTS_FILE = "ligaments.csv"
MAX_BYTES = 1_000_000

REQUIRED = ("name", *(f"{body}_{axis}" for body in ("reference", "moving") for axis in "xyz"))
OPTIONAL = ("slack_mm", "stiffness_n", "kind")
#: Pull (N) per unit of strain of a fibre that is given without: the commonest of the 55 fibres of the published knee
#: of Lenhart 2015 and Smith 2019, where a ligament has 2 to 12 fibres of 300 to 900 N.
DEFAULT_STIFFNESS_N = 500.0
#: Ends that are closer than this are one point, mm.
LEAST_LENGTH_MM = 0.1
#: Numbers beyond these are in other units.
MOST_MM, MOST_STIFFNESS_N = 1e4, 1e6

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,63}")


class _Line(NamedTuple):
    """One line of the file below its header."""

    file: str
    number: int
    cells: Mapping[str, str]

    def refused(self, problem: str) -> CaseRejected:
        return CaseRejected(
            "E-LIG-02",
            f"Line {self.number} of {self.file} is not a fibre: {problem}.",
            "Correct or remove that line; points are LPS millimetres at the pose of the scan.",
        )

    def within(self, column: str, least: float, most: float) -> float:
        """A number of a required column."""
        try:
            value = float(self.cells[column])
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            problem = f"{column} is {_shown(self.cells[column])}, expected a number from {least:g} to {most:.0f}"
            raise self.refused(problem)
        return value

    def above_zero(self, column: str, most: float) -> float | None:
        """A number of an optional column; None where it is not given."""
        return self.within(column, 1e-3, most) if self.cells.get(column) else None

    def point(self, body: str) -> Vector:
        """Where the fibre ends on a body."""
        x, y, z = (self.within(f"{body}_{axis}", -MOST_MM, MOST_MM) for axis in "xyz")
        return x, y, z


def read_ligaments(data: bytes, file: str) -> tuple[LigamentFibre, ...]:
    """The fibres of a ligament table, in the order of the file.

    Parameters
    ----------
    data : bytes
        The whole file.
    file : str
        Its name relative to the case folder.

    Raises
    ------
    CaseRejected
        E-LIG-01 not readable as a table of fibres, E-LIG-02 a line that is not a fibre.
    """
    texts = [(number, text) for number, text in enumerate(_text(data, file).splitlines(), start=1) if text.strip()]
    if not texts:
        raise _unreadable(file, "it is empty")
    columns = _columns(*texts[0], file)
    fibres: dict[str, LigamentFibre] = {}
    for number, text in texts[1:]:
        line = _line(number, text, columns, file)
        fibre = _fibre(line)
        if fibre.name in fibres:
            raise line.refused(f"the name {fibre.name} is given twice")
        fibres[fibre.name] = fibre
    if not fibres:
        raise _unreadable(file, "it has no line below its header")
    return tuple(fibres.values())


def _text(data: bytes, file: str) -> str:
    if len(data) > MAX_BYTES:
        raise _unreadable(file, f"it has {len(data)} bytes, expected at most {MAX_BYTES}")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise _unreadable(file, "it is not UTF-8 text") from error


def _columns(number: int, text: str, file: str) -> list[str]:
    columns = _cells(number, text, file)
    if missing := [name for name in REQUIRED if name not in columns]:
        raise _unreadable(file, f"it has no column {missing[0]} (the header is {_shown(text)})")
    for name in columns:
        if columns.count(name) > 1:
            raise _unreadable(file, f"the column {name} is given twice")
        if name not in (*REQUIRED, *OPTIONAL):
            raise _unreadable(file, f"the column {_shown(name)} is not known")
    return columns


def _cells(number: int, text: str, file: str) -> list[str]:
    try:
        (cells,) = csv.reader([text], strict=True)
    except csv.Error as error:
        raise _unreadable(file, f"line {number} has broken quotes") from error
    return [cell.strip() for cell in cells]


def _line(number: int, text: str, columns: list[str], file: str) -> _Line:
    cells = _cells(number, text, file)
    line = _Line(file, number, dict(zip(columns, cells, strict=False)))
    if len(cells) != len(columns):
        raise line.refused(f"it has {len(cells)} cells, expected {len(columns)}")
    return line


def _fibre(line: _Line) -> LigamentFibre:
    name = line.cells["name"]
    if not _NAME.fullmatch(name):
        raise line.refused(f"name is {_shown(name)}, expected 1 to 64 letters, digits, blanks, dots, _ and -")
    fibre = LigamentFibre(
        name, line.point("reference"), line.point("moving"), line.above_zero("slack_mm", MOST_MM), _stiffness(line)
    )
    if math.dist(fibre.reference, fibre.moving) < LEAST_LENGTH_MM:
        raise line.refused("its two ends are the same point")
    return fibre


def _stiffness(line: _Line) -> float | None:
    """Pull per unit of strain; None for a cord."""
    kind, given = line.cells.get("kind") or "spring", line.above_zero("stiffness_n", MOST_STIFFNESS_N)
    if kind not in ("spring", "cord"):
        raise line.refused(f"kind is {_shown(kind)}, expected spring or cord")
    if kind == "spring":
        return DEFAULT_STIFFNESS_N if given is None else given
    if given is not None:
        raise line.refused(f"it is a cord, which does not stretch, but stiffness_n is {given:g}")
    return None


def _shown(text: str) -> str:
    return repr(text if len(text) <= 80 else f"{text[:80]}...")


def _unreadable(file: str, problem: str) -> CaseRejected:
    return CaseRejected(
        "E-LIG-01",
        f"The ligaments in {file} cannot be read: {problem}.",
        f"Save them as comma-separated text (UTF-8) with the columns {', '.join(REQUIRED)} and, if known, "
        f"{', '.join(OPTIONAL)}; or remove the file.",
    )
