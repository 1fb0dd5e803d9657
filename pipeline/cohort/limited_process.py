"""A program with limits of time and memory for it and all that it starts; nothing of it outlives the call."""

from __future__ import annotations

import math
import os
import select
import signal
import subprocess
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import IO, Literal, cast

from pipeline.cohort.descendants import Descendants, adopting, die_with, process_ids, resident_mb
from pipeline.cohort.model import CaseLimits

#: So much of the end of what it prints is kept.
OUTPUT_BYTES = 16_384
#: Longest pause between two looks at time and memory; the first ones are shorter.
LOOK_S = 0.25
#: How long it may take to end by itself after SIGTERM.
GRACE_S = 5.0
#: Memory beyond the limit by this factor ends the grace at once.
GRACE_FACTOR = 1.25

_FIRST_LOOK_S = 0.02
#: Longer than it takes to start a process.
_SECOND_LOOK_S = 0.03
#: What a program that came to its end left behind may take so long to notice it.
_REMAINS_S = 1.0
_DRAIN_S = 0.2
_CHUNK_BYTES = 65_536

Over = Literal["", "time", "memory"]


@dataclass(frozen=True)
class Ended:
    """How a program ended.

    Attributes
    ----------
    code : int
        Exit code; the negative number of the signal where one ended it.
    over : "", "time" or "memory"
        The limit for which it was stopped.
    output : str
        The end of what it printed.
    seconds : float
        Wall time.
    peak_mb : float
        Most resident memory that was seen of it and all that it started.
    """

    code: int
    over: Over
    output: str
    seconds: float
    peak_mb: float


def run_limited(command: Sequence[str], environment: Mapping[str, str], limits: CaseLimits) -> Ended:
    """Run a program to its end or to its limit.

    It is in a session of its own, reads nothing, and is killed by the kernel when the calling thread ends. Call it from
    the main thread of a process that has no other threads and starts nothing else meanwhile.

    Raises
    ------
    OSError
        When it cannot be started.
    KeyboardInterrupt
        After the program has been stopped.
    """
    family = Descendants(os.getpid(), process_ids())
    with adopting(), _signals_wait() as before:
        run = _Run(_started(command, environment, before), family, limits)
        try:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)  # from here on, a signal finds what it has to stop
            over = run.over_limit()
            if over:
                run.stop()
            else:
                family.end_by_themselves(_REMAINS_S, run.pause)
        except KeyboardInterrupt:
            run.stop()
            raise
        finally:
            code = run.end()
        return Ended(code, over, run.output.text, run.seconds, run.peak_mb)


@contextmanager
def _signals_wait() -> Iterator[Iterable[int]]:
    """A signal that asks this process to end is dealt with afterwards; yields those that wait anyway."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield before
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _started(command: Sequence[str], environment: Mapping[str, str], waiting: Iterable[int]) -> subprocess.Popen[bytes]:
    parent = os.getpid()

    def in_child() -> None:
        die_with(parent)
        signal.pthread_sigmask(signal.SIG_SETMASK, waiting)

    return subprocess.Popen(  # noqa: S603 -- our own program
        command,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        bufsize=0,
        start_new_session=True,
        preexec_fn=in_child,  # noqa: PLW1509 -- there is no other thread
    )


class _Output:
    """The end of what comes through a pipe."""

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe = pipe
        self._tail = b""
        self._poll = select.poll()
        self._poll.register(pipe, select.POLLIN)

    def listen(self, seconds: float) -> float:
        """Read for so long or until nobody can write any more; the seconds that are then left."""
        until = time.monotonic() + seconds
        while (rest := until - time.monotonic()) > 0 and not self._pipe.closed:
            if self._poll.poll(math.ceil(1000 * rest)):
                self._take(os.read(self._pipe.fileno(), _CHUNK_BYTES))
        return max(0.0, rest)

    def _take(self, data: bytes) -> None:
        self._tail = (self._tail + data)[-OUTPUT_BYTES:]
        if not data:
            self.close()

    def close(self) -> None:
        """Give the pipe back."""
        self._pipe.close()

    @property
    def text(self) -> str:
        """What was kept."""
        return self._tail.decode("utf-8", "replace")


@dataclass
class _Run:
    """A program at work."""

    process: subprocess.Popen[bytes]
    family: Descendants
    limits: CaseLimits
    since: float = field(default_factory=time.monotonic)
    peak_mb: float = 0.0

    def __post_init__(self) -> None:
        self.family.awaited = self.process.pid
        self.output = _Output(cast("IO[bytes]", self.process.stdout))

    @property
    def seconds(self) -> float:
        return round(time.monotonic() - self.since, 3)

    def over_limit(self) -> Over:
        """Wait until it ends by itself, or needs more than it may."""
        pause, limits = _FIRST_LOOK_S, self.limits
        while self.process.poll() is None:
            held = self._held_mb()
            self.peak_mb = max(self.peak_mb, held)
            if 0 < limits.memory_mb < held:
                return "memory"
            if 0 < limits.time_s < self.seconds:
                return "time"
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(self.output.listen(pause))
            pause = min(2 * pause, LOOK_S)
        return ""

    def _held_mb(self) -> float:
        """Memory of all of it; while it starts a child, one look may count it twice."""
        held = resident_mb(self.family.living())
        if held <= self.peak_mb:
            return held
        time.sleep(_SECOND_LOOK_S)
        return min(held, resident_mb(self.family.living()))

    def stop(self) -> None:
        """Ask all of it to end, and give it a moment."""
        self.family.send(signal.SIGTERM)
        self.family.end_by_themselves(GRACE_S, self.pause, GRACE_FACTOR * self.limits.memory_mb or math.inf)

    def pause(self, seconds: float) -> None:
        """Wait; it can go on to print."""
        time.sleep(self.output.listen(seconds))

    def end(self) -> int:
        """Kill what is left of it; its exit code."""
        with _signals_wait():
            self.family.kill()
            self.output.listen(_DRAIN_S)
            self.output.close()
        code = self.process.poll()
        return -signal.SIGKILL if code is None else code
