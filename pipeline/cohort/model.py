"""What a cohort is made of: its cases, the limits of each, how each ended, and what was asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.engine.outcome import Word


@dataclass(frozen=True)
class ListedCase:
    """A case of a list: its ID, already checked, and the folder that its user brought."""

    case_id: str
    folder: Path


@dataclass(frozen=True)
class CaseLimits:
    """What the process of one case, with all that it starts, may use.

    Attributes
    ----------
    memory_mb : int
        Resident memory of all its processes together; 0 means no limit.
    time_s : float
        Wall time; 0 means no limit.
    """

    memory_mb: int = 0
    time_s: float = 0.0


@dataclass(frozen=True)
class CaseEnd:
    """How the process of one case ended.

    Attributes
    ----------
    case_id : str
    word : "PASS", "REVIEW", "REJECTED" or "ERROR"
    code, problem, action : str
        Why it did not reach the end; empty where it did.
    seconds : float
        Wall time of the process.
    peak_mb : float
        Most resident memory that was seen of it and all that it started.
    transient : bool
        Whether the machine was at fault and not the case, so that another attempt may go well.
    """

    case_id: str
    word: Word
    code: str = ""
    problem: str = ""
    action: str = ""
    seconds: float = 0.0
    peak_mb: float = 0.0
    transient: bool = False

    @property
    def finished(self) -> bool:
        """Whether there is a package."""
        return self.word in ("PASS", "REVIEW")


@dataclass(frozen=True)
class CohortRequest:
    """What was asked for; ``plan.json`` keeps it for the batches and for ``ct2lut resume``.

    Attributes
    ----------
    cases : str
        Folder with one folder a case, or a list (``.csv``); absolute.
    protocol : str
        Name, or absolute path of a ``.yaml`` file.
    overrides : tuple of str
        ``stage.key=value``.
    jobs : int
        Processes of one case.
    limits : CaseLimits
        Of one case.
    buckets : int
        Number of batches; 0 means that each case is a batch of its own.
    """

    cases: str
    protocol: str
    overrides: tuple[str, ...] = ()
    jobs: int = 1
    limits: CaseLimits = CaseLimits()
    buckets: int = 0


@dataclass(frozen=True)
class Plan:
    """``plan.json``.

    Attributes
    ----------
    format : int
    request : CohortRequest
    key : str
        SHA-256 over all but the cases that decides results: version, code, settings. Batches run again when it changes.
    batches : mapping of str to tuple of str
        Name of a batch -> IDs of its cases.
    """

    format: int
    request: CohortRequest
    key: str
    batches: Mapping[str, tuple[str, ...]]
