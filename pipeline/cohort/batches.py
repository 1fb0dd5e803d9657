"""The plan of a cohort: which case is in which batch, and what of it has changed since the last time.

A list of a batch is rewritten only when its content changes: a batch whose list is older than its result is done.
"""

from __future__ import annotations

import csv
import hashlib
import io
import os
import shlex
from collections import defaultdict
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain, islice
from pathlib import Path

from pipeline.case_id import check_case_id, is_case_id
from pipeline.cohort.model import CohortRequest, ListedCase, Plan
from pipeline.cohort.place import CohortPlace
from pipeline.cohort.resources import batch_resources
from pipeline.engine.records import canonical_json, record_artifact
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import make_folder, read_file, replace_file, sweep
from pipeline.errors import ConfigError

FORMAT = 1
#: Cases of a batch where there are many: its process and its job then cost little beside the cases.
LARGE_BATCH = 50
#: So many cases may be batches of their own on one machine: the engine's graph of them takes seconds.
SINGLE_CASES = 2000
#: So many jobs keep a cluster at work; with fewer cases the batches become smaller.
CLUSTER_JOBS = 100

#: Files of a case that are looked at.
MAX_FILES = 100_000

_COLUMNS = ("id", "folder", "signature", "tries")
_PLAN = record_artifact("plan", "plan.json", Plan)


@dataclass(frozen=True)
class BatchCase:
    """A case as the list of its batch has it.

    Attributes
    ----------
    case : ListedCase
    signature : str
        Of its source folder when the plan was made (:func:`source_signature`).
    tries : int
        From 1; raised whenever it was asked for again.
    """

    case: ListedCase
    signature: str
    tries: int = 1


@dataclass(frozen=True)
class PlanInputs:
    """What a plan is made of.

    Attributes
    ----------
    request : CohortRequest
    key : str
        Of the plan: :func:`~pipeline.cohort.key.plan_key`.
    cases : tuple of ListedCase
        No ID twice, also in upper and lower case: :func:`~pipeline.cohort.case_list.listed_cases`.
    program : str
        How a job calls us, as text for a shell: ``ct2lut``, or ``apptainer exec image.sif ct2lut``.
    threads : int
        Cores of a job, at least 1.
    retries : int
        How often the engine tries a batch again after a fault of the machine.
    retry : frozenset of str
        IDs whose batches run again although they have a result.
    """

    request: CohortRequest
    key: str
    cases: tuple[ListedCase, ...]
    program: str
    threads: int = 1
    retries: int = 2
    retry: frozenset[str] = frozenset()


def source_signature(folder: Path) -> str:
    """What changes when the files of a case do: SHA-256 over name, size and time of change of each.

    A hint that a batch should run again, never truth: what is up to date is decided by content.
    """
    return look_at(folder).signature


@dataclass(frozen=True)
class SourceLook:
    """The folder of a case as one look found it: its signature, and the bytes of its files together."""

    signature: str
    size: int


def look_at(folder: Path) -> SourceLook:
    """Name, size and time of change of every file below a folder, without opening any; never raises OSError.

    What cannot be listed goes in as that. Hidden files are passed over, as a run does; links to folders are not
    followed, except for the folder itself; no more than :data:`MAX_FILES` are looked at, for a run refuses more.
    """
    found = sorted(islice(_files(folder), MAX_FILES))
    digest = hashlib.sha256()
    for name, size, changed in found:
        digest.update(b"%s\0%d %d\0" % (name, size, changed))
    return SourceLook(digest.hexdigest(), sum(max(size, 0) for _, size, _ in found))


def _files(root: Path) -> Iterator[tuple[bytes, int, int]]:
    """Relative name, size in bytes and time of change in ns; -1 and the error for what cannot be looked at."""
    waiting = [("", os.fspath(root))]
    while waiting:
        prefix, folder = waiting.pop()
        try:
            with os.scandir(folder) as entries:
                for entry in entries:
                    if entry.name.startswith("."):
                        continue
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append((f"{prefix}{entry.name}/", entry.path))
                    else:
                        yield (os.fsencode(prefix + entry.name), *_size_and_change(entry))
        except OSError as error:
            yield os.fsencode(prefix), -1, error.errno or 0


