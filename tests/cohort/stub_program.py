"""A program that takes the place of ct2lut in the jobs of a cohort; it needs Python alone and starts at once.

``RESULTS/stub.json`` says how it behaves: ``seconds`` of a case, and ``faulty``: batch -> attempts that end in a fault
of the machine. A batch is one case here. ``RESULTS/done.log`` has a line for each time that a case was really done.
"""

from __future__ import annotations

import fcntl
import json
import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import FrameType

FAULT, STOPPED = 30, 130


def note(results: Path, log: str, line: str) -> None:
    """Append a line, in one system call."""
    descriptor = os.open(results / log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o640)
    os.write(descriptor, f"{line}\n".encode())
    os.close(descriptor)


def batch(results: Path, attempt: int, name: str) -> int:
    """Do the case of a batch unless its result is there; a second run of the batch waits for the first."""
    how = json.loads((results / "stub.json").read_text())

    def stop(_: int, __: FrameType | None) -> None:
        note(results, "stopped.log", name)
        os._exit(STOPPED)

    signal.signal(signal.SIGTERM, stop)
    note(results, "started.log", f"{name} {attempt} {os.getpid()}")
    note(results, "order.log", "begin")
    files = results / "cohort.files"
    if (files / "driver.lock").resolve() in open_files():
        note(results, "leaks.log", name)
    with (results / f".{name}.lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if attempt <= how["faulty"].get(name, 0):
            time.sleep(how["seconds"])
            note(results, "order.log", "end")
            return FAULT
        result = results / f"{name}.result"
        if not result.exists():
            time.sleep(how["seconds"])
            note(results, "done.log", name)
            result.touch()
        note(results, "order.log", "end")
        (files / "workflow" / "done" / f"{name}.csv").write_text(f"{name}\n")
    return 0


def open_files() -> set[Path]:
    """Every file that this process has open."""
    found = set()
    for link in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):  # the one that lists them
            found.add(link.readlink())
    return found


def main(words: list[str]) -> int:
    """Do what the words say."""
    match words:
        case ["batch", "--results", results, "--attempt", attempt, "--", name]:
            return batch(Path(results), int(attempt), name)
        case ["cohort-summary", "--results", results]:
            note(Path(results), "summaries.log", "summary")
            return 0
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
