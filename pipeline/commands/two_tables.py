"""What ``ct2lut compare`` is asked about: two finished tables, by case ID or by path."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.case_id import is_case_id
from pipeline.errors import CaseRejected, ConfigError
from pipeline.files.lut_file import decode_lut
from pipeline.kinematics.comparison import compare
from pipeline.suggestions import shown

if TYPE_CHECKING:
    from pipeline.files.lut_content import LutFileContent
    from pipeline.report.comparison_page import ComparedTable, ComparisonPage


@dataclass(frozen=True, eq=False)
class OpenedTable:
    """A table and what it is called: the case ID, or the name of the file."""

    label: str
    content: LutFileContent


def compare_cases(first: str, second: str, results: Path) -> ComparisonPage:
    """Compare two finished tables.

    Parameters
    ----------
    first, second : str
        A case ID, or the path of a ``lut.h5``.
    results : Path
        Folder with one folder a case.

    Raises
    ------
    ConfigError
        E-CMP-01 where there is no such table.
    CaseRejected
        E-CMP-02 for a file that cannot be used as a table, E-CMP-03 for two that have nothing to compare.
    """
    from pipeline.report.comparison_page import ComparisonPage  # noqa: PLC0415 - charts: slow to import

    one, other = open_table(first, results), open_table(second, results)
    if one.content.joint != other.content.joint:
        joints = f"the first is of the joint {one.content.joint}, the second of the joint {other.content.joint}"
        raise _apart(one, other, joints)
    try:
        found = compare(one.content.table, other.content.table)
    except ValueError as error:
        raise _apart(one, other, str(error)) from error
    return ComparisonPage(_facts(one), _facts(other), found)


def open_table(name: str, results: Path) -> OpenedTable:
    """The table of a case ID or at a path; errors E-CMP-01 and E-CMP-02 of :func:`compare_cases`."""
    path = results / name / "90_package" / "lut.h5" if is_case_id(name) else Path(name)
    label = name if is_case_id(name) else path.name
    if not path.is_file():
        action = "Give the ID of a finished case (ct2lut status lists them) or the path of a lut.h5."
        raise ConfigError("E-CMP-01", f"There is no finished table of {shown(label)}.", action)
    try:
        return OpenedTable(label, decode_lut(path.read_bytes()))
    except ValueError as error:
        action = "Make the table again (ct2lut run), or copy it again from where it is intact."
        raise CaseRejected("E-CMP-02", f"The table of {shown(label)} cannot be used: {error}.", action) from error


def comparison_lines(page: ComparisonPage) -> list[str]:
    """The numbers for reading: one line a coordinate."""
    lines = [f"first   {page.first.heading}", f"second  {page.second.heading}"]
    lines.append(f"second minus first at {page.comparison.shared} shared attitudes:")
    for curve in page.comparison.curves:
        name, _, unit = curve.name.rpartition("_")
        lines.append(
            f"{name:<18} RMS {curve.rms:7.2f}  mean {curve.mean:7.2f}  about the mean {curve.about_mean:7.2f}  "
            f"largest {curve.largest:7.2f} {unit} at flexion {curve.flexion_deg:g}, varus {curve.varus_deg:g}"
        )
    return lines


def _facts(opened: OpenedTable) -> ComparedTable:
    from pipeline.report.comparison_page import ComparedTable  # noqa: PLC0415 - as above

    content = opened.content
    return ComparedTable(opened.label, content.joint, content.side, content.software)


def _apart(one: OpenedTable, other: OpenedTable, why: str) -> CaseRejected:
    problem = f"The tables of {shown(one.label)} and {shown(other.label)} cannot be compared: {why}."
    action = "Compare two tables of one joint whose ranges of flexion and varus overlap."
    return CaseRejected("E-CMP-03", problem, action)
