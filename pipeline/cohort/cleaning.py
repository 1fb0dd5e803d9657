"""``ct2lut clean``: what runs leave behind and nothing needs any more; results and their records are never touched.

Only names that this program gives are looked at, links are never followed, and the age of a thing is told by the clock
of the disk it lies on, which on a file server is not this machine's.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pipeline.cohort.place import CohortPlace
from pipeline.commands.cohort_index import Index, Places
from pipeline.commands.repair import case_folders
from pipeline.engine.lock import is_running
from pipeline.engine.records import record_artifact
from pipeline.engine.storage_faults import environment_fault, storage
from pipeline.engine.store import read_file, write_file
from pipeline.errors import ConfigError, EnvironmentFault

Kind = Literal["quarantine", "unfinished", "picture", "log"]

#: What each kind is called, for one and for several.
_WORDS: dict[Kind, tuple[str, str]] = {
    "quarantine": ("damaged result that was set aside", "damaged results that were set aside"),
    "unfinished": ("unfinished file or folder of a killed run", "unfinished files and folders of killed runs"),
    "picture": ("picture that the overview does not show", "pictures that the overview does not show"),
    "log": ("old log of the workflow engine", "old logs of the workflow engine"),
}
_DAY_S = 86_400.0
#: Something that a live process is about to finish, outside of any case's lock, is never older.
_LEAST_AGE_S = 3_600.0

_QUARANTINE = re.compile(r"\.quarantine-.+-[0-9a-f]{8}")
_UNFINISHED = re.compile(r"\.(?P<name>.+)\.(?P<kind>partial|old)-[0-9a-f]{32}")
_PICTURE = re.compile(r"[0-9a-f]{32}\.jpg")
_LOG = re.compile(r".+\.log(\.\d+)?")


@dataclass(frozen=True)
class Leftover:
    """Something that nothing needs any more; ``bytes`` is the size of all its files together."""

    path: Path
    kind: Kind
    bytes: int


@dataclass(frozen=True)
class Cleaned:
    """What a cleaning did.

    Attributes
    ----------
    removed : tuple of Leftover
        What went, or would go.
    refused : tuple of str
        Why something could not be removed; each reason once.
    dry_run : bool
        Whether everything is there still.
    older_than_days : float
    """

    removed: tuple[Leftover, ...]
    refused: tuple[str, ...]
    dry_run: bool
    older_than_days: float


def leftovers(results: Path, older_than_days: float = 7.0) -> Iterator[Leftover]:
    """What can be removed from a results folder; a case whose run is at work is passed over.

    Parameters
    ----------
    results : Path
    older_than_days : float
        By the clock of the disk. Unfinished things count from one hour on, whatever this says.

    Raises
    ------
    ConfigError
        ``E-CLN-01`` where there is no results folder, ``E-CLN-03`` for a number of days that cannot be.
    EnvironmentFault
        When the results folder cannot be read, or its clock not be asked.
    """
    if not 0 <= older_than_days <= 36_500:
        problem = f"The number of days is {older_than_days:g}; expected 0 to 36500."
        raise ConfigError("E-CLN-03", problem, "Give another number with --older-than-days.")
    cases = case_folders(results)
    now = _disk_time(results)
    for kind, path in _candidates(results, cases):
        least = max(_LEAST_AGE_S if kind == "unfinished" else 0.0, older_than_days * _DAY_S)
        with storage(f"Looking at what is left in {path.parent.name}"), suppress(FileNotFoundError):
            size, changed = _size_and_time(path)
            if now - changed >= least:
                yield Leftover(path, kind, size)


def remove(found: Leftover) -> bool:
    """Remove one thing; False where it is gone already, or where a run of its case is at work now.

    Raises
    ------
    EnvironmentFault
        When the disk does not do it.
    """
    if is_running(found.path.parent):
        return False
    with storage(f"Removing what is left in {found.path.parent.name}"):
        try:
            _remove(found.path)
        except FileNotFoundError:
            return False
    return True


def clean(results: Path, older_than_days: float = 7.0, *, dry_run: bool = False) -> Cleaned:
    """Remove all that can be removed; what the disk refuses does not stop the rest.

    Raises
    ------
    ConfigError, EnvironmentFault
        As :func:`leftovers`.
    """
    gone, refused = [], []
    for found in list(leftovers(results, older_than_days)):
        try:
            if dry_run or remove(found):
                gone.append(found)
        except EnvironmentFault as fault:
            refused.append(f"{fault.code} {fault.problem}")
    return Cleaned(tuple(gone), tuple(dict.fromkeys(refused)), dry_run, older_than_days)


def cleaned_lines(done: Cleaned) -> Iterator[str]:
    """What was removed and how much room it took, for the screen."""
    counts = Counter(one.kind for one in done.removed)
    for kind, words in _WORDS.items():
        if counts[kind]:
            yield f"{counts[kind]} {words[counts[kind] > 1]}, {_megabytes(done.removed, kind)}"
    if done.removed:
        total = _megabytes(done.removed)
        yield f"{total} would be free again; without --dry-run it is" if done.dry_run else f"{total} are free again"
    elif not done.refused:
        yield f"nothing to remove: nothing that is left over is older than {done.older_than_days:g} days"
    yield from done.refused


def _megabytes(found: Iterable[Leftover], kind: Kind | None = None) -> str:
    return f"{sum(one.bytes for one in found if kind in (None, one.kind)) / 1e6:.1f} MB"


def _candidates(results: Path, cases: Iterable[Path]) -> Iterator[tuple[Kind, Path]]:
    place, overview = CohortPlace(results), Places(results, results / "index.html")
    for case in cases:
        if not is_running(case):
            yield from _left_by_runs(case)
    own = place.workflow
    for folder in (
        results,
        place.files,
        place.ledger("any").parent,
        own,
        place.case_list("any").parent,
        overview.pictures,
    ):
        yield from _left_by_runs(folder)
    shown = _shown_pictures(overview)
    if shown is not None:
        yield from (("picture", path) for path in _entries(overview.pictures, _PICTURE) if path.name not in shown)
    for folder in (place.files, own / ".snakemake" / "log"):
        yield from (("log", path) for path in _entries(folder, _LOG) if path != place.engine_log)


def _left_by_runs(folder: Path) -> Iterator[tuple[Kind, Path]]:
    yield from (("quarantine", path) for path in _entries(folder, _QUARANTINE))
    for path in _entries(folder, _UNFINISHED):
        name = _UNFINISHED.fullmatch(path.name)
        # a result that was moved away for a successor that never came is the only one: the next run puts it back
        if name and (name["kind"] == "partial" or os.path.lexists(folder / name["name"])):
            yield "unfinished", path


def _entries(folder: Path, pattern: re.Pattern[str]) -> list[Path]:
    """What has such a name in a folder; nothing for a folder that is not there or is a link."""
    if folder.is_symlink():
        return []
    try:
        return sorted(path for path in folder.iterdir() if pattern.fullmatch(path.name))
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise environment_fault(error, f"Looking at what is left in {folder.name}") from error


def _shown_pictures(overview: Places) -> Collection[str] | None:
    """The pictures that the index of the overview names; None where that is not known, and no picture may go."""
    try:
        index = record_artifact("cohort_index", overview.index.name, Index).decode({"": read_file(overview.index)})
    except (OSError, ValueError):
        return None
    return {entry.row.pictures for entry in index.entries.values()}


def _disk_time(folder: Path) -> float:
    """The time that the disk of a folder gives to a file that is written now."""
    trial = folder / f".ct2lut-clean.partial-{secrets.token_hex(16)}"
    with storage("Asking the results disk for its time"):
        try:
            write_file(trial, b"now\n")
            return trial.stat().st_mtime
        finally:
            trial.unlink(missing_ok=True)


def _size_and_time(path: Path) -> tuple[int, float]:
    """Bytes of all files below, and when something of it changed last; setting aside counts as a change."""
    found = path.lstat()
    size, changed = found.st_size, max(found.st_mtime, found.st_ctime)
    for folder, folders, files in () if path.is_symlink() else os.walk(path):
        for name in (*folders, *files):
            below = Path(folder, name).lstat()
            size += below.st_size
            changed = max(changed, below.st_mtime, below.st_ctime)
    return size, changed


def _remove(path: Path) -> None:
    """Remove a file, a link or a folder by its name inside its folder, which is not a link either."""
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path.name, dir_fd=folder)
        else:
            os.unlink(path.name, dir_fd=folder)
    finally:
        os.close(folder)
