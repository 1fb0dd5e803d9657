"""The watch of a server: new case folders are run once they are complete, one after another, for months.

The watch itself decides nothing about results: a case that is run once more than needed costs a look at the cache.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import PurePath

from pipeline.cohort.batch import refuse_full_disk
from pipeline.cohort.model import CaseEnd, ListedCase
from pipeline.cohort.place import CohortPlace
from pipeline.cohort.watching.inbox import Inbox, Watch, list_inbox
from pipeline.engine.lock import Held, hold
from pipeline.engine.records import record_artifact
from pipeline.engine.runlog import printable
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import make_folder, read_file, replace_file
from pipeline.errors import ConfigError, EnvironmentFault

#: Cases in a row that end in the same error: it is probably not theirs.
_SYSTEMIC = 3
_SYSTEMIC_PAUSE_S = 600.0
#: Between two looks at a disk that is full or gone.
_STORAGE_PAUSE_S = 60.0
#: Looking takes a tenth of the time at most, however many files there are.
_LOOKS_SHARE = 10
_FORMAT = 1


@dataclass(frozen=True)
class Memory:
    """``watch.json``: case ID -> signature of its folder when it was run."""

    format: int
    done: dict[str, str]


_MEMORY = record_artifact("watch", "watch.json", Memory)


@dataclass(frozen=True)
class Pace:
    """Where a watch has its time from, and when it ends; a test gives others.

    Attributes
    ----------
    now : callable
        Seconds of a clock that never jumps.
    sleep : callable
        Waits so many seconds.
    stop : callable
        Asked between looks and between cases; the watch ends where it says so.
    """

    now: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep
    stop: Callable[[], bool] = lambda: False


REAL_PACE = Pace()


def watch(
    asked: Watch,
    place: CohortPlace,
    run: Callable[[ListedCase], CaseEnd],
    say: Callable[[str], None],
    pace: Pace = REAL_PACE,
) -> None:
    """Run each case folder once it is complete, and again when it has changed, until told to stop.

    A disk that is full or gone and a cases folder that cannot be read are told once and waited for.

    Parameters
    ----------
    asked : Watch
    place : CohortPlace
        Its folder is made if it is not there.
    run : callable
        Processes one case, with its limits and its ledger. An EnvironmentFault it raises counts as a fault of the
        machine: the case is tried again.
    say : callable
        Takes one line for a person, printable.
    pace : Pace

    Raises
    ------
    ConfigError
        As :func:`check_watch`.
    EnvironmentFault
        ``E-WCH-01`` where another watch is at work on these results; other codes where the results folder cannot be
        used at the start.
    KeyboardInterrupt
        From the clock or from ``run``; a case that was at work is run again by the next watch.
    """
    check_watch(asked, place)
    with _alone(place):
        loop = _Loop(Inbox(asked, _remembered(place), list_inbox, pace.now), place, run, say, pace)
        loop.tell(
            f"watching; a case is run when its folder has not changed for {asked.settle_s:g} s{_with(asked.marker)}"
        )
        while not pace.stop():
            loop.step()


def check_watch(asked: Watch, place: CohortPlace) -> None:
    """Refuse a watch that cannot work.

    Raises
    ------
    ConfigError
        ``E-WCH-02`` when cases and results lie inside each other, ``E-WCH-03`` for a number and ``E-WCH-06`` for the
        name of a marker that cannot be.
    """
    cases, results = asked.cases.resolve(), place.results.resolve()
    if results.is_relative_to(cases) or cases.is_relative_to(results):
        problem = "The cases folder and the results folder lie inside each other."
        raise ConfigError("E-WCH-02", problem, "Choose two folders beside each other.")
    for name, value in (("settle", asked.settle_s), ("every", asked.every_s)):
        if not 0 < value <= 86_400:
            problem = f"The seconds of --{name} are {value:g}; expected more than 0 and at most 86400."
            raise ConfigError("E-WCH-03", problem, f"Give another number, such as --{name} 60.")
    if asked.marker and (PurePath(asked.marker).name != asked.marker or not asked.marker.isprintable()):
        problem = "The name of the marker file is not the plain name of a file."
        raise ConfigError("E-WCH-06", problem, "Name a file that lies in the case folder itself, such as .complete.")


@dataclass
class _Loop:
    """One watch while it goes on."""

    inbox: Inbox
    place: CohortPlace
    run: Callable[[ListedCase], CaseEnd]
    say: Callable[[str], None]
    pace: Pace
    held_by: str = ""
    not_before: float = field(default=float("-inf"))
    same: tuple[str, int] = ("", 0)

    def tell(self, line: str) -> None:
        self.say(printable(line))

    def step(self) -> None:
        """One look, and one case if one is ready."""
        begun = self.pace.now()
        fault, case = self._next()
        if fault:
            self._hold(fault)
            return
        self._go_on()
        if case:
            self._case(case)
        else:
            self.pace.sleep(max(self.inbox.watch.every_s, (_LOOKS_SHARE - 1) * (self.pace.now() - begun)))

    def _next(self) -> tuple[EnvironmentFault | None, ListedCase | None]:
        """Why nothing can be run now, and the case to run."""
        try:
            ready = self.inbox.look()
        except EnvironmentFault as fault:
            return fault, None
        for sentence in self.inbox.news():
            self.tell(sentence)
        if not ready or self.pace.now() < self.not_before:
            return None, None
        return _hindrance(self.place, self.inbox), ready[0]

    def _case(self, case: ListedCase) -> None:
        self.tell(f"{case.case_id}  complete, runs now")
        try:
            end = self.run(case)
        except EnvironmentFault as fault:
            end = CaseEnd(case.case_id, "ERROR", fault.code, fault.problem, fault.action, transient=True)
        again_s = self.inbox.ended(end)
        for line in _lines(end, again_s):
            self.tell(line)
        with suppress(EnvironmentFault):  # the next case waits until it can be written
            _remember(self.place, self.inbox)
        self._count(end)

    def _count(self, end: CaseEnd) -> None:
        code, times = self.same
        self.same = (end.code, times + 1 if end.code == code else 1) if end.word == "ERROR" else ("", 0)
        if self.same[1] >= _SYSTEMIC:
            self.not_before = self.pace.now() + _SYSTEMIC_PAUSE_S
            pause = f"{_SYSTEMIC_PAUSE_S / 60:.0f} min"
            self.tell(f"{self.same[1]} cases in a row ended with {end.code}: pause of {pause}. {end.action}")

    def _hold(self, fault: EnvironmentFault) -> None:
        if self.held_by != fault.code:
            self.tell(f"waiting: {fault.code} {fault.problem} The watch goes on by itself when that is mended.")
        self.held_by = fault.code
        self.pace.sleep(_STORAGE_PAUSE_S)

    def _go_on(self) -> None:
        if self.held_by:
            self.tell("goes on")
        self.held_by = ""


def _hindrance(place: CohortPlace, inbox: Inbox) -> EnvironmentFault | None:
    """Why no case can have a result now; None where nothing is seen."""
    try:
        if not place.files.is_dir():
            raise EnvironmentFault("E-WCH-05", "The results folder is gone, or its disk is not mounted.", "Mount it.")
        refuse_full_disk(place)
        _remember(place, inbox)
    except EnvironmentFault as fault:
        return fault
    return None


def _lines(end: CaseEnd, again_s: float | None) -> Iterator[str]:
    why = f"  {end.code} {end.problem}" if end.code else ""
    yield f"{end.case_id}  {end.word}  {end.seconds:.0f} s{why}"
    if end.code:
        yield f"    {end.action}"
    if again_s is not None:
        yield f"    The machine is at fault, not the case: it is tried again in {again_s / 60:.0f} min."
    elif end.transient:
        yield "    It was tried often enough, and is tried again when its folder changes."


def _with(marker: str) -> str:
    return f" and holds the file {marker}" if marker else ""


@contextmanager
def _alone(place: CohortPlace) -> Iterator[None]:
    with storage("Opening the results folder"):
        make_folder(place.files)
    try:
        with hold(place.watch_lock, "the results folder"):
            yield
    except Held as held:
        problem = f"Another watch is at work on this results folder {printable(held.holder)}."
        action = "Leave it to that one, stop it, or name another folder with --results."
        raise EnvironmentFault("E-WCH-01", problem, action) from held


def _remembered(place: CohortPlace) -> dict[str, str]:
    try:
        memory = _MEMORY.decode({"": read_file(place.watch_memory)})
    except (OSError, ValueError):
        return {}
    return memory.done if memory.format == _FORMAT else {}


def _remember(place: CohortPlace, inbox: Inbox) -> None:
    replace_file(place.watch_memory, _MEMORY.encode(Memory(_FORMAT, inbox.done))[""])