def _size_and_change(entry: os.DirEntry[str]) -> tuple[int, int]:
    try:
        found = entry.stat()
    except OSError as error:
        return -1, error.errno or 0
    return found.st_size, found.st_mtime_ns


def default_batch_size(cases: int, *, cluster: bool) -> int:
    """Cases of a batch where the user does not say.

    One on a single machine, as far as its engine can bear it; else :data:`LARGE_BATCH`, or fewer where a cluster would
    have too few jobs.
    """
    if cluster:
        return max(1, min(LARGE_BATCH, cases // CLUSTER_JOBS))
    return 1 if cases <= SINGLE_CASES else LARGE_BATCH


def bucket_count(cases: int, batch_size: int, before: int = 0) -> int:
    """Number of batches; 0 means that each case is a batch of its own.

    Parameters
    ----------
    cases, batch_size : int
    before : int
        That of the plan that is there, 0 for none. It is kept as long as its batches have between half and twice the
        size, since another number puts nearly every case into another batch and runs them all again.
    """
    if batch_size == 1:
        return 0
    if before and batch_size / 2 <= cases / before <= batch_size * 2:
        return before
    return max(1, -(-cases // batch_size))


def batch_of(case_id: str, buckets: int) -> str:
    """The batch of a case, which no other case has a part in."""
    if buckets == 0:
        return case_id
    number = int(hashlib.sha1(case_id.encode(), usedforsecurity=False).hexdigest(), 16) % buckets
    return f"bucket-{number:0{4 if buckets <= 10_000 else 5}d}"


def write_plan(place: CohortPlace, asked: PlanInputs) -> Plan:
    """Write the lists of all batches, the engine's configuration and ``plan.json``, each only when it changes.

    The result of a batch is removed before its list changes, so that it runs again whatever the clocks say. Lists and
    results of batches that are no more are removed; ledgers are history and stay.

    Raises
    ------
    ConfigError
        ``E-ID-01`` for an ID that is not safe, ``E-PLN-04`` for a path that is not text.
    EnvironmentFault
        When the disk does not do it.
    """
    results = place.results.absolute()
    _refuse_odd_paths([str(results), asked.request.cases, *(str(case.folder) for case in asked.cases)])
    cases = _in_batches(asked)
    _make_folders(place)
    batches = {name: _write_batch(place, name, members, asked) for name, members in cases.items()}
    _remove_others(place, cases)
    config = {"key": asked.key, "program": asked.program, "results": shlex.quote(str(results))}
    numbers = {"threads": max(1, asked.threads), "retries": asked.retries, "batches": batches}
    _replace_changed(place.workflow / "config.json", canonical_json(config | numbers))
    ids = {name: tuple(case.case_id for case in members) for name, members in cases.items()}
    plan = Plan(FORMAT, asked.request, asked.key, ids)
    _replace_changed(place.plan, _PLAN.encode(plan)[""])
    return plan


def load_plan(place: CohortPlace) -> Plan:
    """The plan as it was last written.

    Raises
    ------
    ConfigError
        ``E-PLN-01`` when there is none, ``E-PLN-02`` for one that is damaged or of another version.
    EnvironmentFault
        When the disk fails.
    """
    data = _content(place.plan)
    if data is None:
        problem = "There is no cohort in this results folder yet."
        raise ConfigError("E-PLN-01", problem, "Begin it with ct2lut cohort --cases CASES --results RESULTS.")
    try:
        plan = _PLAN.decode({"": data})
        known = plan.format == FORMAT and all(map(is_case_id, chain(plan.batches, *plan.batches.values())))
    except ValueError:
        known = False
    if not known:
        problem = "The plan of this cohort is damaged or was made by another version of the program."
        raise ConfigError("E-PLN-02", problem, "Give the command ct2lut cohort again; finished cases are kept.")
    return plan


def load_batch(place: CohortPlace, name: str) -> tuple[BatchCase, ...]:
    """The cases of a batch, in the order in which they are run.

    Raises
    ------
    ConfigError
        ``E-ID-01`` for a name that no batch can have, ``E-PLN-03`` when its list is not there or damaged.
    EnvironmentFault
        When the disk fails.
    """
    data = _content(place.case_list(check_case_id(name)))
    try:
        return _cases(b"" if data is None else data)
    except ValueError as error:
        problem = f"The list of the batch {name} is not there or is damaged."
        action = "Give the command ct2lut cohort again; finished cases are kept."
        raise ConfigError("E-PLN-03", problem, action) from error


def _refuse_odd_paths(paths: Iterable[str]) -> None:
    try:
        "".join(paths).encode()
    except UnicodeEncodeError as error:
        problem = "The path of the cases or of the results folder has characters that are not text."
        raise ConfigError("E-PLN-04", problem, "Rename that folder with plain letters and digits.") from error


def _in_batches(asked: PlanInputs) -> dict[str, list[ListedCase]]:
    cases: dict[str, list[ListedCase]] = defaultdict(list)
    for case in sorted(asked.cases, key=lambda case: case.case_id):
        cases[batch_of(check_case_id(case.case_id), asked.request.buckets)].append(case)
    return dict(sorted(cases.items()))


def _make_folders(place: CohortPlace) -> None:
    lists = place.case_list("any").parent
    with storage("Preparing the plan"):
        make_folder(lists)
    sweep(lists)


def _write_batch(place: CohortPlace, name: str, cases: Sequence[ListedCase], asked: PlanInputs) -> dict[str, int]:
    """Bring the list of a batch up to date; what the batch asks of the machine."""
    looks = [look_at(case.folder) for case in cases]
    path = place.case_list(name)
    before = _content(path)
    tries = _tries(before)
    rows = [
        BatchCase(case, look.signature, tries.get(case.case_id, 1) + (case.case_id in asked.retry))
        for case, look in zip(cases, looks, strict=True)
    ]
    if (data := _rows(rows)) != before:
        with storage("Preparing the plan"):
            place.done(name).unlink(missing_ok=True)
        replace_file(path, data)
    return asdict(batch_resources([look.size for look in looks], asked.request))


def _remove_others(place: CohortPlace, batches: Container[str]) -> None:
    folders = (place.done("any").parent, place.case_list("any").parent)
    with storage("Removing batches that are no more"):
        for path in chain.from_iterable(folder.iterdir() for folder in folders if folder.is_dir()):
            if path.suffix == ".csv" and is_case_id(path.stem) and path.stem not in batches:
                path.unlink(missing_ok=True)


def _replace_changed(path: Path, data: bytes) -> None:
    if _content(path) != data:
        replace_file(path, data)


def _content(path: Path) -> bytes | None:
    """None where there is no such file."""
    with storage(f"Reading {path.name}"):
        try:
            return read_file(path)
        except FileNotFoundError:
            return None


def _rows(cases: Iterable[BatchCase]) -> bytes:
    text = io.StringIO(newline="")
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(_COLUMNS)
    rows.writerows((one.case.case_id, one.case.folder, one.signature, one.tries) for one in cases)
    return text.getvalue().encode()


def _cases(data: bytes) -> tuple[BatchCase, ...]:
    """The cases of a list; ValueError for anything that :func:`_rows` does not write."""
    try:
        header, *rows = csv.reader(io.StringIO(data.decode(), newline=""), strict=True)
    except csv.Error as error:
        raise ValueError(f"{error}") from error
    if tuple(header) != _COLUMNS or not rows:
        raise ValueError("no list of a batch")
    return tuple(map(_case, rows))


def _case(row: Sequence[str]) -> BatchCase:
    case_id, folder, signature, tries = row
    if not (is_case_id(case_id) and folder and signature):
        raise ValueError("no case")
    return BatchCase(ListedCase(case_id, Path(folder)), signature, int(tries))


def _tries(data: bytes | None) -> Mapping[str, int]:
    """How often each case of the list that is there was asked for; a damaged list begins anew."""
    try:
        return {one.case.case_id: one.tries for one in _cases(data or b"")}
    except ValueError:
        return {}
