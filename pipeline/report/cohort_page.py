"""The page of all cases of a results folder: one line each; the same bytes for the same lines."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args
from urllib.parse import quote

import numpy as np

from pipeline import __version__
from pipeline.report.figure_frame import RESEARCH_USE
from pipeline.report.figure_viewer import content_policy
from pipeline.report.templates import environment, number, resource

TEMPLATE = "cohort.html.j2"
SCRIPT = "cohort.js"

State = Literal["UNREADABLE", "ERROR", "REJECTED", "REVIEW", "NOT FINISHED", "NOT STARTED", "RUNNING", "PASS"]
#: Every state, those that need somebody first.
STATES: tuple[State, ...] = get_args(State)

#: Metrics that have a column, and its head; of each of them more is worse. The others stand in the report of the case.
COLUMNS = {
    "mesh_volume_error": "Volume",
    "axis_uncertainty.flexion_axis": "Flexion axis",
    "scan_pose_mm": "Scan pose",
    "hysteresis_mm": "Hyste\u00adresis",
    "jump_mm": "Largest step",
    "cross_check_mm": "Solvers differ",
    "residual_rms.anterior_mm": "Smooth\u00ading",
    "midpoint_error": "Between entries",
}
#: What the pictures of a case show, in their order; the alternative text of the strip.
PICTURES = (
    "a cut through the scan, the bones from the front, flexion 90 degrees from the side, where the surfaces touch"
)

#: With fewer cases nobody can say what is usual.
LEAST_CASES = 8
#: Iglewicz & Hoaglin (1993): unusual from 3.5 on, in standard deviations estimated by the median deviation.
FAR = 3.5
SIGMA_OF_MEDIAN_DEVIATION = 1.4826


@dataclass(frozen=True)
class Number:
    """One metric of a case; ``over`` where it is beyond its limit."""

    name: str
    title: str
    unit: str
    value: float
    over: bool


@dataclass(frozen=True)
class CaseRow:
    """One line of the page.

    Attributes
    ----------
    case_id : str
    state : State
    body_part : str
        Such as ``RIGHT knee``; empty where it is not known for sure.
    reasons : tuple of str
        Why the state is what it is.
    action : str
        What to do; empty where the reasons say it or nothing has to be done.
    numbers : tuple of Number
        Finite ones.
    report : str
        POSIX path of the page that tells of it, relative to the results; empty where there is none of this state.
    pictures : str
        File name of the strip of thumbnails; empty where there is none.
    review : str
        What a reader decided; empty where nobody did yet.
    computing_s : float
        Seconds that its results took to compute, in the last run or in earlier ones; the page does not show them.
    """

    case_id: str
    state: State
    body_part: str = ""
    reasons: tuple[str, ...] = ()
    action: str = ""
    numbers: tuple[Number, ...] = ()
    report: str = ""
    pictures: str = ""
    review: str = ""
    computing_s: float = 0.0


@dataclass(frozen=True)
class Links:
    """POSIX paths from the page to the results folder and to the folder of the thumbnails."""

    results: str
    pictures: str


@dataclass(frozen=True)
class Unusual:
    """How a number lies beside those of the other cases: above or below, their median, how many they are."""

    way: Literal["high", "low"]
    median: float
    cases: int


def cohort_html(rows: Sequence[CaseRow], links: Links) -> bytes:
    """The page; every text from a case is escaped, and without script it is the whole list."""
    import markupsafe  # noqa: PLC0415 - only this command needs it

    script = resource(SCRIPT)
    context = {
        "policy": page_policy(script),
        "script": markupsafe.Markup(script),  # noqa: S704 - our own constant file
        "research_use": RESEARCH_USE,
        "software": f"ct2lut {__version__}",
        "alternative": PICTURES,
        "least_cases": LEAST_CASES,
        **_content(sorted(rows, key=_order), links),
    }
    return environment().get_template(TEMPLATE).render(context).encode()


def page_policy(script: str) -> str:
    """Content policy of the page: that of a report, and pictures from beside the page."""
    return content_policy([script]).replace("img-src data:", "img-src 'self' data:")


def unusual_numbers(rows: Sequence[CaseRow]) -> dict[tuple[str, str], Unusual]:
    """Which numbers of which cases (case ID, metric name) lie far from those of the other cases of the same joint.

    Far is more than 3.5 standard deviations from the median, estimated by the median deviation; a metric that fewer
    than eight cases have, or of which most are equal, has no unusual numbers.
    """
    found: dict[tuple[str, str], Unusual] = {}
    for joint in sorted({_joint(row) for row in rows}):
        for name in COLUMNS:
            values = {r.case_id: n.value for r in rows if _joint(r) == joint for n in r.numbers if n.name == name}
            found |= {(case_id, name): one for case_id, one in _far(values)}
    return found


def _far(values: Mapping[str, float]) -> Iterator[tuple[str, Unusual]]:
    if len(values) < LEAST_CASES:
        return
    numbers = np.array(list(values.values()))
    middle = float(np.median(numbers))
    spread = SIGMA_OF_MEDIAN_DEVIATION * float(np.median(np.abs(numbers - middle)))
    for case_id, value in values.items():
        if spread > 0.0 and abs(value - middle) > FAR * spread:
            yield case_id, Unusual("high" if value > middle else "low", middle, len(values))


def _joint(row: CaseRow) -> str:
    return row.body_part.rpartition(" ")[2]


def _order(row: CaseRow) -> tuple[int, list[tuple[int, str]], str]:
    """What needs somebody first; then P2 before P10."""
    pieces = re.findall(r"\d+|\D+", row.case_id.casefold())
    return (
        STATES.index(row.state),
        [(int(one), "") if one.isdecimal() else (-1, one) for one in pieces],
        row.case_id,
    )


def _content(rows: Sequence[CaseRow], links: Links) -> dict[str, Any]:
    known = {number.name: number for row in rows for number in row.numbers}
    columns = [known[name] for name in COLUMNS if name in known]
    far = unusual_numbers(rows)
    counts = Counter(row.state for row in rows)
    return {
        "columns": [(COLUMNS[column.name], column) for column in columns],
        "counts": [(state, counts[state]) for state in STATES if counts[state]],
        "unusual": len({case_id for case_id, _ in far}),
        "rows": [_line(row, columns, far, links) for row in rows],
    }


def _line(
    row: CaseRow, columns: Sequence[Number], far: Mapping[tuple[str, str], Unusual], links: Links
) -> dict[str, Any]:
    numbers = {one.name: one for one in row.numbers}
    shown = [(numbers.get(column.name), far.get((row.case_id, column.name))) for column in columns]
    return {
        "row": row,
        "rank": STATES.index(row.state),
        "report": quote(f"{links.results}/{row.report}") if row.report else "",
        "pictures": quote(f"{links.pictures}/{row.pictures}") if row.pictures else "",
        "cells": [_cell(one, beside) for one, beside in shown],
        "unusual": [_words(one, beside) for one, beside in shown if one and beside],
    }


def _cell(shown: Number | None, beside: Unusual | None) -> dict[str, str]:
    """Text and mark of one number: unusual, beyond its limit, or neither."""
    if shown is None:
        return {"text": "", "mark": ""}
    return {"text": number(shown.value), "mark": beside.way if beside else "over" if shown.over else ""}


def _words(shown: Number, beside: Unusual) -> str:
    title = f"{shown.title[:1].lower()}{shown.title[1:]}"
    usual = f"half of {beside.cases} cases are below {number(beside.median)}"
    return f"Unusually {beside.way}: {title} {number(shown.value)} {shown.unit} ({usual})."
