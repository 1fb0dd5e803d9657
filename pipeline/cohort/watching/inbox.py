"""A folder into which case folders are copied: which of them are complete, and which were not run yet as they are now.

Nothing tells from outside that a copy has ended. So a case counts as complete when name, size and time of all its files
were the same in two looks that are long enough apart, nothing in it has the name of an unfinished file, and the marker
file is there where one is asked for. Times of files are only compared with each other, never with a clock.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import stat
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.case_id import is_case_id
from pipeline.cohort.model import CaseEnd, ListedCase
from pipeline.engine.source import MAX_FILES
from pipeline.engine.storage_faults import storage
from pipeline.errors import EnvironmentFault
from pipeline.suggestions import shown

#: When a case whose run ended in a fault of the machine is tried again, in seconds after each such end.
BACK_OFF_S = (60.0, 300.0, 1500.0)

#: What programs that copy or download put behind the name of a file that is not complete yet.
_UNFINISHED = re.compile(
    r".*(?P<ending>\.(?:part|partial|filepart|crdownload|opdownload|download|aria2|incomplete|tmp|temp))", re.IGNORECASE
)
#: What file managers and file servers leave in folders; all other hidden files belong to an unfinished copy.
_HARMLESS = re.compile(
    r"\.DS_Store|\.localized|\.directory|\._.*|\.nfs[0-9a-f]+|\.fuse_hidden.*|thumbs\.db|desktop\.ini", re.IGNORECASE
)

_COPYING = "as programs that copy make them. When the copy is complete, remove it."


@dataclass(frozen=True)
class Watch:
    """What is watched and when a case folder counts as complete.

    Attributes
    ----------
    cases : Path
        Folder into which others copy, one folder a case; never written to.
    settle_s : float
        Seconds that a case folder has to stay as it is.
    every_s : float
        Seconds between two looks, at least.
    marker : str
        Name of a file in the case folder that says that it is complete; empty where nothing says so but quiet.
    """

    cases: Path
    settle_s: float = 60.0
    every_s: float = 5.0
    marker: str = ""


@dataclass(frozen=True)
class Snapshot:
    """A case folder at one look.

    Attributes
    ----------
    signature : str
        SHA-256 over name, size and time of every file.
    lacks : str
        What keeps it from being complete, as the end of a sentence; empty where nothing is seen that does.
    """

    signature: str
    lacks: str = ""


@dataclass(frozen=True)
class Listing:
    """The folder at one look: case ID -> its folder, and sentences about what in it cannot be a case."""

    cases: Mapping[str, Snapshot]
    unusable: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Quiet:
    """Since when a folder has been as it is."""

    signature: str
    since: float


@dataclass(frozen=True)
class _Later:
    """When a case is tried again if its folder stays as it is."""

    signature: str
    tries: int
    not_before: float


def list_inbox(watch: Watch) -> Listing:
    """Look at every case folder; no content is read.

    Raises
    ------
    EnvironmentFault
        ``E-WCH-04`` when the folder itself is not there; other codes when it cannot be read.
    """
    if not watch.cases.is_dir():
        problem = "The cases folder is not there, or its disk is not mounted."
        raise EnvironmentFault("E-WCH-04", problem, "Mount its disk, or name another folder with --cases.")
    with storage("Reading the cases folder"):
        entries = {path.name: path.is_dir() for path in watch.cases.iterdir() if not _is_hidden(path.name)}
    names = sorted(name for name, is_folder in entries.items() if is_folder and is_case_id(name))
    spellings = Counter(name.casefold() for name in names)
    twins = [name for name in names if spellings[name.casefold()] > 1]
    cases = {name: snapshot(watch.cases / name, watch.marker) for name in names if name not in twins}
    folders = sum(entries.values())
    return Listing(cases, tuple(_unusable(twins, folders - len(names), len(entries) - folders)))


def snapshot(folder: Path, marker: str = "") -> Snapshot:
    """Name, size and time of every file of a case folder; what cannot be read goes in as such."""
    lines, names = [], []
    for name, fact in _facts(folder):
        lines.append(f"{name}\0{fact}")
        names.append(name)
        if len(names) > MAX_FILES:  # a run will refuse it and say so
            return Snapshot("too many files")
    digest = hashlib.sha256("\n".join(sorted(lines)).encode("utf-8", "surrogateescape")).hexdigest()
    return Snapshot(digest, _lacks(names, marker))


@dataclass
class Inbox:
    """Which cases are ready to run: a state machine over looks.

    Attributes
    ----------
    watch : Watch
    done : dict of str to str
        Case ID -> signature of its folder when it was run to an end; survives a restart if its owner keeps it.
    listing : callable
        Looks at the folder.
    clock : callable
        Seconds of a clock that never jumps.
    """

    watch: Watch
    done: dict[str, str] = field(default_factory=dict)
    listing: Callable[[Watch], Listing] = list_inbox
    clock: Callable[[], float] = time.monotonic
    _quiet: dict[str, _Quiet] = field(default_factory=dict)
    _later: dict[str, _Later] = field(default_factory=dict)
    _told: set[str] = field(default_factory=set)
    _news: list[str] = field(default_factory=list)

    def look(self) -> tuple[ListedCase, ...]:
        """Look at the folder.

        Returns
        -------
        tuple of ListedCase
            Complete and not run as they are now, the one that has been complete longest first. Only the first may be
            run: while it is at work the others may change, so look again.

        Raises
        ------
        EnvironmentFault
            When the folder cannot be read; all that is known of it stays.
        """
        begun = self.clock()
        found = self.listing(self.watch)
        looked = self.clock()
        self._forget(found.cases)
        waiting, ready = list(found.unusable), []
        for case_id, seen in found.cases.items():
            quiet = self._quiet.get(case_id)
            if quiet is None or quiet.signature != seen.signature:
                self._quiet[case_id] = _Quiet(seen.signature, looked)
            if not self._is_due(case_id, begun):
                continue
            if seen.lacks:
                waiting.append(f"{case_id} waits: {seen.lacks}")
            else:
                ready.append(case_id)
        self._tell(waiting)
        ready.sort(key=lambda case_id: (self._quiet[case_id].since, case_id))
        return tuple(ListedCase(case_id, self.watch.cases / case_id) for case_id in ready)

    def news(self) -> tuple[str, ...]:
        """What a person should know and was not told yet: sentences about folders that wait or cannot be a case."""
        news, self._news = tuple(self._news), []
        return news

    def ended(self, end: CaseEnd) -> float | None:
        """Remember how the run of a case that was ready ended.

        Returns
        -------
        float or None
            Seconds until it is tried again as it is; None where it is not before its folder changes.
        """
        signature, old = self._quiet[end.case_id].signature, self._later.pop(end.case_id, None)
        tries = old.tries if old and old.signature == signature else 0
        if end.transient and tries < len(BACK_OFF_S):
            self._later[end.case_id] = _Later(signature, tries + 1, self.clock() + BACK_OFF_S[tries])
            return BACK_OFF_S[tries]
        self.done[end.case_id] = signature
        return None

    def _is_due(self, case_id: str, now: float) -> bool:
        """Whether a folder has been as it is for long enough, and was not run as it is."""
        quiet, later = self._quiet[case_id], self._later.get(case_id)
        if self.done.get(case_id) == quiet.signature or now - quiet.since < self.watch.settle_s:
            return False
        return later is None or later.signature != quiet.signature or now >= later.not_before

    def _forget(self, cases: Mapping[str, Snapshot]) -> None:
        for known in (self._quiet, self._later):
            for gone in known.keys() - cases:
                del known[gone]
        # an empty folder is more often a share that is not mounted than a department without cases
        for gone in self.done.keys() - cases if cases else ():
            del self.done[gone]

    def _tell(self, sentences: list[str]) -> None:
        self._news += [sentence for sentence in sentences if sentence not in self._told]
        self._told = set(sentences)


def _is_hidden(name: str) -> bool:
    return name.startswith(".") or _HARMLESS.fullmatch(name) is not None


def _unusable(twins: Iterable[str], misnamed: int, files: int) -> Iterator[str]:
    """What cannot be a case; a name that is no case ID is not told, for it may be a patient's."""
    for name in twins:
        yield f"{name} is not run: another case folder differs only in upper and lower case. Rename one of them."
    if misnamed:
        yield f"not run: folders whose names are no case IDs (1 to 64 of A-Z a-z 0-9 - _): {misnamed}. Rename them."
    if files:
        yield f"not run: files beside the case folders: {files}. A case is a folder of its own."


