"""What is going on in a cohort, read from the ledgers of its batches; of each ledger only what is new."""

from __future__ import annotations

import math
import os
import shutil
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean

from pipeline.cohort.batches import load_batch, load_plan
from pipeline.cohort.ledger import Event, event_key, events
from pipeline.cohort.model import CaseEnd, Plan
from pipeline.cohort.place import CohortPlace
from pipeline.engine.lock import is_running
from pipeline.engine.runlog import printable

#: A case that ends sooner was up to date or was refused: it says nothing of how long the others take.
COMPUTED_S = 3.0
#: So many looks with cases at work decide how many are taken to work at a time.
LOOKS = 30
#: So many IDs of running cases are named.
NAMED = 4
#: Seconds between two looks at least; and a look may take a twentieth of the time.
EVERY_S = 1.0
SHARE = 20
#: Seconds between two lines of progress where lines stay.
LINE_S = 60.0

_WIPE = "\r\x1b[2K"

Write = Callable[[str], object]
Clock = Callable[[], float]


@dataclass(frozen=True)
class Progress:
    """How far a cohort is.

    Attributes
    ----------
    total, done : int
        Cases of the plan, and those of them that have a result of this request.
    passed, review, rejected, failed : int
        Of those that are done, by their word; ``failed`` is ERROR.
    running : tuple of str
        IDs at work, sorted.
    elapsed_s : float
        Since the watcher began.
    left_s : float or None
        Estimate; None until two cases were computed, and when nothing is left.
    ended : tuple of CaseEnd
        What ended since the look before, also in a fault of the machine, which is tried again.
    """

    total: int
    done: int = 0
    passed: int = 0
    review: int = 0
    rejected: int = 0
    failed: int = 0
    running: tuple[str, ...] = ()
    elapsed_s: float = 0.0
    left_s: float | None = None
    ended: tuple[CaseEnd, ...] = ()


@dataclass
class _Log:
    """One ledger: how far it was read, and the event key of each of its cases."""

    path: Path
    keys: dict[str, str]
    read_to: int = 0

    def news(self, size: int) -> Iterator[Event]:
        """Events of this request in the complete lines that were not read yet; from the start where it was replaced."""
        begin = self.read_to if size >= self.read_to else 0
        data = _bytes_from(self.path, begin)
        whole = data[: data.rfind(b"\n") + 1]
        self.read_to = begin + len(whole)
        return (event for event in events(whole) if self.keys.get(event.id) == event.key)


@dataclass
class _Pace:
    """How quickly cases are computed."""

    computed: int = 0
    seconds: float = 0.0
    at_once: deque[int] = field(default_factory=lambda: deque(maxlen=LOOKS))

    def note(self, ended: Sequence[CaseEnd], running: int) -> None:
        for end in ended:
            if end.seconds >= COMPUTED_S and not end.transient:
                self.computed, self.seconds = self.computed + 1, self.seconds + end.seconds
        if running:
            self.at_once.append(running)

    def left_s(self, waiting: int, running: int) -> float | None:
        """Time for so many cases, of which those at work are half-way on average."""
        if self.computed < 2 or not waiting:
            return None
        at_once = fmean(self.at_once) if self.at_once else 1.0
        return (waiting - running / 2) * self.seconds / self.computed / at_once


class Watcher:
    """Follows the ledgers of a plan.

    What ended before the watcher began counts as done, and is not reported as ended.

    Parameters
    ----------
    place : CohortPlace
    plan : Plan
        Its lists are read once.
    clock : callable
        Monotonic seconds.

    Raises
    ------
    ConfigError, EnvironmentFault
        When the list of a batch cannot be read.
    """

    def __init__(self, place: CohortPlace, plan: Plan, clock: Clock) -> None:
        self._place, self._clock, self._begun, self._host = place, clock, clock(), socket.gethostname()
        logs = (_Log(place.ledger(name), _keys(place, plan, name)) for name in plan.batches)
        self._logs = {log.path.name: log for log in logs}
        self._total = sum(map(len, plan.batches.values()))
        self._ends: dict[str, CaseEnd] = {}
        self._started: dict[str, Event] = {}
        self._pace = _Pace()
        self._read()
        self._old = frozenset(self._started.values())

    def look(self) -> Progress:
        """How far it is now; a ledger that cannot be read at this moment is read the next time."""
        ended = self._read()
        running = tuple(sorted(case_id for case_id in self._started if self._is_running(case_id)))
        self._pace.note(ended, len(running))
        words = [end.word for end in self._ends.values()]
        return Progress(
            self._total,
            len(words),
            words.count("PASS"),
            words.count("REVIEW"),
            words.count("REJECTED"),
            words.count("ERROR"),
            running,
            self._clock() - self._begun,
            self._pace.left_s(self._total - len(words), len(running)),
            ended,
        )

    def _read(self) -> tuple[CaseEnd, ...]:
        news = [event for log, size in self._grown() for event in log.news(size)]
        return tuple(end for event in sorted(news, key=lambda event: str(event.ts)) for end in self._take(event))

    def _grown(self) -> Iterator[tuple[_Log, int]]:
        """Ledgers whose size is not what was read, from one listing of their folder."""
        try:
            entries = list(os.scandir(self._place.ledger("any").parent))
        except OSError:
            return
        for entry in entries:
            log = self._logs.get(entry.name)
            if log and (size := _size(entry)) != log.read_to:
                yield log, size

    def _take(self, event: Event) -> Iterator[CaseEnd]:
        self._ends.pop(event.id, None)
        self._started.pop(event.id, None)
        if event.what == "started":
            self._started[event.id] = event
        elif event.end is not None:
            if not event.end.transient:
                self._ends[event.id] = event.end
            yield event.end

    def _is_running(self, case_id: str) -> bool:
        """Whether a case that began is at work.

        Locks of another machine are not seen on every file system: there its own word is taken, unless it is older
        than this watcher, which may have begun because that machine is gone.
        """
        event = self._started[case_id]
        there = event.host != self._host and event not in self._old
        return there or is_running(self._place.results / case_id)


