"""What a BIDS dataset holds of knees: which files belong to which subject, session and side.

The Brain Imaging Data Structure, https://bids-specification.readthedocs.io: files are named by entities
(``sub-01_ses-02_hemi-L_ct.nii.gz``), tables and sidecars hold for all files below whose entities include theirs. CT is
a proposal there (BEP024): datatype and suffix ``ct``.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from pipeline.case_id import is_case_id
from pipeline.cohort.bids.call import LABEL, PIPELINE, BidsCall, Filter
from pipeline.engine.storage_faults import storage
from pipeline.errors import ConfigError
from pipeline.suggestions import did_you_mean, listed, shown

ENDINGS = (".nii.gz", ".nii")
#: Folders in which a CT is looked for: the proposed one, and where it is put until then.
CT_FOLDERS = ("ct", "anat")
#: Session, datatype, and two more that some programs make.
MAX_DEPTH = 4
MAX_TABLE_BYTES = 64_000_000
#: Names that a message lists at most.
LISTED = 8

_NAME = re.compile(
    r"(?P<entities>(?:[A-Za-z]+-[A-Za-z0-9+]+_)*)(?P<suffix>[A-Za-z0-9]+)(?P<extension>(?:\.[A-Za-z0-9]+)+)", re.ASCII
)


@dataclass(frozen=True)
class BidsFile:
    """A file of a dataset.

    Attributes
    ----------
    name : str
        POSIX path relative to the dataset.
    root : str
        Of the dataset it belongs to, relative to ``IN``: empty, or ``derivatives/NAME``.
    """

    name: str
    root: str = ""

    @property
    def entities(self) -> dict[str, str]:
        """Entity -> label; empty where the name does not follow BIDS."""
        return parse_name(self.base)[0]

    @property
    def base(self) -> str:
        """The last part of its name."""
        return PurePosixPath(self.name).name

    @property
    def folder(self) -> str:
        """The datatype: the folder that it lies in."""
        return PurePosixPath(self.name).parent.name


@dataclass(frozen=True)
class BidsCase:
    """One knee of one subject in one session.

    Attributes
    ----------
    dataset : Path
    subject, session, hemi : str
        Labels of the entities; empty where the names have none.
    ct, dseg : tuple of BidsFile
        Candidates, of which there should be one.
    shared : tuple of str
        Names of the sidecars and tables at the top of the dataset and of its derivatives, which may hold for any case.
    participant : mapping of str to str
        Its row of ``participants.tsv``.
    """

    dataset: Path
    subject: str
    session: str = ""
    hemi: str = ""
    ct: tuple[BidsFile, ...] = ()
    dseg: tuple[BidsFile, ...] = ()
    shared: tuple[str, ...] = ()
    participant: Mapping[str, str] = field(default_factory=dict)

    @property
    def case_id(self) -> str:
        """``sub-01``, ``sub-01_ses-02``, ``sub-01_ses-02_hemi-L``: the entities that its names have."""
        parts = (("sub", self.subject), ("ses", self.session), ("hemi", self.hemi))
        return "_".join(f"{entity}-{label}" for entity, label in parts if label)


@dataclass(frozen=True)
class _Dataset:
    """A dataset as far as every subject needs it."""

    call: BidsCall
    roots: tuple[str, ...]
    shared: tuple[str, ...]
    participants: Mapping[str, Mapping[str, str]]


def bids_cases(call: BidsCall) -> tuple[BidsCase, ...]:
    """The cases of a dataset, or of the subjects and sessions that the call names.

    A subject or session without CT and segmentation is a case too:
    :func:`pipeline.cohort.bids.prepare.prepare_case` refuses it in words.

    Raises
    ------
    ConfigError
        E-BID-02 for what is no dataset, E-BID-03 for subjects or sessions that it does not have, E-BID-05 for labels of
        which no ID can be made.
    EnvironmentFault
        When the disk fails.
    """
    if not call.dataset.is_dir():
        raise ConfigError("E-BID-02", "The dataset is no folder.", "Correct IN, or mount it into the container.")
    with storage("Reading the dataset"):
        dataset = _dataset(call)
        known = _subjects(call.dataset, dataset.roots)
        if not known:
            problem = "The dataset holds no folder of a subject, such as sub-01."
            raise ConfigError("E-BID-02", problem, "Give the top folder of a dataset in BIDS as IN.")
        _refuse_unknown("subject", call.labels, known)
        cases = [case for label in call.labels or known for case in _cases_of_subject(dataset, label)]
    if call.sessions:
        _refuse_unknown("session", call.sessions, sorted({case.session for case in cases} - {""}))
    chosen = tuple(case for case in cases if not call.sessions or case.session in call.sessions)
    _refuse_ids(chosen)
    return chosen


def parse_name(base: str) -> tuple[dict[str, str], str, str]:
    """Entities, suffix and extension of a file name; all empty for one that does not follow BIDS."""
    found = _NAME.fullmatch(base)
    parts = found["entities"].split("_")[:-1] if found else []
    entities = dict(part.split("-", 1) for part in parts)
    if found is None or len(entities) < len(parts):
        return {}, "", ""
    return entities, found["suffix"], found["extension"]


def inherited(case: BidsCase, file: BidsFile, extension: str) -> Iterator[tuple[str, ...]]:
    """The sidecars or tables that hold for a file, from the top of its dataset down to its own folder.

    Yields
    ------
    tuple of str
        Names of one folder, relative to the dataset; BIDS allows one.
    """
    entities, suffix, _ = parse_name(file.base)
    parents = list(reversed(PurePosixPath(file.name).parents))
    for folder in parents[len(PurePosixPath(file.root).parts) :]:
        top = folder == PurePosixPath(file.root)
        names = _files_in(case.shared, folder) if top else _listing(case.dataset, folder)
        yield tuple(name for name in names if _applies(PurePosixPath(name).name, entities, (suffix, extension)))


def read_table(data: bytes) -> list[dict[str, str]]:
    """The rows of a table of BIDS: UTF-8, tabs, a head; ``n/a`` and blanks become empty.

    Raises
    ------
    ValueError
        For anything else.
    """
    if len(data) > MAX_TABLE_BYTES:
        raise ValueError(f"it has more than {MAX_TABLE_BYTES} bytes")
    rows = [line.split("\t") for line in re.split(r"\r\n|\n|\r", data.decode("utf-8-sig"))]
    head = [cell.strip() for cell in rows[0]]
    if len(set(head)) < len(head) or not any(head):
        raise ValueError("it has no head with the names of its columns, or a name twice")
    full = [row for row in rows[1:] if any(cell.strip() for cell in row)]
    if any(len(row) > len(head) for row in full):
        raise ValueError("a line has more cells than the head")
    return [{name: _cell(text) for name, text in zip(head, row, strict=False)} for row in full]


def _cell(text: str) -> str:
    return "" if text.strip().lower() == "n/a" else text.strip()


def _dataset(call: BidsCall) -> _Dataset:
    roots = ("", *_pipelines(call))
    shared = tuple(name for root in roots for name in _listing(call.dataset, PurePosixPath(root)))
    tables = tuple(name for name in shared if name.endswith((".tsv", ".json")))
    return _Dataset(call, roots, tables, _participants(call.dataset))


def _pipelines(call: BidsCall) -> list[str]:
    """The derivatives beside the data, without our own; some keep subjects in ``derivatives/`` itself."""
    folder = call.dataset / "derivatives"
    names = sorted(os.listdir(folder)) if folder.is_dir() else []  # noqa: PTH208 - names are what is wanted
    own = call.out.resolve()
    datasets = [
        f"derivatives/{name}"
        for name in names
        if not name.startswith((".", "sub-")) and (folder / name).is_dir() and (folder / name).resolve() != own
    ]
    return [*(["derivatives"] if any(name.startswith("sub-") for name in names) else []), *datasets]


def _participants(dataset: Path) -> dict[str, Mapping[str, str]]:
    path = dataset / "participants.tsv"
    if not os.path.lexists(path):
        return {}
    try:
        rows = read_table(path.read_bytes())
    except (FileNotFoundError, ValueError) as error:
        reason = "its content is not there" if isinstance(error, FileNotFoundError) else error
        problem = f"participants.tsv cannot be read: {reason}."
        raise ConfigError("E-BID-02", problem, "Correct the table, or remove it.") from error
    return {row.get("participant_id", ""): row for row in rows}


def _subjects(dataset: Path, roots: tuple[str, ...]) -> list[str]:
    found = [os.listdir(dataset / root) for root in roots]  # noqa: PTH208 - names are what is wanted
    labels = sorted({name.removeprefix("sub-") for names in found for name in names if name.startswith("sub-")})
    return [
        label
        for label in labels
        if LABEL.fullmatch(label) and any((dataset / root / f"sub-{label}").is_dir() for root in roots)
    ]


def _cases_of_subject(dataset: _Dataset, subject: str) -> list[BidsCase]:
    """A case for each session and each side that the names of its files have."""
    files = [file for root in dataset.roots for file in _images(dataset.call.dataset, root, subject)]
    found: dict[str, list[BidsFile]] = {session: [] for session in _sessions(dataset, subject)}
    for file in files:
        found.setdefault(_session_of(file), []).append(file)
    return [case for session in sorted(found or {"": []}) for case in _cases(dataset, (subject, session), found)]


def _cases(dataset: _Dataset, whose: tuple[str, str], found: Mapping[str, list[BidsFile]]) -> list[BidsCase]:
    """The sides of a session; a file that names no side may belong to either."""
    subject, session = whose
    files = found.get(session, [])
    wanted = dataset.call.filters
    ct = [file for file in files if _is_ct(file) and _passes(file, wanted.get("ct", {}))]
    dseg = [file for file in files if not _is_ct(file) and _passes(file, wanted.get("dseg", {}))]
    sides = sorted({file.entities.get("hemi", "") for file in (*ct, *dseg)} - {""}) or [""]
    return [
        BidsCase(
            dataset.call.dataset,
            subject,
            session,
            side,
            tuple(file for file in ct if file.entities.get("hemi", side) == side),
            tuple(file for file in dseg if file.entities.get("hemi", side) == side),
            dataset.shared,
            dataset.participants.get(f"sub-{subject}", {}),
        )
        for side in sides
    ]


def _sessions(dataset: _Dataset, subject: str) -> list[str]:
    """The sessions of the dataset itself, be there a CT in them or not."""
    folder = dataset.call.dataset / f"sub-{subject}"
    names = os.listdir(folder) if folder.is_dir() else []  # noqa: PTH208 - names are what is wanted
    labels = [name.removeprefix("ses-") for name in names if name.startswith("ses-") and (folder / name).is_dir()]
    return [label for label in labels if LABEL.fullmatch(label)]


def _images(dataset: Path, root: str, subject: str) -> Iterator[BidsFile]:
    """The CTs of the dataset itself, and the segmentations there and in a derivative."""
    top = dataset / root / f"sub-{subject}"
    waiting = [(top, 0)] if top.is_dir() else []
    while waiting:
        folder, depth = waiting.pop()
        for path in sorted(folder.iterdir()):
            if path.name.startswith("."):
                continue
            if depth < MAX_DEPTH and path.is_dir():  # the depth also ends a loop of links
                waiting.append((path, depth + 1))
            file = BidsFile(path.relative_to(dataset).as_posix(), root)
            if _is_dseg(file) or (not root and _is_ct(file)):
                yield file


def _is_ct(file: BidsFile) -> bool:
    return file.folder in CT_FOLDERS and file.base.endswith(tuple(f"_ct{ending}" for ending in ENDINGS))


def _is_dseg(file: BidsFile) -> bool:
    return file.base.endswith(tuple(f"_dseg{ending}" for ending in ENDINGS))


def _session_of(file: BidsFile) -> str:
    below = PurePosixPath(file.name).relative_to(PurePosixPath(file.root)).parts[1]
    return below.removeprefix("ses-") if below.startswith("ses-") else ""


def _passes(file: BidsFile, wanted: Filter) -> bool:
    has: Mapping[str, str] = {**file.entities, PIPELINE: PurePosixPath(file.root).name}
    return all(_label(entity, has.get(entity)) == _label(entity, label) for entity, label in wanted.items())


def _label(entity: str, label: str | None) -> str:
    """``run-01`` and ``run-1`` are the same index; every other label is text."""
    return (label or "").lstrip("0" if entity == "run" else "")


def _applies(base: str, entities: Mapping[str, str], kind: tuple[str, str]) -> bool:
    theirs, *their_kind = parse_name(base)
    return tuple(their_kind) == kind and theirs.items() <= entities.items()


def _listing(dataset: Path, folder: PurePosixPath) -> list[str]:
    names = sorted(os.listdir(dataset / folder))  # noqa: PTH208 - names are what is wanted
    return [(folder / name).as_posix() for name in names]


def _files_in(names: tuple[str, ...], folder: PurePosixPath) -> list[str]:
    return [name for name in names if PurePosixPath(name).parent == folder]


def _refuse_unknown(what: str, asked: tuple[str, ...], known: list[str]) -> None:
    unknown = [label for label in asked if label not in known]
    if not unknown:
        return
    more = f" and {len(known) - LISTED} more" if len(known) > LISTED else ""
    absent, there = f"{listed(unknown[:LISTED])}{did_you_mean(unknown[0], known)}", f"{listed(known[:LISTED])}{more}"
    raise ConfigError("E-BID-03", f"The dataset has no {what} {absent}; it has {there}.", "Correct the label.")


def _refuse_ids(cases: tuple[BidsCase, ...]) -> None:
    seen: dict[str, str] = {}
    for case_id in (case.case_id for case in cases):
        if not is_case_id(case_id):
            problem = f"{shown(case_id)} cannot be the ID of a case: letters and digits, at most 64 signs in all."
            raise ConfigError("E-BID-05", problem, "Name the other subjects with --participant-label.")
        if (twin := seen.setdefault(case_id.casefold(), case_id)) != case_id:
            problem = f"{twin} and {case_id} differ only in upper and lower case."
            raise ConfigError("E-BID-05", problem, "Process one of them into another output folder.")