def _facts(folder: Path) -> Iterator[tuple[str, str]]:
    """POSIX name below the folder, and size and time, of every file; links to folders are not followed."""
    waiting = [("", os.fspath(folder))]
    while waiting:
        prefix, path = waiting.pop()
        try:
            with os.scandir(path) as entries:
                found = [one for one in entries if not _HARMLESS.fullmatch(one.name)]
        except OSError as error:
            yield prefix, _unreadable(error)
            continue
        for one in found:
            name = f"{prefix}{one.name}"
            if one.is_dir(follow_symlinks=False):
                waiting.append((f"{name}/", one.path))
                if one.name.startswith("."):
                    yield f"{name}/", "folder"
            else:
                yield name, _fact(one)


def _fact(entry: os.DirEntry[str]) -> str:
    try:
        found = entry.stat(follow_symlinks=False)
        if stat.S_ISLNK(found.st_mode):
            found = entry.stat()
    except OSError as error:
        return _unreadable(error)
    return f"{stat.S_IFMT(found.st_mode)} {found.st_size} {found.st_mtime_ns}"


def _unreadable(error: OSError) -> str:
    return errno.errorcode.get(error.errno or 0, "unreadable")


def _lacks(names: list[str], marker: str) -> str:
    """What keeps files of these names from being a complete case; names are not told, for they may be a patient's."""
    files = [name for name in names if name != marker]
    for name in files:
        last = name.rstrip("/").rpartition("/")[2]
        if last.startswith("."):
            return f"it holds a hidden file or folder, {_COPYING}"
        if ending := _UNFINISHED.fullmatch(last):
            return f"it holds files that end in {ending['ending'].lower()}, {_COPYING}"
    if not files:
        return "it holds no file yet."
    return f"it does not hold the file {shown(marker)} yet." if marker and marker not in names else ""
