"""A case of a BIDS dataset as a case folder of ours, and what makes the output folder a derivative of BIDS."""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from pipeline import __version__
from pipeline.case_declaration import label_presets, parse_json
from pipeline.cohort.bids.call import FILTERED
from pipeline.cohort.bids.labels import labels_of_table, preset_of
from pipeline.cohort.bids.layout import ENDINGS, BidsCase, BidsFile, inherited, parse_name, read_table
from pipeline.cohort.model import ListedCase
from pipeline.engine.runlog import printable
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import FILE_MODE, make_folder, replace_file
from pipeline.errors import CaseRejected, ConfigError
from pipeline.suggestions import listed, shown

#: Where the case folders are made; the dot keeps it from being taken for a case.
CASES_FOLDER = ".cases"
DECLARATION = "case.yaml"
#: Version of BIDS that the description of the output names.
BIDS_VERSION = "1.11.0"
#: Keys of a sidecar that say which side was scanned: DICOM's Laterality and Image Laterality.
SIDE_KEYS = ("Laterality", "ImageLaterality")
SIDE_COLUMN = "side"
_SIDES = {"l": "left", "left": "left", "r": "right", "right": "right"}
#: What says that a file is of no one side: DICOM's B and U, and words of tables.
_NO_SIDE = frozenset({"", "b", "both", "bilateral", "u", "unknown", "n/a"})
MAX_SIDECAR_BYTES = 16_000_000

_IGNORED = ("/sub-*", "/cohort.csv", "/cohort.files", "/index.html", "/index.json", "/index.files", "/.cases")
_README = """\
# Results of ct2lut

One folder a case, such as sub-01_ses-02: open its report.html. cohort.csv and index.html list all of them.
The folders of the cases do not follow BIDS and are listed in .bidsignore. Research use - not for diagnosis.
"""

Read = TypeVar("Read")


@dataclass(frozen=True)
class _Said:
    """A side, and who says so."""

    side: str
    source: str


def prepare_case(case: BidsCase, out: Path) -> ListedCase:
    """Make, or bring up to date, the case folder of a case: ``OUT/.cases/ID``.

    It holds ``ct.nii.gz`` and ``labels.nii.gz`` (or ``.nii``), linked where the file system can and copied elsewhere,
    and ``case.yaml`` with the side and the labels as the dataset declares them. A file is copied again when its size
    or time differs. What is killed on the way leaves a folder without ``case.yaml``, which a run refuses.

    Parameters
    ----------
    case : BidsCase
    out : Path
        ``OUT``.

    Raises
    ------
    CaseRejected
        A result of this case, which **the caller records** before it goes on with the next; an older folder of the case
        is removed. E-BID-11 neither CT nor segmentation, E-BID-12 more than one, E-BID-13 contradictory or unknown
        sides, E-BID-14 no names of labels, E-BID-15 a wrong name, E-BID-16 a link that leads out of the dataset,
        E-BID-17 a sidecar or table that cannot be used, E-BID-18 a file that changed meanwhile or may not be read.
    EnvironmentFault
        When the disk fails.
    """
    folder = out / CASES_FOLDER / case.case_id
    try:
        with storage("Reading the dataset"):
            files, declaration = _contents(case)
        with storage("Making the folder of the case"):
            make_folder(folder)
            _bring_up_to_date(folder, files, declaration)
    except CaseRejected:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return ListedCase(case.case_id, folder)


def write_dataset_files(out: Path) -> None:
    """Make the output folder a derivative of BIDS: ``dataset_description.json``, ``.bidsignore`` and ``README.md``.

    Lines that somebody added to ``.bidsignore`` and a README of one's own are left alone.

    Raises
    ------
    ConfigError
        E-BID-04 when the folder is the dataset of something else.
    EnvironmentFault
        When the disk does not take it.
    """
    with storage("Making the output folder"):
        make_folder(out)
        _refuse_foreign(out / "dataset_description.json")
        ignore = out / ".bidsignore"
        lines = ignore.read_text().splitlines() if ignore.is_file() else []
        readme = any(out.glob("README*"))
    _replace(out / "dataset_description.json", json.dumps(_description(), indent=2, sort_keys=True) + "\n")
    _replace(ignore, "\n".join((*lines, *(name for name in _IGNORED if name not in lines))) + "\n")
    if not readme:
        _replace(out / "README.md", _README)


def _contents(case: BidsCase) -> tuple[dict[str, Path], str]:
    """Name in the case folder -> file of the dataset, and the text of ``case.yaml``."""
    if not case.ct and not case.dseg:
        problem = f"The dataset holds neither a CT nor a segmentation of {case.case_id}."
        action = "Put the CT there as sub-…/ct/sub-…_ct.nii.gz, or its segmentation as sub-…_dseg.nii.gz."
        raise CaseRejected("E-BID-11", problem, action)
    chosen = {name: _the_one(case, files) for name, files in (("ct", case.ct), ("labels", case.dseg)) if files}
    files = {f"{name}{_ending(file.name)}": _inside(case, file.name) for name, file in chosen.items()}
    lines = ["# written by ct2lut from a BIDS dataset; changed there, not here"]
    if side := _side(case, tuple(chosen.values())):
        lines.append(f"side: {side}")
    if dseg := chosen.get("labels"):
        labels = _labels(case, dseg)
        if isinstance(labels, str):
            lines.append(f"labels: {labels}")
        else:
            lines += ["labels:", *(f"  {name}: {value}" for name, value in labels.items())]
    return files, "\n".join(lines) + "\n"


