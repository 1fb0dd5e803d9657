"""What a cohort's ledgers and logs tell about how it went: who was at work when, and what was done twice."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from pipeline.cohort.ledger import events
from pipeline.cohort.place import CohortPlace


@dataclass(frozen=True)
class Span:
    """From when to when, seconds since the epoch."""

    begin: float
    end: float

    @property
    def seconds(self) -> float:
        return self.end - self.begin

    def overlap(self, other: Span) -> float:
        """Seconds in both."""
        return max(0.0, min(self.end, other.end) - max(self.begin, other.begin))


@dataclass(frozen=True)
class CaseSpan:
    """One process of a case.

    Attributes
    ----------
    case_id : str
    span : Span
    known : bool
        Whether the case had a result before.
    killed : bool
    """

    case_id: str
    span: Span
    known: bool
    killed: bool


def ended_ids(place: CohortPlace) -> frozenset[str]:
    """Cases that have a result, by the ledgers."""
    ended = (event for path in _ledgers(place) for event in events(path.read_bytes()) if event.end)
    return frozenset(event.id for event in ended if event.end and not event.end.transient)


def working_ids(place: CohortPlace) -> frozenset[str]:
    """Cases at work, or killed while they were, by the ledgers."""
    last = {event.id: event for path in _ledgers(place) for event in events(path.read_bytes())}
    return frozenset(name for name, event in last.items() if event.end is None)


def case_spans(place: CohortPlace, all_killed: Sequence[float]) -> tuple[CaseSpan, ...]:
    """Every process of a case; one that never ended lived until the next moment at which everything was killed."""
    return tuple(span for path in _ledgers(place) for span in _spans(path, all_killed))


def _ledgers(place: CohortPlace) -> list[Path]:
    return sorted((place.files / "ledger").glob("*.jsonl"))


def _spans(path: Path, all_killed: Sequence[float]) -> Iterator[CaseSpan]:
    begun: dict[str, float] = {}
    known: set[str] = set()
    for event in events(path.read_bytes()):
        now = datetime.fromisoformat(event.ts).timestamp()
        if event.id in begun and event.end is None:
            yield _killed(event.id, begun.pop(event.id), [*all_killed, now])
        if event.end is None:
            begun[event.id] = now
        elif event.id in begun:
            yield CaseSpan(event.id, Span(begun.pop(event.id), now), event.id in known, killed=False)
            known.add(event.id)
    yield from (_killed(name, since, all_killed) for name, since in begun.items())


def _killed(name: str, since: float, moments: Sequence[float]) -> CaseSpan:
    return CaseSpan(name, Span(since, min(moment for moment in moments if moment >= since)), False, killed=True)


@dataclass(frozen=True)
class Repeats:
    """Stages of cases, counted over the logs of a cohort.

    Attributes
    ----------
    computed_twice : tuple of str
        ``ID stage`` that ended with a result more than once.
    begun_twice : tuple of str
        Those that began more than once, because they were killed, and ended with a result once.
    refused_twice : tuple of str
        Those that ended in a refusal more than once.
    computed : int
        Stages that ended with a result.
    """

    computed_twice: tuple[str, ...]
    begun_twice: tuple[str, ...]
    refused_twice: tuple[str, ...]
    computed: int


def repeats(results: Path, ids: Sequence[str]) -> Repeats:
    """Count what the log of each case says of its stages."""
    counts: dict[str, Counter[str]] = {"runs": Counter(), "ran": Counter(), "failed": Counter()}
    for name in ids:
        for stage, first in _told(results / name / "log.jsonl"):
            if first in counts:
                counts[first][f"{name} {stage}"] += 1
    twice = {word: tuple(sorted(what for what, n in found.items() if n > 1)) for word, found in counts.items()}
    return Repeats(twice["ran"], twice["runs"], twice["failed"], counts["ran"].total())


def _told(log: Path) -> Iterator[tuple[str, str]]:
    """Stage, and the word that its line begins with."""
    for line in log.read_text().splitlines():
        try:
            event = json.loads(line)
        except ValueError:
            continue  # torn by a kill
        if event["stage"]:
            yield event["stage"], event["msg"].replace(":", ",").partition(",")[0]
