"""Stands for ``ct2lut run ... -- ID`` and behaves as its case is called; as ``supervise``, for the one that runs it.

A case writes ``pids`` below ``--folder``, a process a line; ``leaves.json`` there is what it makes its ``run.json`` of.
"""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

FOREVER_S = 60.0


class Case:
    """The case as the command line names it."""

    def __init__(self, words: list[str]) -> None:
        self.name = words[words.index("--") + 1]
        self.folder = Path(words[words.index("--folder") + 1])
        self.results = Path(words[words.index("--results") + 1]) / self.name

    def note(self) -> None:
        with (self.folder / "pids").open("a") as stream:
            stream.write(f"{os.getpid()}\n")

    def leave(self) -> None:
        """As the program does it: a new file that takes the place of the old one."""
        self.results.mkdir(parents=True, exist_ok=True)
        shutil.copy(self.folder / "leaves.json", self.results / ".partial")
        (self.results / ".partial").rename(self.results / "run.json")


def sleeper(case: Case, *, own_session: bool = True, orphan: bool = True) -> None:
    """A process that sleeps; with a session of its own, and as a child of nobody."""
    if os.fork():
        return
    if own_session:
        os.setsid()
    if orphan and os.fork():
        os._exit(0)
    case.note()
    time.sleep(FOREVER_S)
    os._exit(0)


def finishes(case: Case) -> int:
    case.leave()
    return int((case.folder / "exit").read_text())


def hangs(case: Case) -> int:
    time.sleep(FOREVER_S)
    return 0


def is_deaf(case: Case) -> int:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    return hangs(case)


def blames_its_case(case: Case) -> int:
    """Takes the end of what it needs for a fault of the case, and says so in good order."""

    def refuse(number: int, frame: object) -> None:
        case.leave()
        os._exit(10)

    signal.signal(signal.SIGTERM, refuse)
    return hangs(case)


def needs_memory(case: Case) -> int:
    """Not itself, but what it started."""
    held = "held = b'x' * 200_000_000; import time; time.sleep(60)"
    return subprocess.run([sys.executable, "-S", "-c", held], check=False).returncode


def never_has_enough(case: Case) -> int:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    held = []
    for _ in range(40):  # 2 GB at most
        held.append(b"x" * 50_000_000)
        time.sleep(0.05)
    return hangs(case)


def is_a_bomb(case: Case) -> int:
    for _ in range(20):
        sleeper(case)
        sleeper(case, orphan=False)
    return hangs(case)


def has_zombies(case: Case) -> int:
    """Children of its own that it never asks for, and some of its children's."""
    for _ in range(10):
        if os.fork() == 0:
            if os.fork() == 0:
                time.sleep(0.05)
            os._exit(0)
    time.sleep(0.2)
    return finishes(case)


def leaves_a_child(case: Case) -> int:
    """That keeps the pipe."""
    sleeper(case, own_session=False)
    return finishes(case)


def is_loud(case: Case) -> int:
    for _ in range(800):
        sys.stdout.buffer.write(b"x" * 65_535 + b"\n")
    sys.stdout.flush()
    sys.stderr.write("E-CFG-01  A stage is called \x1b[2J.\nCorrect it.\n")
    return 20


def is_refused(case: Case) -> int:
    last_words = f"REJECTED   {case.name}   E-LBL-02\n  No tibia.\n  Label it.\n"
    sys.stdout.write(f"{case.name}   left knee\n{last_words}report: page\n")
    return 10


def finds_no_disk(case: Case) -> int:
    sys.stderr.write("E-ENV-01  The disk is full.\nFree space.\n")
    return 30


def may_not_write(case: Case) -> int:
    sys.stderr.write("E-ENV-02  Permission denied.\nAsk for it.\n")
    return 30


def dies_of(number: int) -> Callable[[Case], int]:
    def die(case: Case) -> int:
        os.kill(os.getpid(), number)
        return 0

    return die


def aborts(case: Case) -> int:
    os.abort()


def gives_up(case: Case) -> int:
    raise SystemExit("a library gave up")


def says_nothing(case: Case) -> int:
    os._exit(0)


WAYS: dict[str, Callable[[Case], int]] = {
    "finishes": finishes,
    "hangs": hangs,
    "deaf": is_deaf,
    "blames": blames_its_case,
    "memory": needs_memory,
    "endless": never_has_enough,
    "bomb": is_a_bomb,
    "zombies": has_zombies,
    "orphan": leaves_a_child,
    "loud": is_loud,
    "refused": is_refused,
    "disk": finds_no_disk,
    "denied": may_not_write,
    "segv": dies_of(signal.SIGSEGV),
    "killed": dies_of(signal.SIGKILL),
    "ended": dies_of(signal.SIGTERM),
    "abort": aborts,
    "systemexit": gives_up,
    "exit0": says_nothing,
    "exit11": lambda case: 11,
    "exit70": lambda case: 70,
    "exit130": lambda case: 130,
    "exit137": lambda case: 137,
    "threads": lambda case: int(os.environ["OMP_NUM_THREADS"]) + 10 * int(os.environ["LP_NUM_THREADS"]),
}


def supervise(results: Path, folder: Path, name: str) -> int:
    """As the command line does it: a request to end is an interrupt."""
    from pipeline.cohort.case_process import CaseWork, run_case  # noqa: PLC0415 - a case starts quicker without
    from pipeline.cohort.model import CohortRequest, ListedCase  # noqa: PLC0415

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    work = CaseWork(results, CohortRequest("cases", "demo"), (sys.executable, "-S", __file__))
    try:
        run_case(ListedCase(name, folder), work)
    except KeyboardInterrupt:
        return 130
    return 0


def main() -> int:
    if sys.argv[1] == "supervise":
        return supervise(Path(sys.argv[2]), Path(sys.argv[3]), sys.argv[4])
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    case = Case(sys.argv)
    case.note()
    return WAYS[case.name](case)


if __name__ == "__main__":
    sys.exit(main())
