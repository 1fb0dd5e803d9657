"""The contract of a stage: a record, not a base class."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol, TypeVar

from pydantic import BaseModel, ConfigDict

from pipeline.engine.artifacts import Artifact
from pipeline.engine.records import record_artifact

T = TypeVar("T")


class StrictParams(BaseModel):
    """Settings of one stage: frozen, no unknown keys, no silent conversion, no NaN or infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Severity(StrEnum):
    """How much a finding matters: a note informs, a review asks a person to look before the result is used."""

    NOTE = "note"
    REVIEW = "review"


@dataclass(frozen=True)
class Finding:
    """Something a reader of the result must know; ``code`` such as ``W-FOV-01`` is stable and documented."""

    code: str
    severity: Severity
    message: str


Findings = tuple[Finding, ...]


def findings_of(stage: str) -> Artifact[Findings]:
    """The findings of a stage, which the runner writes beside its artifacts; a later stage may read them."""
    return record_artifact(f"{stage}_findings", "findings.json", tuple[Finding, ...])


def settings_of(stage: str) -> Artifact[dict[str, Any]]:
    """The settings that a stage ran with, which the runner writes beside its artifacts; a later stage may read them."""
    return record_artifact(f"{stage}_settings", "settings.json", dict[str, Any])


class Inputs(Protocol):
    """What a stage is given: ``reads[ARTIFACT]`` decodes that artifact, typed."""

    def __getitem__(self, artifact: Artifact[T]) -> T:
        """The decoded value of an artifact that the stage declares in ``reads``; KeyError for any other."""
        ...


class Outputs(Protocol):
    """Where a stage puts its results, and what it may know of the execution (which never changes a result)."""

    @property
    def jobs(self) -> int:
        """How many worker processes the stage may use."""
        ...

    def __setitem__(self, artifact: Artifact[T], value: T) -> None:
        """Encode and hold an artifact that the stage declares in ``writes``; KeyError for any other."""
        ...

    def progress(self, done: int, total: int) -> None:
        """Tell the user how far the stage is."""
        ...

    def took(self, part: str, seconds: float) -> None:
        """Note how long a part of the stage took, in words for people; parts may have run side by side."""
        ...


@contextmanager
def timed(out: Outputs, part: str) -> Iterator[None]:
    """Note how long what is done inside took."""
    since = time.perf_counter()
    yield
    out.took(part, time.perf_counter() - since)


@dataclass(frozen=True)
class Limits:
    """What the child process of a confined stage may use.

    Attributes
    ----------
    memory_bytes : int
        Beyond what it begins with; never more than three quarters of the computer's memory.
    wall_s : float
        Seconds, of the clock and of the processor.
    """

    memory_bytes: int = 16_000_000_000
    wall_s: float = 600.0


@dataclass(frozen=True)
class Stage:
    """One step of the flow.

    Attributes
    ----------
    number, name : int, str
        The folder of its results is ``{number}_{name}``.
    reads, writes : tuple of Artifact
        All it may see and all it leaves; each artifact has one writer.
    Params : type
        Frozen, strict settings (a subclass of StrictParams): unit in each name, range on each number.
    run : callable
        ``run(reads, params, out) -> Findings``; loads, calls the maths, saves.
    resources : tuple of str
        Package data files (``package:file``) that decide its output besides code, such as report templates.
    limits : Limits, optional
        Of a stage that reads foreign bytes: it works in a sealed child process of its own, with these limits, and
        cannot start processes. Without them it works in the process of the run.
    """

    number: int
    name: str
    reads: tuple[Artifact[Any], ...]
    writes: tuple[Artifact[Any], ...]
    Params: type[StrictParams]
    run: Callable[[Inputs, Any, Outputs], Findings]
    resources: tuple[str, ...] = field(default=())
    limits: Limits | None = None

    @property
    def folder(self) -> str:
        """Name of its results folder."""
        return f"{self.number}_{self.name}"
