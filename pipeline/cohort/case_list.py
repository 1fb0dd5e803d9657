"""Which cases a cohort has: the subfolders of a folder, or the rows of a CSV list. Refused before anything starts."""

from __future__ import annotations

import csv
import errno
import os
import re
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import TypeVar

from pipeline.case_id import is_case_id
from pipeline.cohort.model import ListedCase
from pipeline.engine.runlog import printable
from pipeline.engine.storage_faults import storage
from pipeline.errors import ConfigError
from pipeline.suggestions import shown

T = TypeVar("T")

#: Larger lists are something else: 100,000 rows have about 5 MB.
MAX_BYTES = 50_000_000
#: Folders that systems and file servers leave beside those of people.
SYSTEM_FOLDERS = frozenset(
    {"__macosx", "@eadir", "#recycle", "$recycle.bin", "lost+found", "system volume information"}
)

_SEPARATORS = (",", ";", "\t")
#: Blank lines, comments, and the line by which spreadsheets name their separator.
_PASSED_OVER = re.compile(r"\s*|#.*|sep=.?", re.DOTALL)
_NOWHERE = frozenset({errno.ENOENT, errno.ENOTDIR, errno.EACCES, errno.ELOOP, errno.ENAMETOOLONG})
_ID_ACTION = "An ID has 1 to 64 of A-Z a-z 0-9 - _, begins with a letter or digit, and is no device name such as CON."


def listed_cases(cases: Path) -> tuple[ListedCase, ...]:
    """The cases of a folder or a list, sorted by ID; their folders are absolute.

    Parameters
    ----------
    cases : Path
        A folder: each subfolder, or link to a folder, is a case of that name; hidden entries, files and folders that
        systems leave are passed over. A link that leads nowhere counts, so that the case is refused and not forgotten.
        A ``.csv``: UTF-8, cells separated by commas, semicolons or tabs, the first line names the columns. ``id`` is
        needed; ``folder`` is relative to the list and is ``<id>`` beside it where it is not given; other columns are
        ignored, as are blank lines and lines that begin with ``#``.

    Raises
    ------
    ConfigError
        ``E-LST-01`` when there is neither; ``E-LST-02`` for a list that is no text or too large; ``E-LST-03`` without
        the column ``id``; ``E-LST-04`` for IDs that are not valid; ``E-LST-05`` for the same ID twice, also in upper
        and lower case; ``E-LST-06`` for folders that are not there; ``E-LST-07`` for one folder under two IDs;
        ``E-LST-08`` when no case is left; ``E-LST-09`` for a row that cannot be divided into cells.
    EnvironmentFault
        When the disk fails.
    """
    path = cases.absolute()
    with storage("Reading the list of cases"):
        try:
            found = _found(path)
        except PermissionError as error:
            raise _neither(path.name) from error
    if not found:
        problem = f"{shown(path.name)} holds no case."
        raise ConfigError("E-LST-08", problem, "Give a folder with one folder a case, or a list with one row a case.")
    return tuple(sorted(found, key=lambda case: case.case_id))


@dataclass(frozen=True)
class _Row:
    line: int
    case: ListedCase

    @property
    def place(self) -> str:
        return f"line {self.line} ({shown(self.case.case_id)})"


def _found(path: Path) -> list[ListedCase]:
    if path.is_dir():
        return _of_folder(path)
    if path.is_file() and path.suffix.lower() == ".csv":
        return _of_list(path)
    raise _neither(path.name)


def _neither(name: str) -> ConfigError:
    problem = f"{shown(name)} is neither a folder nor a .csv list that can be read."
    action = "Give a folder with one folder a case, or a .csv file with a column id."
    return ConfigError("E-LST-01", problem, action)


# A folder ------------------------------------------------------------------------------------------------------------


def _of_folder(folder: Path) -> list[ListedCase]:
    with os.scandir(folder) as entries:
        names = [entry.name for entry in entries if _is_case(entry)]
    _refuse_invalid_names(sorted(name for name in names if not is_case_id(name)))
    _refuse_twins(sorted(names))
    return [ListedCase(name, folder / name) for name in names]


def _is_case(entry: os.DirEntry[str]) -> bool:
    if entry.name.startswith(".") or entry.name.lower() in SYSTEM_FOLDERS:
        return False
    if not entry.is_symlink():
        return entry.is_dir()
    target = _target(Path(entry.path))
    return target is None or stat.S_ISDIR(target.st_mode)


def _refuse_invalid_names(names: Sequence[str]) -> None:
    if names:
        problem = f"The cases folder has folders whose names cannot be case IDs: {_first(map(shown, names))}."
        action = f"Rename or move them, or use a .csv list with the columns id and folder. {_ID_ACTION}"
        raise ConfigError("E-LST-04", problem, action)


def _refuse_twins(names: Sequence[str]) -> None:
    pairs = [f"{one} and {other}" for one, other in _repeated(names, str.casefold)]
    if pairs:
        problem = f"The cases folder has folders that differ only in upper and lower case: {_first(pairs)}."
        raise ConfigError("E-LST-05", problem, "Rename one of each pair.")


# A list --------------------------------------------------------------------------------------------------------------


def _of_list(path: Path) -> list[ListedCase]:
    rows = list(_rows(path))
    _refuse_invalid_ids(rows)
    _refuse_duplicates(rows)
    _refuse_folders(rows)
    return [row.case for row in rows]


