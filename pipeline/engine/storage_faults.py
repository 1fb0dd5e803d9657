"""What the operating system says about a disk, in words a radiographer can act on."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from pipeline.errors import EnvironmentFault


@dataclass(frozen=True)
class _Kind:
    code: str
    sentence: str
    action: str


_FULL = _Kind("E-ENV-01", "the disk is full", "Free space on the results disk and run again; finished stages are kept.")
_QUOTA = _Kind("E-ENV-01", "the disk quota is used up", "Ask for more quota and run again; finished stages are kept.")
_DENIED = _Kind("E-ENV-02", "permission denied", "Ask for write permission in the results folder and run again.")
_READ_ONLY = _Kind("E-ENV-02", "the disk is read-only", "Choose a results folder on a disk that can be written to.")
_DEVICE = _Kind("E-ENV-03", "the disk or network share reported an error", "Check the disk or share and run again.")
_LIMIT = _Kind("E-ENV-04", "a limit of this computer was reached", "Close other programs or use fewer jobs, run again.")
_OTHER = _Kind("E-ENV-03", "the operating system refused", "Check the results folder and run again.")

_KINDS = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _QUOTA,
    errno.EACCES: _DENIED,
    errno.EPERM: _DENIED,
    errno.EROFS: _READ_ONLY,
    errno.EIO: _DEVICE,
    errno.ESTALE: _DEVICE,
    errno.ENXIO: _DEVICE,
    errno.EMFILE: _LIMIT,
    errno.ENFILE: _LIMIT,
    errno.ENOMEM: _LIMIT,
    errno.EAGAIN: _LIMIT,  # no more processes
}


def is_environmental(error: OSError) -> bool:
    """Whether an OSError from anywhere speaks of the machine rather than of a mistake in the program."""
    return error.errno in _KINDS


def environment_fault(error: OSError, doing: str) -> EnvironmentFault:
    """The fault to show for an OSError.

    Parameters
    ----------
    error : OSError
        Its own text is not used: it holds absolute paths.
    doing : str
        Begins the sentence, such as ``Writing 30_mesh/meshes.npz``.
    """
    kind = _KINDS.get(error.errno or 0, _OTHER)
    name = errno.errorcode.get(error.errno or 0, type(error).__name__)
    return EnvironmentFault(kind.code, f"{doing} failed: {kind.sentence} ({name}).", kind.action)


def memory_fault() -> EnvironmentFault:
    """The fault to show when memory ran out."""
    return EnvironmentFault("E-ENV-04", "The computer ran out of memory.", _LIMIT.action)


@contextmanager
def storage(doing: str) -> Iterator[None]:
    """Turn every OSError inside into an EnvironmentFault whose sentence begins with ``doing``."""
    try:
        yield
    except OSError as error:
        raise environment_fault(error, doing) from error
