"""All that a process started, and what that started: who lives, how much memory it holds, how it ends (Linux)."""

from __future__ import annotations

import ctypes
import math
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

_PROC = Path("/proc")
_PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 1e6
#: How often to look while waiting for all to end.
_STEP_S = 0.02
#: A process that outlives SIGKILL for so long hangs in the kernel, mostly in a dead network share; nobody can end it.
_UNKILLABLE_S = 10.0
# prctl(2)
_SET_DEATH_SIGNAL, _SET_SUBREAPER, _GET_SUBREAPER = 1, 36, 37
_LIBRARY = ctypes.CDLL(None)


@dataclass(frozen=True)
class Process:
    """What ``/proc/PID/stat`` says of a process; its resident memory in MB."""

    pid: int
    parent: int
    group: int
    is_zombie: bool
    resident_mb: float


@dataclass
class Descendants:
    """A process and all that descends from it.

    Those whose parent ended are found only inside :func:`adopting`.

    Attributes
    ----------
    root : int
    strangers : set of int
        Processes that are left out with all that is theirs, such as every one that was there before; the root itself
        may be one of them.
    awaited : int
        A child of this process that somebody else waits for.
    """

    root: int
    strangers: set[int] = field(default_factory=set)
    awaited: int = 0

    def living(self) -> list[Process]:
        """Those that live. Adopted ones that ended are forgotten by the system."""
        found = self._look()
        for one in found:
            if one.is_zombie and one.parent == os.getpid() and one.pid != self.awaited:
                with suppress(ChildProcessError):
                    os.waitpid(one.pid, os.WNOHANG)
        return [one for one in found if not one.is_zombie]

    def end_by_themselves(
        self, within_s: float, pause: Callable[[float], object] = time.sleep, most_mb: float = math.inf
    ) -> bool:
        """Whether none lives any more after so many seconds at most.

        Parameters
        ----------
        within_s : float
        pause : callable
            Passes so many seconds.
        most_mb : float
            Resident memory of all of them at which the waiting ends.
        """
        until = time.monotonic() + within_s
        while living := self.living():
            if time.monotonic() >= until or resident_mb(living) > most_mb:
                return False
            pause(_STEP_S)
        return True

    def send(self, number: int) -> None:
        """Send a signal to the groups of all that live; none of a group escapes it by forking at this moment."""
        living, ours = self.living(), os.getpgrp()
        for group in {one.group for one in living} - {ours}:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(group, number)
        for one in living:
            if one.group == ours:  # a signal to all of this group would come back to this process
                with suppress(ProcessLookupError, PermissionError):
                    os.kill(one.pid, number)

    def kill(self) -> None:
        """SIGKILL, again and again until none lives; gives up on what the kernel itself does not let go."""
        until = time.monotonic() + _UNKILLABLE_S
        while not self.end_by_themselves(0.0) and time.monotonic() < until:
            self.send(signal.SIGKILL)
            time.sleep(_STEP_S)
        self.living()  # forgets what the last to end had left behind

    def _look(self) -> list[Process]:
        listed = process_ids()
        self.strangers &= listed  # the number of one that ended may be given to one of ours
        found = {one.pid: one for one in map(_process, listed - self.strangers) if one}
        family: set[int] = set()
        more = {self.root}
        while more:
            family |= more
            more = {one.pid for one in found.values() if one.parent in more} - family
        return [one for pid, one in found.items() if pid in family]


def resident_mb(processes: Iterable[Process]) -> float:
    """Sum of the resident memory (RSS) of processes, MB; what they share is counted in each of them."""
    return sum(one.resident_mb for one in processes)


@contextmanager
def adopting() -> Iterator[None]:
    """Inside, what is left behind by a parent that ended becomes a child of this process, not of process 1."""
    before = ctypes.c_int(0)
    _LIBRARY.prctl(_GET_SUBREAPER, ctypes.byref(before), *_zeros(3))
    _LIBRARY.prctl(_SET_SUBREAPER, ctypes.c_ulong(1), *_zeros(3))
    try:
        yield
    finally:
        _LIBRARY.prctl(_SET_SUBREAPER, ctypes.c_ulong(before.value), *_zeros(3))


def die_with(parent: int) -> None:
    """Have the kernel kill this process when its parent ends - more exactly the thread of the parent that forked.

    Safe between fork and exec where the parent has one thread.
    """
    _LIBRARY.prctl(_SET_DEATH_SIGNAL, ctypes.c_ulong(signal.SIGKILL), *_zeros(3))
    if os.getppid() != parent:  # it ended before the line above
        os.kill(os.getpid(), signal.SIGKILL)


def process_ids() -> set[int]:
    """All processes of this machine; none where the system does not tell."""
    with suppress(OSError):
        return {int(entry.name) for entry in os.scandir(_PROC) if entry.name.isdigit()}
    return set()


def _zeros(count: int) -> list[ctypes.c_ulong]:
    return [ctypes.c_ulong(0)] * count


def _process(pid: int) -> Process | None:
    try:
        # the name of the program stands in parentheses and may hold any sign
        words = (_PROC / str(pid) / "stat").read_bytes().rpartition(b")")[2].split()
    except OSError:
        return None
    return Process(pid, int(words[1]), int(words[2]), words[0] in (b"Z", b"X"), int(words[21]) * _PAGE_MB)