def _rows(path: Path) -> Iterator[_Row]:
    text = _text(path)
    first, lines = next(_Lines(text), "").strip(), _Lines(text)
    records = _records(lines, _separator(first))
    header = _names(next(records, []))
    id_column, folder_column = _columns(first, header)
    for given in records:
        if any(given[len(header) :]):
            raise _indivisible(lines.began, f"it has {len(given)} cells, expected {len(header)}")
        cells = given + [""] * (len(header) - len(given))
        folder = "" if folder_column is None else cells[folder_column].strip()
        yield _Row(lines.began, ListedCase(cells[id_column], path.parent / (folder or cells[id_column])))


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise _no_text(f"it has more than {MAX_BYTES / 1e6:.0f} MB")
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise _no_text(f"its encoding is not UTF-8 (line {line})") from error
    if "\0" in text:
        raise _no_text("it holds characters with the code 0")
    return text


def _no_text(why: str) -> ConfigError:
    problem = f"The list of cases cannot be read: {why}."
    return ConfigError("E-LST-02", problem, 'Save it again as "CSV UTF-8"; only the column id is needed.')


class _Lines(Iterator[str]):
    """Lines for a CSV reader; knows where a record began, and passes over comments, but not inside a quoted cell."""

    def __init__(self, text: str) -> None:
        self._lines = enumerate(StringIO(text, newline=None), start=1)
        self.inside = False
        self.began = 1

    def __next__(self) -> str:
        number, line = next(self._lines)
        while not self.inside and _PASSED_OVER.fullmatch(line.rstrip("\n")):
            number, line = next(self._lines)
        if not self.inside:
            self.inside, self.began = True, number
        return line


def _records(lines: _Lines, separator: str) -> Iterator[list[str]]:
    """Rows that are not empty."""
    try:
        for cells in csv.reader(lines, delimiter=separator, strict=True):
            lines.inside = False
            if any(cell.strip() for cell in cells):
                yield cells
    except csv.Error as error:
        raise _indivisible(lines.began, printable(str(error))) from error


def _separator(first: str) -> str:
    """The one by which the first line has a column ``id``; a comma where none has."""
    for separator in _SEPARATORS:
        if "id" in _names(next(csv.reader([first], delimiter=separator), [])):
            return separator
    return _SEPARATORS[0]


def _names(cells: Iterable[str]) -> list[str]:
    """Names of columns as they are compared."""
    return [cell.strip().lower() for cell in cells]


def _columns(first: str, names: Sequence[str]) -> tuple[int, int | None]:
    """Which columns hold the ID and the folder."""
    if names.count("id") == 1 and names.count("folder") <= 1:
        return names.index("id"), names.index("folder") if "folder" in names else None
    problem = f"The first line of the list is {shown(first)}, expected names of columns, id once among them."
    action = "Name the column with the case IDs id and, if there is one, that with the folders folder."
    raise ConfigError("E-LST-03", problem, action)


def _indivisible(line: int, why: str) -> ConfigError:
    problem = f"The row of the list that begins on line {line} cannot be divided into cells: {why}."
    return ConfigError(
        "E-LST-09", problem, "Look for a quote that is not closed, or a separator in a cell without quotes."
    )


def _refuse_invalid_ids(rows: Iterable[_Row]) -> None:
    wrong = [row.place for row in rows if not is_case_id(row.case.case_id)]
    if wrong:
        problem = f"The list has IDs that are not valid: {_first(wrong)}."
        raise ConfigError("E-LST-04", problem, f"Correct them. {_ID_ACTION}")


def _refuse_duplicates(rows: Sequence[_Row]) -> None:
    pairs = _repeated(rows, lambda row: row.case.case_id.casefold())
    wrong = [f"line {one.line} and {other.place}" for one, other in pairs]
    if wrong:
        problem = f"The list has the same ID more than once (upper and lower case count as the same): {_first(wrong)}."
        raise ConfigError("E-LST-05", problem, "Give each case one row with an ID of its own.")


def _refuse_folders(rows: Sequence[_Row]) -> None:
    identities = [_identity(row.case.folder) for row in rows]
    missing = [row.place for row, identity in zip(rows, identities, strict=True) if identity is None]
    if missing:
        problem = f"Folders of the list are not there or cannot be opened: {_first(missing)}."
        action = "Correct the column folder: a path, or one relative to the list; where it is empty, the ID is taken."
        raise ConfigError("E-LST-06", problem, action)
    numbered = _repeated(list(zip(rows, identities, strict=True)), lambda pair: pair[1])
    pairs = [(one, other) for (one, _), (other, _) in numbered if one.case.folder.samefile(other.case.folder)]
    if pairs:
        wrong = _first(f"{one.place} and {other.place}" for one, other in pairs)
        problem = f"The list has one folder under two IDs: {wrong}."
        raise ConfigError("E-LST-07", problem, "Give each case a folder of its own.")


def _identity(folder: Path) -> tuple[int, int] | None:
    """What is the same for every path that leads to a folder; None where it leads to none."""
    found = _target(folder)
    return (found.st_dev, found.st_ino) if found and stat.S_ISDIR(found.st_mode) else None


# Both ----------------------------------------------------------------------------------------------------------------


def _target(path: Path) -> os.stat_result | None:
    """What a path leads to; None where it leads nowhere."""
    try:
        return path.stat()
    except OSError as error:
        if error.errno in _NOWHERE:
            return None
        raise


def _repeated(values: Iterable[T], key: Callable[[T], object]) -> list[tuple[T, T]]:
    """Each value whose key was there before, with the first of that key."""
    first: dict[object, T] = {}
    pairs = ((first.setdefault(key(value), value), value) for value in values)
    return [(one, other) for one, other in pairs if one is not other]


def _first(words: Iterable[str]) -> str:
    """The first three, and how many more."""
    known = list(words)
    more = f" and {len(known) - 3} more" if len(known) > 3 else ""
    return ", ".join(known[:3]) + more
