"""The overview of a results folder, brought up to date: only cases that have changed are read again.

``index.json`` beside the page keeps the line of every case with the key of what it was read from. It is made anew where
it is missing, damaged, or of another version of the program; page and index are replaced as a whole.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from pipeline import __version__
from pipeline.case_id import is_case_id
from pipeline.commands.cohort_case import case_on_disk, read_row
from pipeline.engine.records import record_artifact
from pipeline.engine.stage import Stage
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import fingerprint, fingerprint_on_disk, make_folder, read_file, replace_file
from pipeline.errors import ConfigError
from pipeline.report.cohort_page import CaseRow, Links, cohort_html

#: Raised whenever a line is read differently.
FORMAT = 2
Amended = Callable[[Sequence[CaseRow]], tuple[CaseRow, ...]]
_STRIP = re.compile(r"[0-9a-f]{32}\.jpg")


@dataclass(frozen=True)
class Entry:
    """A line and the key of what it was read from."""

    key: str
    row: CaseRow


@dataclass(frozen=True)
class Index:
    """``index.json``: case ID -> its line."""

    format: int
    software: str
    entries: dict[str, Entry]


@dataclass(frozen=True)
class Overview:
    """What an update did: the lines, how many of them were read again, how many are gone."""

    rows: tuple[CaseRow, ...]
    read: int
    gone: int


@dataclass(frozen=True)
class Places:
    """Where an overview lies: the results it is of, its page, and what it keeps beside the page."""

    results: Path
    page: Path

    @property
    def index(self) -> Path:
        """``index.json`` for ``index.html``."""
        return self.page.with_suffix(".json")

    @property
    def pictures(self) -> Path:
        """``index.files`` for ``index.html``; the dot keeps it from being taken for a case."""
        return self.page.with_suffix(".files")

    @property
    def links(self) -> Links:
        """Relative, so that the page still works where the results are seen under another path."""
        way = os.path.relpath(self.results.resolve(), self.page.parent.resolve())
        return Links(Path(way).as_posix(), self.pictures.name)


_INDEX = record_artifact("cohort_index", "index.json", Index)


def write_overview(places: Places, flow: Sequence[Stage], amended: Amended = tuple) -> Overview:
    """Bring the page of all cases up to date.

    Parameters
    ----------
    places : Places
    flow : sequence of Stage
        The stages whose results are read.
    amended : callable
        From the lines of the cases on disk to the lines to show, such as with cases that have no results; what it adds
        is not kept in the index.

    Raises
    ------
    ConfigError
        E-OVW-01 where there is no results folder, E-OVW-02 for a page whose name does not end in ``.html``.
    EnvironmentFault
        When the disk fails where the page is written.
    """
    if not places.results.is_dir():
        action = "Name the folder of the results with --results."
        raise ConfigError("E-OVW-01", "The results folder does not exist.", action)
    if places.page.suffix != ".html":
        problem = f"The page cannot be called {places.page.name}: its name must end in .html."
        raise ConfigError("E-OVW-02", problem, "Give another name with --out, such as index.html.")
    with storage("Writing the overview"):
        make_folder(places.pictures)
        found, index = _read_again(places, flow)
        overview = replace(found, rows=amended(found.rows))
        _replace(places.index, _INDEX.encode(index)[""])
        _replace(places.page, cohort_html(overview.rows, places.links))
        _clear(places.pictures, {row.pictures for row in overview.rows})
    return overview


def overview_lines(overview: Overview, page: Path) -> list[str]:
    """What was done, for the screen."""
    gone = f", {overview.gone} gone" if overview.gone else ""
    cases = "1 case" if len(overview.rows) == 1 else f"{len(overview.rows)} cases"
    return [f"{cases}, {overview.read} read again{gone}", f"page: {page}"]


def _read_again(places: Places, flow: Sequence[Stage]) -> tuple[Overview, Index]:
    known, strips = _known(places.index), {path.name for path in places.pictures.iterdir()}
    folders = [one for one in sorted(places.results.iterdir()) if is_case_id(one.name) and one.is_dir()]

    def entry(folder: Path) -> Entry:
        case, old = case_on_disk(folder, flow), known.get(folder.name)
        if old and old.key == case.key and (not old.row.pictures or old.row.pictures in strips):
            return old
        return Entry(case.key, read_row(case, places.pictures))

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:  # pictures are decoded outside the interpreter lock
        entries = {one.row.case_id: one for one in pool.map(entry, folders)}
    again = sum(one is not known.get(name) for name, one in entries.items())
    rows = tuple(one.row for one in entries.values())
    return Overview(rows, again, len(known.keys() - entries)), Index(FORMAT, __version__, entries)


def _known(path: Path) -> dict[str, Entry]:
    try:
        index = _INDEX.decode({"": read_file(path)})
    except (OSError, ValueError):
        return {}
    return index.entries if (index.format, index.software) == (FORMAT, __version__) else {}


def _replace(path: Path, data: bytes) -> None:
    if fingerprint_on_disk(path) != fingerprint(data):
        replace_file(path, data)


def _clear(folder: Path, kept: Collection[str]) -> None:
    """Remove thumbnails that no line shows any more; nothing whose name is not ours is touched."""
    for path in folder.iterdir():
        if _STRIP.fullmatch(path.name) and path.name not in kept:
            path.unlink(missing_ok=True)
