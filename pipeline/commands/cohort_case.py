"""One case of a results folder as a line of the overview, and a key that tells whether the line still holds.

A case that cannot be read becomes a line that says so.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from pipeline.artifacts import CASE_FACTS, REPORT, VERDICT
from pipeline.commands.review import REVIEW_FILE, ReviewedCase, review_line
from pipeline.commands.run_report import PAGE, report_page
from pipeline.engine.artifacts import Artifact
from pipeline.engine.lock import is_running
from pipeline.engine.manifest import Manifest, Unusable, load_manifest
from pipeline.engine.outcome import RunOutcome, load_record
from pipeline.engine.stage import Severity, Stage
from pipeline.engine.store import NOT_A_FILE, fingerprint, read_file, replace_file
from pipeline.engine.wiring import MANIFEST_FILE
from pipeline.errors import EnvironmentFault
from pipeline.records import CaseFacts, Verdict
from pipeline.report.cohort_page import COLUMNS, CaseRow, Number
from pipeline.report.figure_frame import HEADER_PX

T = TypeVar("T")

RUN_FILE = "run.json"
#: Last bytes of the record of a run that came to its end.
ENDED = b'"state": "finished"\n}\n'
#: The pictures of the strip and the panel of each, (row, column): what a person looks at first.
PANELS = {"slices": (0, 0), "bones": (0, 0), "poses": (1, 3), "contact": (0, 0)}


@dataclass(frozen=True)
class CaseOnDisk:
    """What the line of a case depends on, as it was found.

    Attributes
    ----------
    folder : Path
        The results of the case; its name is the case's.
    flow : sequence of Stage
    stages : mapping of str to Stage
        Artifact -> the stage that leaves it.
    records : mapping of str to bytes
        File name inside the folder -> content, empty where there is no such file.
    problem : str
        Why a record cannot be read; empty where all can.
    running : bool
        Whether a run is at work; never where the last one came to its end.
    done : str
        How far it has got, in words; empty where its last run came to an end.
    report : str
        POSIX path of the report from the folder of all results; empty where there is none.
    """

    folder: Path
    flow: Sequence[Stage]
    stages: Mapping[str, Stage]
    records: Mapping[str, bytes]
    problem: str
    running: bool
    done: str
    report: str

    @property
    def name(self) -> str:
        """The case ID."""
        return self.folder.name

    @property
    def key(self) -> str:
        """SHA-256 over all that the line depends on; pictures and numbers are in the record of their stage."""
        found = (self.name, self.problem, self.running, self.done, self.report, sorted(self.records.items()))
        return hashlib.sha256(repr(found).encode()).hexdigest()


def case_on_disk(folder: Path, flow: Sequence[Stage]) -> CaseOnDisk:
    """Find what there is of a case; never fails for what it finds."""
    files = {VERDICT.name: MANIFEST_FILE, CASE_FACTS.name: CASE_FACTS.file}
    stages = {one.name: stage for stage in flow for one in stage.writes if one.name in files}
    names = [RUN_FILE, REVIEW_FILE, *(f"{stage.folder}/{files[name]}" for name, stage in stages.items())]
    found = {name: _content(folder / name) for name in names}
    # looking at a lock takes it for a moment, and on a network share every look costs: only where the run has no end
    ended = isinstance(run := found[RUN_FILE], bytes) and run.endswith(ENDED)
    page = None
    with suppress(OSError):
        page = report_page(folder, flow)
    return CaseOnDisk(
        folder,
        flow,
        stages,
        {name: content for name, content in found.items() if isinstance(content, bytes)},
        next((f"{name}: {words}" for name, words in found.items() if isinstance(words, str)), ""),
        not ended and is_running(folder),
        "" if ended else _done(folder, flow),
        page.relative_to(folder.parent).as_posix() if page else "",
    )


def read_row(case: CaseOnDisk, pictures: Path) -> CaseRow:
    """The line of a case; its strip of thumbnails is put into a folder where it is not there yet.

    Raises
    ------
    EnvironmentFault
        When the thumbnails cannot be written.
    """
    try:
        return _read(case, pictures)
    except OSError as error:
        reason = error.strerror or type(error).__name__
    except ValueError as error:
        reason = str(error)
    action = f"Run it again: ct2lut run {case.name}. If this stays, ask whoever looks after the disk."
    return CaseRow(case.name, "UNREADABLE", reasons=(f"These results cannot be used ({reason}).",), action=action)


def _content(path: Path) -> bytes | str:
    """Content of a file, nothing where it is not there, or in words why it cannot be read."""
    try:
        return read_file(path)
    except FileNotFoundError:
        return b""
    except OSError as error:
        return "not a file" if error.errno in NOT_A_FILE else error.strerror or type(error).__name__


def _done(folder: Path, flow: Sequence[Stage]) -> str:
    done = sum(_is_file(folder / stage.folder / MANIFEST_FILE) for stage in flow)
    return f"{done} of {len(flow)} stages have a result."


def _is_file(path: Path) -> bool:
    with suppress(OSError):
        return path.is_file()
    return False


def _read(case: CaseOnDisk, pictures: Path) -> CaseRow:
    """The line of a case that can be read.

    Raises
    ------
    OSError, ValueError
        In words, when it cannot.
    """
    if case.problem:
        raise ValueError(case.problem)
    if case.running:
        return CaseRow(case.name, "RUNNING", reasons=(case.done,))
    record = load_record(case.folder)
    if record is None and case.records[RUN_FILE]:
        raise ValueError(f"{RUN_FILE} is damaged")
    if record is None or record.outcome is None:
        action = f"The run goes on where it stopped: ct2lut run {case.name}."
        return CaseRow(case.name, "NOT FINISHED", reasons=(case.done,), action=action)
    if record.outcome.case_id != case.name:
        raise ValueError("they were made for a case of another name")
    if record.outcome.code is not None:
        return _stopped(case, record.outcome)
    return _finished(case, record.outcome, pictures)


def _stopped(case: CaseOnDisk, last: RunOutcome) -> CaseRow:
    """A case that was refused, or that failed; its side only where this run established it."""
    stage = case.stages.get(CASE_FACTS.name)
    body_part = ""
    if stage and any(one.stage == stage.name and one.state in ("ran", "cached") for one in last.stages):
        with suppress(ValueError):
            body_part = _body_part(_decoded(CASE_FACTS, case.records[f"{stage.folder}/{CASE_FACTS.file}"]))
    told = f"{case.name}/{PAGE}" == case.report and any(one.state == "failed" for one in last.stages)
    return CaseRow(
        case.name,
        last.word,
        body_part,
        (f"{last.code}  {last.problem}",),
        last.action or "",
        report=case.report if told else "",
        computing_s=_computing_s(last),
    )


def _finished(case: CaseOnDisk, last: RunOutcome, pictures: Path) -> CaseRow:
    every = [finding for stage in last.stages for finding in stage.findings]
    reviews = tuple(dict.fromkeys(one.message for one in every if one.severity is Severity.REVIEW))
    if VERDICT.name not in case.stages:
        return CaseRow(case.name, last.word, reasons=reviews, report=case.report, computing_s=_computing_s(last))
    qa = case.stages[VERDICT.name]
    manifest = load_manifest(case.folder / qa.folder)
    if isinstance(manifest, Unusable):
        raise ValueError(f"{qa.folder}: {manifest.reason}")
    verdict = _decoded(VERDICT, _recorded(case, manifest, VERDICT.file))
    more = len(set(reviews) - set(verdict.reasons))
    return CaseRow(
        case.name,
        last.word,
        _body_part(_facts(case, manifest)),
        verdict.reasons + ((f"And {more} more in the report.",) if more else ()),
        numbers=tuple(_numbers(verdict)),
        report=case.report,
        pictures=_strip(case, manifest, pictures),
        review=_review(case),
        computing_s=_computing_s(last),
    )


def _computing_s(last: RunOutcome) -> float:
    return round(sum(stage.computing_s for stage in last.stages), 3)


def _recorded(case: CaseOnDisk, manifest: Manifest, name: str) -> bytes:
    """A file of the stage that judged, exactly as it was written."""
    shown = f"{case.stages[VERDICT.name].folder}/{name}"
    data = _content(case.folder / shown)
    if isinstance(data, str):
        raise ValueError(f"{shown}: {data}")
    if name not in manifest.outputs or fingerprint(data).sha256 != manifest.outputs[name].sha256:
        raise ValueError(f"{shown} is missing or was altered")
    return data


def _facts(case: CaseOnDisk, manifest: Manifest) -> CaseFacts:
    """The facts of the case, from which the verdict was made and no others."""
    name = f"{case.stages[CASE_FACTS.name].folder}/{CASE_FACTS.file}"
    read = manifest.recipe.inputs.get(CASE_FACTS.name)
    if read is None or fingerprint(case.records[name]).sha256 != read.sha256:
        raise ValueError(f"{name} is not the one that the report was made from")
    return _decoded(CASE_FACTS, case.records[name])


def _decoded(artifact: Artifact[T], data: bytes) -> T:
    try:
        return artifact.decode({"": data})
    except ValueError as error:
        raise ValueError(f"{artifact.file} was made by another version of the program") from error


def _review(case: CaseOnDisk) -> str:
    try:
        line = review_line(ReviewedCase(case.name, case.folder, case.flow[-1]))
    except EnvironmentFault as error:
        raise ValueError(error.problem) from error
    return (line or "").removeprefix("review: ")


def _body_part(facts: CaseFacts) -> str:
    return f"{facts.side.upper()} {facts.joint}"


def _numbers(verdict: Verdict) -> Iterator[Number]:
    for one in verdict.metrics:
        if one.name in COLUMNS and math.isfinite(one.value):
            yield Number(one.name, one.title, one.unit, one.value, one.state == "review")


def _strip(case: CaseOnDisk, manifest: Manifest, pictures: Path) -> str:
    """Name of the strip, which is that of its content; empty for a report without any of the pictures."""
    from pipeline.adapters.thumbnails import panel_of_sheet, strip_jpeg  # noqa: PLC0415 - nothing new, nothing drawn

    sheets = {name: f"{REPORT.file}images/{name}.png" for name in PANELS}
    there = {name: manifest.outputs[file].sha256 for name, file in sheets.items() if file in manifest.outputs}
    if not there:
        return ""
    strip = f"{hashlib.sha256(repr((PANELS, there)).encode()).hexdigest()[:32]}.jpg"
    if not _is_file(pictures / strip):
        data = {name: _recorded(case, manifest, sheets[name]) for name in there}
        panels = [panel_of_sheet(data.get(name, b""), HEADER_PX, place) for name, place in PANELS.items()]
        replace_file(pictures / strip, strip_jpeg(panels))
    return strip
