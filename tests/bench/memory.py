"""The most memory that this process and all that it started held at one time (Linux).

Looked at from a process of its own, so that looking costs the measured one nothing.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
from pathlib import Path
from types import TracebackType

from pipeline.cohort.descendants import Descendants, resident_mb

EVERY_S = 0.1


class PeakMemory:
    """Watches the resident memory of the process tree while it is entered; ``peak_mb`` is the greatest sum seen."""

    def __init__(self) -> None:
        self.peak_mb = 0.0

    def __enter__(self) -> PeakMemory:
        command = [sys.executable, "-P", str(Path(__file__)), str(os.getpid())]
        self._watch = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        out, _ = self._watch.communicate()
        self.peak_mb = float(out)


def watch(root: int, over: int) -> float:
    """The greatest memory of a tree until a file descriptor is closed at its other end, MB."""
    peak, family = 0.0, Descendants(root, {os.getpid()})
    while not select.select([over], [], [], EVERY_S)[0]:
        peak = max(peak, resident_mb(family.living()))
    return peak


if __name__ == "__main__":
    sys.stdout.write(f"{watch(int(sys.argv[1]), sys.stdin.fileno())}\n")
