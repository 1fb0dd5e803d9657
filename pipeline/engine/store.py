"""Bytes on disk: the one function that writes files, and the atomic exchange of folders.

A folder of results is built beside its place under a name that only we use, every file synchronised and read back, the
manifest last, and then renamed over. A process killed anywhere leaves the old folder, the new one, or none.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import Literal

from pipeline.engine.storage_faults import storage
from pipeline.errors import EnvironmentFault

#: Readable by the group, by nobody else: results are medical data.
FILE_MODE = 0o640
FOLDER_MODE = 0o750

_CREATE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
# O_NONBLOCK: opening a FIFO that somebody put in the place of a file must not wait for a writer.
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_LEFTOVER = re.compile(r"\.(?P<name>.+)\.(?P<kind>partial|old)-[0-9a-f]{32}")
#: What opening says of something that is not a regular file: a link, a folder, a FIFO, a path through a file.
NOT_A_FILE = frozenset({errno.EINVAL, errno.ELOOP, errno.ENOTDIR, errno.ENXIO, errno.EISDIR})
#: How often to try again when another run of the same case commits at the same moment.
_SWAP_ATTEMPTS = 10


@dataclass(frozen=True)
class Fingerprint:
    """SHA-256 (hexadecimal) and size in bytes of a file."""

    sha256: str
    size: int


def fingerprint(data: bytes) -> Fingerprint:
    """The fingerprint of bytes in memory."""
    return Fingerprint(hashlib.sha256(data).hexdigest(), len(data))


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file for reading, following no link.

    Raises
    ------
    OSError
        Also (EINVAL) for anything that is not a regular file.
    """
    stream = os.fdopen(os.open(path, _READ), "rb")
    if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
        stream.close()
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return stream


def open_or_create(path: Path, flags: int) -> int:
    """Open a file that stays, such as a log, made with our permissions where it is not there; its descriptor.

    Raises
    ------
    OSError
        Also (ELOOP) for a link.
    """
    descriptor = os.open(path, flags | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, FILE_MODE)
    if stat.S_IMODE(os.fstat(descriptor).st_mode) != FILE_MODE:
        with suppress(PermissionError):  # somebody else's file that we may write to all the same
            os.fchmod(descriptor, FILE_MODE)
    return descriptor


def read_file(path: Path) -> bytes:
    """Bytes of a regular file, following no link."""
    with open_regular(path) as stream:
        return stream.read()


def fingerprint_on_disk(path: Path) -> Fingerprint | None:
    """The fingerprint of a file, streamed; None where there is no such regular file."""
    try:
        with open_regular(path) as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
            return Fingerprint(digest, os.fstat(stream.fileno()).st_size)
    except FileNotFoundError:
        return None
    except OSError as error:
        if error.errno in NOT_A_FILE:
            return None
        raise


def make_folder(folder: Path) -> None:
    """Make a folder and its parents with our permissions, whatever the umask; existing ones are left as they are.

    Raises
    ------
    OSError
    """
    if folder.is_dir():
        return
    make_folder(folder.parent)
    with suppress(FileExistsError):
        folder.mkdir(FOLDER_MODE)
        folder.chmod(FOLDER_MODE)
    if not folder.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, "not a folder", str(folder))


def write_file(path: Path, data: bytes) -> None:
    """Create a file, synchronise it and read it back.

    Raises
    ------
    OSError
        Also when the file exists.
    EnvironmentFault
        ``E-ENV-05`` when the disk gives back other bytes than it was given.
    """
    descriptor = os.open(path, _CREATE, FILE_MODE)
    try:
        os.fchmod(descriptor, FILE_MODE)
        _write_all(descriptor, data)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    if fingerprint_on_disk(path) != fingerprint(data):
        raise EnvironmentFault(
            "E-ENV-05",
            f"The disk did not keep what was written to {path.name}.",
            "Check the results disk or choose another results folder, then run again.",
        )


