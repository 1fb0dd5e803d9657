"""How a cohort ended: ``cohort.csv``, the overview of all its cases, the last lines on the screen, the exit code.

Truth is what each case has on disk; the ledgers add its history, and the word of a case that has no results.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.cohort.batches import load_batch, load_plan
from pipeline.cohort.ledger import Event, event_key, events
from pipeline.cohort.model import CaseEnd, Plan
from pipeline.cohort.place import CohortPlace
from pipeline.commands.cohort_case import RUN_FILE
from pipeline.commands.cohort_index import Places, write_overview
from pipeline.engine.runlog import printable
from pipeline.engine.stage import Stage
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import fingerprint, fingerprint_on_disk, read_file, replace_file
from pipeline.errors import ConfigError, ExitCode
from pipeline.report.cohort_page import CaseRow

#: Metrics of the verdict -> their columns; those of the overview.
NUMBERS = {
    "mesh_volume_error": "mesh_volume_error_percent",
    "axis_uncertainty.flexion_axis": "flexion_axis_uncertainty_deg",
    "scan_pose_mm": "scan_pose_mm",
    "hysteresis_mm": "hysteresis_mm",
    "jump_mm": "jump_mm",
    "cross_check_mm": "cross_check_mm",
    "residual_rms.anterior_mm": "residual_rms_anterior_mm",
    "midpoint_error": "midpoint_error_mm",
}
COLUMNS = (
    "id",
    "word",
    "code",
    "problem",
    "action",
    "reasons",
    "body_part",
    "decision",
    "computing_s",
    "wall_s",
    "peak_mb",
    "host",
    "attempts",
    "finished_at",
    "package",
    *NUMBERS.values(),
)
_TABLE = frozenset({"PASS", "REVIEW"})
_FAILED = frozenset({"REJECTED", "ERROR"})
#: A cell that begins so is a formula for a spreadsheet.
_FORMULA = ("=", "+", "-", "@", "\t", "\r")
#: Codes that begin so are faults of the machine, whether or not another attempt may go well.
_MACHINE = "E-ENV-"
#: So many IDs stand behind each reason on the screen.
_NAMED = 5
_BOM = b"\xef\xbb\xbf"


@dataclass(frozen=True)
class History:
    """What the ledger knows of a case.

    Attributes
    ----------
    end : CaseEnd or None
        Of this request; None where it did not end.
    attempts : int
        How often it was begun for this request.
    last : Event or None
        The last end of all, also for an earlier request.
    """

    end: CaseEnd | None = None
    attempts: int = 0
    last: Event | None = None


@dataclass(frozen=True)
class CaseSummary:
    """One case of the list: its line, its history, the package (POSIX, relative to the results; empty without one)."""

    row: CaseRow
    history: History
    package: str

    @property
    def failure(self) -> tuple[str, str]:
        """Code and problem of a case that failed; empty otherwise."""
        if self.row.state not in _FAILED:
            return "", ""
        code, _, problem = "".join(self.row.reasons[:1]).partition("  ")
        return code, problem

    @property
    def unfinished(self) -> bool:
        """Whether it has no result, and not because of the case."""
        if self.row.state in _FAILED:
            return self.failure[0].startswith(_MACHINE) or bool(self.history.end and self.history.end.transient)
        return self.row.state not in _TABLE


@dataclass(frozen=True)
class Summary:
    """Every case of the list, in the order of their IDs, and the two files that tell of them."""

    cases: tuple[CaseSummary, ...]
    table: Path
    page: Path

    @property
    def unfinished(self) -> int:
        """How many cases have no result because of the machine, or because nobody ran them."""
        return sum(case.unfinished for case in self.cases)

    @property
    def exit_code(self) -> ExitCode:
        """That of the worst case: 30, 10, 11 or 0."""
        return worst((case.row.state for case in self.cases), unfinished=self.unfinished > 0)


@dataclass
class _Past:
    """The history of a case while its ledger is read."""

    key: str
    end: CaseEnd | None = None
    attempts: int = 0
    last: Event | None = None

    def take(self, event: Event) -> None:
        current = event.key == self.key
        if event.end is not None:
            self.last = event
        if current:
            self.end = event.end
            self.attempts += event.what == "started"


@dataclass
class _Group:
    """Cases that failed for the same code; problem and action of the first of them."""

    problem: str
    action: str
    ids: list[str] = field(default_factory=list)


def write_summary(place: CohortPlace, plan: Plan, flow: Sequence[Stage]) -> Summary:
    """Write ``cohort.csv`` and bring the overview up to date.

    The table is RFC 4180 in UTF-8 with a mark at its beginning, by which spreadsheets know the encoding. A text that a
    spreadsheet would take for a formula gets a leading apostrophe; numbers stay numbers.

    A failure that a ledger holds of this request counts, whatever an older result says.

    Parameters
    ----------
    place : CohortPlace
    plan : Plan
        Its cases have a line each.
    flow : sequence of Stage

    Raises
    ------
    ConfigError, EnvironmentFault
        When the lists cannot be read, or the disk fails where the files are written.
    """
    histories = dict(sorted(_histories(place, plan)))
    places = Places(place.results, place.results / "index.html")

    def amended(found: Sequence[CaseRow]) -> tuple[CaseRow, ...]:
        on_disk = {row.case_id: row for row in found}
        told = {name: _row(name, on_disk.get(name), history.end) for name, history in histories.items()}
        return tuple((on_disk | told).values())

    rows = {row.case_id: row for row in write_overview(places, flow, amended).rows}
    cases = tuple(CaseSummary(rows[name], one, _package(rows[name], flow)) for name, one in histories.items())
    data = summary_csv(cases)
    with storage(f"Writing {place.summary.name}"):
        if fingerprint_on_disk(place.summary) != fingerprint(data):
            replace_file(place.summary, data)
    return Summary(cases, place.summary, places.page)


def worst(words: Iterable[str], *, unfinished: bool) -> ExitCode:
    """The exit code of many cases: 30 where the machine kept one from its result, 10 failed, 11 for review, else 0."""
    found = set(words)
    if unfinished:
        return ExitCode.ENVIRONMENT
    if found & _FAILED:
        return ExitCode.REJECTED
    return ExitCode.REVIEW if "REVIEW" in found else ExitCode.PASS


def bring_up_to_date(place: CohortPlace, flow: Sequence[Stage]) -> Summary | None:
    """Write the summary and the overview of the last cohort of a results folder; None where there was none.

    Raises
    ------
    ConfigError, EnvironmentFault
        As :func:`write_summary`.
    """
    return write_summary(place, load_plan(place), flow) if place.plan.exists() else None


def summary_csv(cases: Sequence[CaseSummary]) -> bytes:
    """The table of all cases: a line of column names, one line a case."""
    out = io.StringIO(newline="")
    writer = csv.writer(out)
    writer.writerow(COLUMNS)
    writer.writerows([_cell(value) for value in _values(case)] for case in cases)
    return _BOM + out.getvalue().encode()


def summary_lines(summary: Summary) -> list[str]:
    """The last lines for a person: how many have a table, why the others have none, where to read on."""
    words = [case.row.state for case in summary.cases]
    counts = {word: words.count(word) for word in ("PASS", "REVIEW")}
    failed = sum(word in _FAILED for word in words)
    rest = {f"{failed} failed": failed, f"{(n := len(words) - failed - sum(counts.values()))} without a result": n}
    tables = ", ".join(f"{count} {word}" for word, count in counts.items())
    head = f"{sum(counts.values())} of {len(words)} cases have a table ({tables})"
    lines = [", ".join([head, *(text for text, count in rest.items() if count)])]
    for code, group in sorted(_groups(summary.cases).items(), key=lambda item: (-len(item[1].ids), item[0])):
        more = f" and {len(group.ids) - _NAMED} more" if len(group.ids) > _NAMED else ""
        lines.append(f"{len(group.ids):>5} x {code}  {group.problem}")
        lines += [f"{'':8}{group.action}"] if group.action else []
        lines.append(f"{'':8}{' '.join(group.ids[:_NAMED])}{more}")
    return [*map(printable, lines), f"table: {summary.table}", f"page: {summary.page}"]


def failed_ids(place: CohortPlace) -> frozenset[str]:
    """Cases of the last plan that failed, or whose results are gone; empty where there was none.

    A hint for trying them again: a case that has a result after all is found in the cache.
    """
    try:
        plan = load_plan(place)
        histories = dict(_histories(place, plan))
    except ConfigError:
        return frozenset()
    return frozenset(name for name, one in histories.items() if one.last and _without_table(place, name, one.last))


def _without_table(place: CohortPlace, name: str, last: Event) -> bool:
    return last.end is None or not last.end.finished or not (place.results / name / RUN_FILE).exists()


def _histories(place: CohortPlace, plan: Plan) -> Iterator[tuple[str, History]]:
    for name in plan.batches:
        listed = load_batch(place, name)
        past = {one.case.case_id: _Past(event_key(plan.key, one.signature, one.tries)) for one in listed}
        for event in events(_content(place.ledger(name))):
            if event.id in past:
                past[event.id].take(event)
        yield from ((case_id, History(one.end, one.attempts, one.last)) for case_id, one in past.items())


def _content(path: Path) -> bytes:
    """The ledger is history only: one that cannot be read is an empty one."""
    try:
        return read_file(path)
    except OSError:
        return b""


def _row(name: str, found: CaseRow | None, end: CaseEnd | None) -> CaseRow:
    """The line of a listed case, from what is on disk and from how its process ended."""
    if end and end.word in _FAILED and (found is None or found.state in _TABLE | _FAILED | {"NOT FINISHED"}):
        reason = f"{end.code}  {end.problem}"
        same = found is not None and (found.state, found.reasons) == (end.word, (reason,))
        return found if found and same else CaseRow(name, end.word, reasons=(reason,), action=end.action)
    if found:
        return found
    if end:
        return CaseRow(name, "NOT STARTED", reasons=("Its results are gone.",), action=f"Type: ct2lut run {name}.")
    action = "Give the same command again: it goes on where it stopped."
    return CaseRow(name, "NOT STARTED", reasons=("No run of it has begun.",), action=action)


def _package(row: CaseRow, flow: Sequence[Stage]) -> str:
    return f"{row.case_id}/{flow[-1].folder}" if row.state in _TABLE else ""


def _values(case: CaseSummary) -> list[str | float | None]:
    row, last = case.row, case.history.last
    end = last.end if last else None
    numbers = {one.name: one.value for one in row.numbers}
    return [
        row.case_id,
        row.state,
        *case.failure,
        row.action,
        "" if row.state in _FAILED else " | ".join(row.reasons),
        row.body_part,
        row.review,
        row.computing_s if row.state in _TABLE else None,
        round(end.seconds, 1) if end else None,
        round(end.peak_mb) if end and end.peak_mb else None,
        last.host if last else "",
        case.history.attempts or None,
        last.ts if last else "",
        case.package,
        *(numbers.get(name) for name in NUMBERS),
    ]


def _cell(value: str | float | None) -> str:
    if value is None:
        return ""
    if not isinstance(value, str):
        return f"{value:.6g}"
    text = printable(value)
    return f"'{text}" if value.startswith(_FORMULA) or text.startswith(_FORMULA) else text


def _groups(cases: Sequence[CaseSummary]) -> Mapping[str, _Group]:
    """Failed and unfinished cases by code, or by state where there is no code."""
    groups: dict[str, _Group] = {}
    for case in cases:
        code, problem = case.failure
        if code or case.unfinished:
            reason = problem or " ".join(case.row.reasons)
            group = groups.setdefault(code or case.row.state, _Group(reason, case.row.action))
            group.ids.append(case.row.case_id)
    return groups
