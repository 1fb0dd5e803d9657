"""What a run asks for, what it reports while it goes, and how it ended."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

from pipeline.engine.records import record_artifact
from pipeline.engine.stage import Findings, Severity
from pipeline.engine.store import read_file, replace_file
from pipeline.errors import ExitCode

Word = Literal["PASS", "REVIEW", "REJECTED", "ERROR"]
State = Literal["ran", "cached", "failed", "not reached"]


@dataclass(frozen=True)
class CaseJob:
    """One case: its name, the folder its user brought, and the folder of its results (``RESULTS/<ID>``)."""

    case_id: str
    source: Path
    results: Path


@dataclass(frozen=True)
class Execution:
    """What decides how a run goes and never what it gives.

    Attributes
    ----------
    jobs : int
        Worker processes.
    get_ready : callable
        Called while a stage with limits works in its own process: begins what later stages need, and returns at once.
    """

    jobs: int
    get_ready: Callable[[], None] = lambda: None


@dataclass(frozen=True)
class StageOutcome:
    """How one stage ended.

    Attributes
    ----------
    stage, number : str, int
    state : "ran", "cached", "failed" or "not reached"
    reason : str
        Why it ran, ``up to date``, or the code of the failure.
    seconds : float
        Wall time in this run.
    findings : tuple of Finding
        Also of a stage whose result was taken from disk.
    computing_s : float
        Seconds its result took to compute, in this run or an earlier one.
    parts : dict of str to float
        What of that the stage told by itself, in words -> seconds.
    """

    stage: str
    number: int
    state: State
    reason: str
    seconds: float
    findings: Findings
    computing_s: float = 0.0
    parts: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class RunOutcome:
    """How a run ended; ``code``, ``problem`` and ``action`` say why where it did not reach the end."""

    case_id: str
    word: Word
    exit_code: ExitCode
    stages: tuple[StageOutcome, ...]
    code: str | None
    problem: str | None
    action: str | None


class Listener(Protocol):
    """Who shows the run to a person; ``index`` counts from 1, stages are given by name."""

    def stage_started(self, stage: str, index: int, total: int, reason: str) -> None:
        """A stage begins to compute, for this reason."""
        ...

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        """A computing stage is this far."""
        ...

    def stage_finished(self, outcome: StageOutcome, index: int, total: int) -> None:
        """A stage computed, was taken from disk, or failed."""
        ...


@dataclass(frozen=True)
class RunRecord:
    """``run.json``: what is known of the last run; it has an outcome once it is finished."""

    state: Literal["running", "interrupted", "finished"]
    outcome: RunOutcome | None


_RUN = record_artifact("run", "run.json", RunRecord)


def save_record(results: Path, record: RunRecord) -> None:
    """Replace ``run.json``.

    Raises
    ------
    EnvironmentFault
    """
    replace_file(results / _RUN.file, _RUN.encode(record)[""])


def load_record(results: Path) -> RunRecord | None:
    """Read ``run.json``; None where there is none that can be understood."""
    try:
        return _RUN.decode({"": read_file(results / _RUN.file)})
    except (OSError, ValueError):
        return None


def word_of(outcomes: Iterable[StageOutcome]) -> Literal["PASS", "REVIEW"]:
    """The word of a run whose stages all have a result."""
    findings = [finding for outcome in outcomes for finding in outcome.findings]
    return "REVIEW" if any(finding.severity is Severity.REVIEW for finding in findings) else "PASS"