def replace_file(path: Path, data: bytes) -> None:
    """Write a file of which readers see the old or the new content, never anything else.

    Raises
    ------
    EnvironmentFault
        When the disk does not do it.
    """
    partial = _sibling(path, "partial")
    with storage(f"Writing {path.name}"):
        try:
            write_file(partial, data)
            partial.rename(path)
            _sync_folder(path.parent)
        except BaseException:
            _remove(partial)
            raise


def commit_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Put a complete folder in the place of the one that is there, if any.

    Parameters
    ----------
    folder : Path
        Its parent exists and is ours.
    files : mapping of str to bytes
        POSIX name relative to the folder -> content, written in this order: the manifest comes last.

    Raises
    ------
    EnvironmentFault
        When the disk does not do it; what was there before is then there still.
    """
    partial = _sibling(folder, "partial")
    with storage(f"Writing the results of {folder.name}"):
        try:
            make_folder(partial)
            for name, data in files.items():
                make_folder((partial / name).parent)
                write_file(partial / name, data)
            _sync_folders(partial, files)
            _exchange(partial, folder)
        except BaseException:
            _remove(partial)
            raise


def set_aside(folder: Path) -> None:
    """Rename a damaged result so that it is never used and can still be looked at.

    Raises
    ------
    EnvironmentFault
    """
    with storage(f"Setting aside the damaged {folder.name}"):
        folder.rename(folder.with_name(f".quarantine-{folder.name}-{secrets.token_hex(4)}"))


def sweep(root: Path, name: str = "") -> None:
    """Clear away what earlier, killed runs left in a case's results; nothing whose name is not ours is touched.

    A result that was moved away for its successor, which then never came, is put back.

    Parameters
    ----------
    root : Path
    name : str
        Only what was left of this file or folder, where others at work write beside it.

    Raises
    ------
    EnvironmentFault
    """
    with storage("Cleaning the results folder"):
        for path in sorted(root.iterdir()):
            leftover = _LEFTOVER.fullmatch(path.name)
            if leftover and name not in ("", leftover["name"]):
                continue
            if leftover and leftover["kind"] == "old" and not (root / leftover["name"]).exists():
                path.rename(root / leftover["name"])
            elif leftover:
                _remove(path)


def _write_all(descriptor: int, data: bytes) -> None:
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


def _sibling(path: Path, kind: Literal["partial", "old"]) -> Path:
    return path.with_name(f".{path.name}.{kind}-{secrets.token_hex(16)}")


def _remove(path: Path) -> None:
    # Best effort: what cannot be removed now has a name that the next sweep knows.
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _sync_folders(folder: Path, names: Iterable[str]) -> None:
    parents = {parent for name in names for parent in (folder / name).parents if parent.is_relative_to(folder)}
    for parent in sorted(parents, reverse=True):
        _sync_folder(parent)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # network shares that cannot synchronise a folder say so with EINVAL
            raise
    finally:
        os.close(descriptor)


def _exchange(partial: Path, folder: Path) -> None:
    for _ in range(_SWAP_ATTEMPTS):
        old = _move_away(folder)
        if _renamed(partial, folder, old):
            _sync_folder(folder.parent)
            _remove_if(old)
            return
    raise OSError(errno.EBUSY, "another run writes the same result", str(folder))


def _move_away(folder: Path) -> Path | None:
    old = _sibling(folder, "old")
    try:
        folder.rename(old)
    except FileNotFoundError:
        return None
    return old


def _renamed(partial: Path, folder: Path, old: Path | None) -> bool:
    """Rename; False where another run has put its own complete result there meanwhile."""
    try:
        partial.rename(folder)
    except OSError as error:
        if error.errno in {errno.ENOTEMPTY, errno.EEXIST}:
            _remove_if(old)
            return False
        if old is not None:
            with suppress(OSError):  # if this fails too, the next sweep puts it back
                old.rename(folder)
        raise
    return True


def _remove_if(path: Path | None) -> None:
    if path is not None:
        _remove(path)
