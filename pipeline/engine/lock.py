"""One run of a case at a time. The lock saves work; correctness rests on atomic commits, not on it."""

from __future__ import annotations

import errno
import fcntl
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from pipeline.engine.runlog import printable
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import make_folder, open_or_create
from pipeline.errors import EnvironmentFault

LOCK_FILE = ".lock"

#: So often, and with such a pause, it is tried before somebody counts as its holder.
_LOOKERS = 4
_LOOKER_S = 0.1

_NO_LOCKS_HERE = frozenset({errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL})
_held: set[int] = set()


def _release_in_child() -> None:
    # A forked worker that outlives its parent must not keep the case locked.
    for descriptor in _held:
        os.close(descriptor)
    _held.clear()


os.register_at_fork(after_in_child=_release_in_child)


@contextmanager
def case_lock(root: Path) -> Iterator[bool]:
    """Hold the lock of a case's results folder, which is made if it is not there.

    The lock is the kernel's (flock), so a killed run never leaves it behind; the file stays and says who holds it.

    Yields
    ------
    bool
        False where the file system has no locks: another run may be at work on the same case.

    Raises
    ------
    EnvironmentFault
        ``E-LOCK-01`` at once when another run holds it; other codes when the folder cannot be used.
    """
    what = f"the results folder {root.name}"
    with storage(f"Opening {what}"):
        make_folder(root)
    try:
        with hold(root / LOCK_FILE, what) as lock:
            yield lock.sure
    except Held as held:
        raise EnvironmentFault(
            "E-LOCK-01",
            f"Case {root.name} is already running {held.holder}.",
            "Wait until that run ends, or stop it; nothing was changed.",
        ) from held


class Held(Exception):
    """Somebody else holds a lock; ``holder`` says since when and which process."""

    def __init__(self, holder: str) -> None:
        super().__init__(holder)
        self.holder = holder


@dataclass(frozen=True)
class Lock:
    """A lock that is held.

    Attributes
    ----------
    descriptor : int
        A process that inherits it holds the lock too.
    sure : bool
        False where the file system has no locks.
    """

    descriptor: int
    sure: bool

    def sign(self, more: str = "") -> None:
        """Write into the file who holds it, for people."""
        started = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        os.ftruncate(self.descriptor, 0)
        text = f"since {started} on {socket.gethostname()} (pid {os.getpid()}{more})\n"
        os.pwrite(self.descriptor, text.encode("utf-8", "replace"), 0)


@contextmanager
def hold(path: Path, what: str = "", *, wait: bool = False) -> Iterator[Lock]:
    """Hold the lock of a file that stays, in a folder that is there.

    Parameters
    ----------
    path : Path
    what : str
        What it locks, for messages; the name of the file by default.
    wait : bool
        Whether to wait for another holder to end.

    Yields
    ------
    Lock

    Raises
    ------
    Held
        When somebody else holds it.
    EnvironmentFault
        When the file cannot be opened.
    """
    with storage(f"Opening {what or path.name}"):
        descriptor = open_or_create(path, os.O_RDWR)
    _held.add(descriptor)
    try:
        with storage(f"Locking {what or path.name}"):
            lock = Lock(descriptor, _acquire(descriptor, wait=wait))
            if lock.sure:
                lock.sign()
        yield lock
    finally:
        _held.discard(descriptor)
        os.close(descriptor)


def is_running(root: Path) -> bool:
    """Whether some run holds the lock of a case's results folder; changes nothing."""
    return is_held(root / LOCK_FILE)


def is_held(path: Path) -> bool:
    """Whether somebody holds the lock of a file; changes nothing."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return False


def _acquire(descriptor: int, *, wait: bool) -> bool:
    """Take the lock; False where the file system has none."""
    for _ in range(_LOOKERS):
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            time.sleep(_LOOKER_S)  # whoever only looks holds it for a moment
        except OSError as error:
            if error.errno in _NO_LOCKS_HERE:
                return False
            raise
        else:
            return True
    holder = printable(os.pread(descriptor, 300, 0).decode("utf-8", "replace").strip())
    raise Held(holder or "since a moment ago")