def _the_one(case: BidsCase, files: tuple[BidsFile, ...]) -> BidsFile:
    if len(files) > 1:
        names = listed(printable(file.name) for file in files[:4])
        problem = f"There is more than one {'segmentation' if files == case.dseg else 'CT'} of {case.case_id}: {names}."
        action = f"Choose one by its entities with --bids-filter-file; kinds of files are {listed(FILTERED)}."
        raise CaseRejected("E-BID-12", problem, action)
    file = files[0]
    if (file.entities.get("sub"), file.entities.get("ses", "")) != (case.subject, case.session):
        whose = f"sub-{case.subject}" + (f"_ses-{case.session}" if case.session else "")
        problem = f"{printable(file.name)} lies where files of {whose} belong and is not named as one of them in BIDS."
        raise CaseRejected("E-BID-15", problem, f"Correct its name: it begins with {whose}_, then entity-label pairs.")
    return file


def _ending(name: str) -> str:
    return next(ending for ending in ENDINGS if name.endswith(ending))


def _inside(case: BidsCase, name: str) -> Path:
    """The file itself, where its content is kept in another place of the dataset (datalad, git-annex)."""
    try:
        path = (case.dataset / name).resolve(strict=True)
    except (FileNotFoundError, RuntimeError) as error:  # RuntimeError: a loop of links
        problem = f"{printable(name)} is a link to content that is not there."
        raise CaseRejected("E-BID-16", problem, "Fetch the content first (datalad get), or copy the file.") from error
    if not path.is_relative_to(case.dataset.resolve()) or not path.is_file():
        problem = f"{printable(name)} leads out of the dataset, or is no file."
        raise CaseRejected("E-BID-16", problem, "Replace the link by the file itself.")
    return path


def _side(case: BidsCase, files: tuple[BidsFile, ...]) -> str | None:
    """The side that everything which names one agrees on; None where nothing does, and the program says so."""
    said = [_Said(side, source) for source, text in _sides_said(case, files) if (side := _side_word(text, source))]
    for other in said[1:]:
        if other.side != said[0].side:
            problem = f"{said[0].source} says {said[0].side}, and {other.source} says {other.side}."
            raise CaseRejected("E-BID-13", problem, "Correct the wrong one in the dataset.")
    return said[0].side if said else None


def _sides_said(case: BidsCase, files: tuple[BidsFile, ...]) -> list[tuple[str, object]]:
    """Source, and its own word for the side."""
    names = [(printable(file.name), file.entities["hemi"]) for file in files if "hemi" in file.entities]
    sidecars = [(source, value) for file in files for source, value in _sidecar_sides(case, file)]
    rows = (("participants.tsv", case.participant), ("the table of sessions", _session_row(case)))
    return [*names, *sidecars, *((source, row.get(SIDE_COLUMN, "")) for source, row in rows)]


def _side_word(text: object, source: str) -> str | None:
    if text is None or (isinstance(text, str) and text.strip().lower() in _NO_SIDE):
        return None
    if isinstance(text, str) and (side := _SIDES.get(text.strip().lower())):
        return side
    problem = f"{source} names the side {shown(text)}; expected L or R."
    raise CaseRejected("E-BID-13", problem, "Correct it in the dataset.")


def _sidecar_sides(case: BidsCase, file: BidsFile) -> list[tuple[str, object]]:
    """What the sidecars of a file say; the nearest one counts, key by key."""
    merged: dict[str, tuple[str, object]] = {}
    for names in inherited(case, file, ".json"):
        for name in names:
            document = _read(case, name, parse_json)
            merged |= {key: (f"{key} of {printable(name)}", document[key]) for key in SIDE_KEYS if key in document}
    return list(merged.values())


def _session_row(case: BidsCase) -> Mapping[str, str]:
    name = f"sub-{case.subject}/sub-{case.subject}_sessions.tsv"
    if not case.session or not os.path.lexists(case.dataset / name):
        return {}
    rows = _read(case, name, read_table)
    return next((row for row in rows if row.get("session_id") == f"ses-{case.session}"), {})


def _labels(case: BidsCase, dseg: BidsFile) -> dict[str, int] | str:
    """Structure -> value from the nearest look-up table, else the name of a scheme of ours."""
    tables = [names for names in inherited(case, dseg, ".tsv") if names]
    if not tables:
        return _preset(dseg)
    if len(tables[-1]) > 1:
        problem = f"More than one look-up table holds for {printable(dseg.name)}: {listed(map(printable, tables[-1]))}."
        raise CaseRejected("E-BID-14", problem, "Keep one of them in that folder.")
    return _read(case, tables[-1][0], _parse_lookup)


