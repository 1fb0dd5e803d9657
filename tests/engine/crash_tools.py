"""Interception of the system calls that change a disk, and runs in child processes that may be killed."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

#: Everything by which a Python program changes a file system; ``open`` only where it creates.
CHANGING = ("open", "write", "pwrite", "ftruncate", "fsync", "fchmod", "chmod", "mkdir", "rename", "unlink", "rmdir")


@contextmanager
def intercepted(before: Callable[[str], None]) -> Iterator[None]:
    """Call ``before(name)`` ahead of every changing system call."""
    originals = {name: getattr(os, name) for name in CHANGING}

    def wrap(name: str) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            if name != "open" or args[1] & os.O_CREAT:
                before(name)
            return originals[name](*args, **kwargs)

        return call

    for name in CHANGING:
        setattr(os, name, wrap(name))
    try:
        yield
    finally:
        for name, original in originals.items():
            setattr(os, name, original)


class Counter:
    """Acts at call number ``at`` (from 1), or at every call from there on."""

    def __init__(self, at: int = 0, act: Callable[[], None] = lambda: None, *, sticky: bool = False) -> None:
        self.calls = 0
        self._at, self._act, self._sticky = at, act, sticky

    def __call__(self, name: str) -> None:
        self.calls += 1
        if self.calls == self._at or (self._sticky and 0 < self._at <= self.calls):
            self._act()


def kill_self() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def in_child(work: Callable[[], object]) -> int:
    """Run in a forked child that never returns into the test run; its process id."""
    child = os.fork()
    if child == 0:
        code = 99
        try:
            work()
            code = 0
        finally:
            os._exit(code)
    return child


def wait(child: int) -> int:
    """Exit code of a child; minus the signal where one ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
