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

PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 1e6
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
    peak = 0.0
    while not select.select([over], [], [], EVERY_S)[0]:
        peak = max(peak, tree_mb(root))
    return peak


def tree_mb(root: int) -> float:
    """Resident memory of a process and its descendants, MB."""
    parents = {int(entry.name): _parent(entry) for entry in Path("/proc").iterdir() if entry.name.isdigit()}
    tree, added = {root}, True
    while added:
        more = {pid for pid, parent in parents.items() if parent in tree} - tree
        tree, added = tree | more, bool(more)
    return sum(_resident_mb(pid) for pid in tree - {os.getpid()})


def _parent(entry: Path) -> int:
    try:
        return int((entry / "stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return -1


def _resident_mb(pid: int) -> float:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE_MB
    except OSError:
        return 0.0


if __name__ == "__main__":
    sys.stdout.write(f"{watch(int(sys.argv[1]), sys.stdin.fileno())}\n")