def _parse_lookup(data: bytes) -> dict[str, int]:
    if not (labels := labels_of_table(read_table(data))):
        raise ValueError("it names no structure")
    return labels


def _preset(dseg: BidsFile) -> str:
    try:
        preset = preset_of(parse_name(dseg.base)[0])
    except ValueError as error:
        raise _unnamed(dseg, f"{error}") from error
    if preset is None:
        raise _unnamed(dseg, "there is no look-up table (dseg.tsv with index and name)")
    return preset


def _unnamed(dseg: BidsFile, why: str) -> CaseRejected:
    schemes = listed(name.replace("_", "") for name in label_presets())
    problem = f"Which label of {printable(dseg.name)} is which structure is not clear: {why}."
    return CaseRejected("E-BID-14", problem, f"Put a dseg.tsv beside it, or name a scheme in its seg-: {schemes}.")


def _read(case: BidsCase, name: str, parse: Callable[[bytes], Read]) -> Read:
    try:
        with _inside(case, name).open("rb") as stream:
            data = stream.read(MAX_SIDECAR_BYTES + 1)
        if len(data) > MAX_SIDECAR_BYTES:
            raise ValueError(f"it has more than {MAX_SIDECAR_BYTES} bytes")
        return parse(data)
    except PermissionError as error:
        raise _unreadable(name) from error
    except (ValueError, RecursionError) as error:
        problem = f"{printable(name)} cannot be used: {printable(str(error))}."
        raise CaseRejected("E-BID-17", problem, "Correct it in the dataset, or remove it there.") from error


def _unreadable(name: str) -> CaseRejected:
    problem = f"{printable(name)} cannot be read: permission denied."
    return CaseRejected("E-BID-18", problem, "Ask for read permission in the dataset and run again.")


def _bring_up_to_date(folder: Path, files: Mapping[str, Path], declaration: str) -> None:
    """Links or copies first, the declaration last; whatever else was there before goes."""
    old = [path for path in folder.iterdir() if path.name not in (*files, DECLARATION)]
    stale = {name: source for name, source in files.items() if not _is_current(folder / name, source)}
    target = folder / DECLARATION
    if old or stale:
        target.unlink(missing_ok=True)  # a folder that is killed here has no side, so a run of it is refused
    for path in old:
        path.unlink(missing_ok=True)
    for name, source in stale.items():
        _put(source, folder / name)
    _replace(target, declaration)


def _is_current(path: Path, source: Path) -> bool:
    if path.is_symlink() or not path.is_file():
        return False
    ours, theirs = path.stat(), source.stat()
    return os.path.samestat(ours, theirs) or (ours.st_size, ours.st_mtime_ns) == (theirs.st_size, theirs.st_mtime_ns)


def _put(source: Path, target: Path) -> None:
    """Link or copy under a name of our own, then rename: what bears the final name is whole."""
    partial = target.with_name(f".{target.name}.partial-{secrets.token_hex(16)}")
    try:
        try:
            os.link(source, partial)
        except OSError:  # another disk, a read-only mount, a file of somebody else: whatever it is, a copy may do
            _copy(source, partial)
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)  # also where the name was a link to the same file already, which rename leaves


def _copy(source: Path, partial: Path) -> None:
    before = source.stat()
    try:
        stream = source.open("rb")
    except PermissionError as error:
        raise _unreadable(source.name) from error
    with stream, os.fdopen(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, FILE_MODE), "wb") as copy:
        shutil.copyfileobj(stream, copy, 1 << 20)
        copy.flush()
        os.fchmod(copy.fileno(), FILE_MODE)
        os.fsync(copy.fileno())
    after = source.stat()
    if (before.st_size, before.st_mtime_ns) != (partial.stat().st_size, after.st_mtime_ns):
        problem = f"{printable(source.name)} changed while it was copied."
        raise CaseRejected("E-BID-18", problem, "Wait until the dataset is complete, then run again.")
    os.utime(partial, ns=(after.st_atime_ns, after.st_mtime_ns))


def _replace(path: Path, text: str) -> None:
    """Written only when it differs, so that its time stays."""
    with suppress(OSError, UnicodeDecodeError):
        if path.read_text() == text:
            return
    replace_file(path, text.encode())


def _description() -> dict[str, object]:
    return {
        "Name": "Look-up tables that animate joints",
        "BIDSVersion": BIDS_VERSION,
        "DatasetType": "derivative",
        "GeneratedBy": [{"Name": "ct2lut", "Version": __version__}],
    }


def _refuse_foreign(path: Path) -> None:
    """An output folder that another program made, or a dataset, is not ours to write to."""
    if not path.exists():
        return
    try:
        made_by = parse_json(path.read_bytes()).get("GeneratedBy")
    except (ValueError, RecursionError):
        made_by = None
    names = [one.get("Name") for one in made_by if isinstance(one, dict)] if isinstance(made_by, list) else []
    if "ct2lut" not in names:
        problem = "The output folder is a dataset that ct2lut did not make."
        raise ConfigError("E-BID-04", problem, "Choose another output folder.")