def progress_line(progress: Progress) -> str:
    """Such as ``57 of 200 done (50 PASS, 4 REVIEW, 3 failed), 2 running: P058 P061, about 41 min left``."""
    failed = progress.rejected + progress.failed
    counts = {"PASS": progress.passed, "REVIEW": progress.review, "failed": failed}
    told = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    head = f"{progress.done} of {progress.total} done" + (f" ({told})" if told else "")
    left = "" if progress.left_s is None else f"about {_duration(progress.left_s)} left"
    return printable(", ".join(filter(None, [head, _running(progress.running), left])))


def cohort_line(place: CohortPlace) -> str | None:
    """How far the last cohort of a results folder is; None where there was none.

    Raises
    ------
    ConfigError, EnvironmentFault
        When its plan cannot be read.
    """
    if not place.plan.exists():
        return None
    return f"cohort: {progress_line(Watcher(place, load_plan(place), time.monotonic).look())}"


def ended_line(end: CaseEnd, progress: Progress) -> str:
    """Such as ``[ 57/200] P057   PASS        23 s``; of a failure also why, and below it what to do.

    ``progress.done`` is the number of the case.
    """
    width = len(str(progress.total))
    head = f"[{progress.done:>{width}}/{progress.total}] {end.case_id:<8} {end.word:<8} {end.seconds:5.0f} s"
    if not end.code:
        return printable(head)
    again = " (the machine was at fault; it is tried again)" if end.transient else ""
    first = f"{head}  {end.code}  {end.problem}{again}"
    return "\n".join(printable(line).rstrip() for line in (first, f"{'':{2 * width + 4}}{end.action}") if line.strip())


def ended_lines(progress: Progress) -> tuple[str, ...]:
    """One text for each case that ended since the look before, numbered in their order."""
    number = progress.done - sum(not end.transient for end in progress.ended)
    texts = []
    for end in progress.ended:
        number += not end.transient
        texts.append(ended_line(end, replace(progress, done=max(number, 0))))
    return tuple(texts)


class Reporter:
    """Tells a person how far a cohort is.

    On a terminal one line is drawn again and again, and above it stay the cases that have no table. Elsewhere each case
    that ended is a line, and once a minute there is a line of progress.

    Parameters
    ----------
    place : CohortPlace
    plan : Plan
    write : callable
        Takes text as it is to appear, with its line ends.
    terminal : bool
    clock : callable
        Monotonic seconds.

    Raises
    ------
    ConfigError, EnvironmentFault
        When the list of a batch cannot be read.
    """

    def __init__(
        self, place: CohortPlace, plan: Plan, write: Write, *, terminal: bool, clock: Clock = time.monotonic
    ) -> None:
        self._watcher, self._clock = Watcher(place, plan, clock), clock
        self._write, self._terminal = write, terminal
        self._next = self._next_line = -math.inf
        self._told = ""

    def tick(self) -> None:
        """Look and tell, if it is time; to be called about once a second."""
        if (begun := self._clock()) >= self._next:
            self._tell(self._watcher.look(), last=False)
            now = self._clock()
            self._next = now + max(EVERY_S, SHARE * (now - begun))

    def close(self) -> None:
        """Tell what ended since, and how far it is; nothing is drawn over after that."""
        self._tell(self._watcher.look(), last=True)

    def _tell(self, progress: Progress, *, last: bool) -> None:
        for text, end in zip(ended_lines(progress), progress.ended, strict=True):
            if not self._terminal or end.code:
                self._write(f"{_WIPE * self._terminal}{text}\n")
        line = progress_line(progress)
        if self._terminal:
            self._write(f"{_WIPE}{line}\n" if last else f"{_WIPE}{line[: shutil.get_terminal_size().columns - 1]}")
        elif line != self._told and (last or self._clock() >= self._next_line):
            self._write(f"{line}\n")
            self._next_line, self._told = self._clock() + LINE_S, line


def _keys(place: CohortPlace, plan: Plan, name: str) -> dict[str, str]:
    return {one.case.case_id: event_key(plan.key, one.signature, one.tries) for one in load_batch(place, name)}


def _bytes_from(path: Path, begin: int) -> bytes:
    try:
        with path.open("rb") as stream:
            stream.seek(begin)
            return stream.read()
    except OSError:
        return b""


def _size(entry: os.DirEntry[str]) -> int:
    try:
        return entry.stat(follow_symlinks=False).st_size
    except OSError:
        return 0


def _running(ids: Sequence[str]) -> str:
    if not ids:
        return ""
    more = f" and {len(ids) - NAMED} more" if len(ids) > NAMED else ""
    return f"{len(ids)} running: {' '.join(ids[:NAMED])}{more}"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{max(round(seconds), 1)} s"
    if seconds < 90 * 60:
        return f"{round(seconds / 60)} min"
    return f"{round(seconds / 3600)} h" if seconds < 48 * 3600 else f"{round(seconds / 86400)} days"
