"""The case folder as its user brought it: which files, with which content."""

from __future__ import annotations

import errno
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from pipeline.engine.artifacts import SourceFolder
from pipeline.engine.manifest import hash_of_files
from pipeline.engine.runlog import printable
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import fingerprint_on_disk
from pipeline.errors import CaseRejected

#: A folder with more is not the case of one joint; listing it would take minutes, for nothing.
MAX_FILES = 100_000
MAX_BYTES = 100_000_000_000
#: Left in folders by file managers; hidden files are ignored as well.
_JUNK = frozenset({"thumbs.db", "desktop.ini", "__macosx"})


def list_source(case_id: str, root: Path) -> SourceFolder:
    """Name and hash every file of a case.

    Only regular files count; hidden files, editor backups and devices are ignored. A link to a file inside the case
    folder is read, a link to a folder inside it is ignored because its files are listed where they are.

    Parameters
    ----------
    case_id : str
    root : Path
        The case folder; may itself be a link.

    Raises
    ------
    CaseRejected
        ``E-IO-02`` for a link that leaves the folder or points nowhere, ``E-IO-03`` for a folder that is missing or
        empty, ``E-IO-04`` for a file or folder that cannot be read, ``E-IO-05`` for a name that is not text,
        ``E-IO-14`` for more than MAX_FILES or MAX_BYTES.
    EnvironmentFault
        When the disk fails.
    """
    if not root.is_dir():
        raise _nothing(case_id, "does not exist")
    real = root.resolve()
    with storage("Reading the case folder"), _short_paths(case_id):
        files = {_name(path, real): _sha256(path, real) for path in _walk(real)}
    if not files:
        raise _nothing(case_id, "holds no files")
    return SourceFolder(case_id, real, dict(sorted(files.items())))


@contextmanager
def _short_paths(case_id: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        problem = f"A file of {case_id} cannot be read: its folders lie too deep inside each other."
        raise CaseRejected("E-IO-04", problem, "Move the files up, into the case folder itself.") from error


def source_hash(files: Mapping[str, str]) -> str:
    """Content hash of a case folder given as name -> SHA-256."""
    return hash_of_files(files)


def _walk(root: Path) -> Iterator[Path]:
    """Every regular file, in the order of the names; without recursion, however deep they lie."""
    waiting, count, size = [root], 0, 0
    while waiting:
        path = waiting.pop()
        count += 1
        _check_amount(count, size)
        if path.is_symlink():
            _check_link(path, root)
        elif path.is_dir():
            waiting += reversed(_entries(path, root))
            continue
        if path.is_file():
            size += path.stat().st_size
            _check_amount(count, size)
            yield path


def _check_amount(count: int, size: int) -> None:
    if count > MAX_FILES:
        problem = f"The case folder holds more than {MAX_FILES} files and folders."
    elif size > MAX_BYTES:
        problem = f"The case folder holds more than {MAX_BYTES / 1e9:.0f} GB."
    else:
        return
    raise CaseRejected("E-IO-14", problem, "Keep the scan of the one joint there and move everything else out.")


def _entries(folder: Path, root: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if not _is_junk(path.name))
    except PermissionError as error:
        raise _unreadable(folder, root) from error


def _is_junk(name: str) -> bool:
    return name.startswith((".", "~$", "#")) or name.endswith("~") or name.lower() in _JUNK


def _check_link(path: Path, root: Path) -> None:
    try:
        inside = path.resolve(strict=True).is_relative_to(root)
    except (FileNotFoundError, RuntimeError):  # RuntimeError: a loop of links
        inside = False
    if not inside:
        raise CaseRejected(
            "E-IO-02",
            f"{_name(path, root)} is a link that leads out of the case folder or nowhere.",
            "Replace the link by the file itself.",
        )


def _name(path: Path, root: Path) -> str:
    name = path.relative_to(root).as_posix()
    if not name.isprintable():
        raise CaseRejected(
            "E-IO-05",
            f"The name of file {printable(name)} has characters that are not text.",
            "Rename the file with plain letters and digits.",
        )
    return name


def _sha256(path: Path, root: Path) -> str:
    try:
        found = fingerprint_on_disk(path.resolve())
    except PermissionError as error:
        raise _unreadable(path, root) from error
    if found is None:
        raise CaseRejected(
            "E-IO-04",
            f"{_name(path, root)} disappeared while the case folder was read.",
            "Wait until the copy of the case is complete, then run again.",
        )
    return found.sha256


def _unreadable(path: Path, root: Path) -> CaseRejected:
    return CaseRejected(
        "E-IO-04", f"{_name(path, root)} cannot be read: permission denied.", "Ask for read permission and run again."
    )


def _nothing(case_id: str, what: str) -> CaseRejected:
    return CaseRejected(
        "E-IO-03",
        f"The case folder of {case_id} {what}.",
        "Put the case's label map or CT there, or correct the case's name or the cases folder.",
    )
