"""The history of a batch: one JSON object a line, appended in one system call. History, never truth."""

from __future__ import annotations

import hashlib
import json
import socket
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from pipeline.cohort.model import CaseEnd
from pipeline.engine.runlog import append_line

What = Literal["started", "ended"]


@dataclass(frozen=True)
class Event:
    """One line.

    Attributes
    ----------
    ts : str
        UTC, ISO 8601.
    host : str
    what : "started" or "ended"
    id : str
    key : str
        Of the plan and the case as it was listed: an event of another key is of an older request.
    attempt : int
        From 1.
    end : CaseEnd or None
        Of a case that ended.
    """

    ts: str
    host: str
    what: What
    id: str
    key: str
    attempt: int
    end: CaseEnd | None


@dataclass(frozen=True)
class Ledger:
    """The ledger of one batch."""

    path: Path
    attempt: int = 1

    def started(self, case_id: str, key: str) -> None:
        """A case begins."""
        self._append("started", case_id, key, None)

    def ended(self, end: CaseEnd, key: str) -> None:
        """A case ended."""
        self._append("ended", end.case_id, key, end)

    def _append(self, what: What, case_id: str, key: str, end: CaseEnd | None) -> None:
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        append_line(self.path, asdict(Event(now, socket.gethostname(), what, case_id, key, self.attempt, end)))


def event_key(plan_key: str, signature: str, tries: int) -> str:
    """What an event belongs to: the plan, the case as it was listed, and how often it was asked for again."""
    return hashlib.sha256(f"{plan_key} {signature} {tries}".encode()).hexdigest()[:16]


def events(data: bytes) -> Iterator[Event]:
    """The events of complete lines; a line that cannot be understood is passed over."""
    for line in data.splitlines():
        try:
            fields = json.loads(line)
            end = CaseEnd(**fields.pop("end")) if fields.get("end") else None
            yield Event(**{**fields, "end": end})
        except (ValueError, TypeError, AttributeError, KeyError):
            continue
