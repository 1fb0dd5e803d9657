"""Tasks for worker processes; a module of its own, because a worker imports it by name."""

from __future__ import annotations

import os
import time
from pathlib import Path

from pipeline.adapters.workers import map_in_order
from pipeline.errors import CaseRejected

_prepared = False


def square(task: int) -> tuple[int, int, bool]:
    """The square of a number, the process that found it, and whether that was prepared."""
    return task**2, os.getpid(), _prepared


def prepare() -> None:
    """Remember in this process that it was prepared."""
    global _prepared  # noqa: PLW0603 - what a worker is told at its start
    _prepared = True


def refuse(task: int) -> int:
    """Fail at one of the tasks."""
    if task == 2:
        raise ValueError(f"task {task} cannot be done")
    return task


def reject(task: int) -> int:
    """Refuse the case."""
    raise CaseRejected("E-ABC-01", f"Task {task} is wrong.", "Correct it.")


def die(_task: int) -> int:
    """End the process as a machine short of memory does."""
    os._exit(9)


def linger(folder: str) -> None:
    """Say which process this is, and wait for five minutes."""
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(300)


def two_that_linger() -> None:
    """A run whose two workers linger."""
    map_in_order(linger, [os.environ["LINGER"]] * 2, 2)
