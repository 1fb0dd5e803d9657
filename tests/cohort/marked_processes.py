"""Processes that carry a mark in their environment: all that a command started, orphans as well."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

#: Name of the variable.
VARIABLE = "CT2LUT_TEST_MARK"


def marked(mark: str) -> Mapping[int, tuple[str, ...]]:
    """Number of each living process with this mark -> its arguments; never this process itself."""
    wanted = f"{VARIABLE}={mark}".encode()
    found = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit() and int(folder.name) != os.getpid():
            with suppress(OSError):  # it has ended, or belongs to someone else
                if wanted in (folder / "environ").read_bytes().split(b"\0"):
                    words = (folder / "cmdline").read_bytes().split(b"\0")
                    found[int(folder.name)] = tuple(word.decode(errors="replace") for word in words[:-1])
    return found


def kill(*pids: int) -> None:
    """SIGKILL, each by its number."""
    send(signal.SIGKILL, *pids)


def send(what: signal.Signals, *pids: int) -> None:
    """A signal to each; one that has ended is passed over."""
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, what)


def kill_all(mark: str, patience_s: float = 30.0) -> None:
    """SIGKILL every process with this mark until none is left.

    Raises
    ------
    TimeoutError
        When some are still there after so many seconds.
    """
    until = time.monotonic() + patience_s
    while left := marked(mark):
        if time.monotonic() > until:
            raise TimeoutError(f"{len(left)} processes do not end")
        kill(*left)
        time.sleep(0.05)


@contextmanager
def standing_still(mark: str) -> Iterator[None]:
    """Every process with this mark stands still meanwhile: what they have written does not change."""
    stopped: set[int] = set()
    try:
        while fresh := marked(mark).keys() - stopped:
            send(signal.SIGSTOP, *fresh)
            stopped |= fresh
        yield
    finally:
        send(signal.SIGCONT, *stopped)


def outlived(mark: str, patience_s: float = 5.0) -> tuple[str, ...]:
    """What is still there after so many seconds, by its arguments."""
    until = time.monotonic() + patience_s
    while (left := marked(mark)) and time.monotonic() < until:
        time.sleep(0.1)
    return tuple(sorted(" ".join(words) for words in left.values()))


def engines(mark: str) -> tuple[int, ...]:
    """Those that are the workflow engine itself."""
    return tuple(pid for pid, words in marked(mark).items() if len(words) > 1 and words[1].endswith("/snakemake"))
