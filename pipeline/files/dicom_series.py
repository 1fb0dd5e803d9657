"""The files of a case folder to one CT: which of them are one series, whether they are a grid, and their CT numbers.

Libraries stack whatever they are given and report success; every judgement is made here, from each slice's own header,
before any pixel is decoded. The last check is the one that counts: the first and the last slice of the volume lie where
their own headers say.
"""

from __future__ import annotations

import re
import secrets
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.stage import Finding, Severity
from pipeline.errors import CaseRejected
from pipeline.files.ct_volumes import CtFacts, CtScan, check_hounsfield
from pipeline.files.dicom_headers import (
    CT_SLICE,
    ENHANCED_CT,
    SYNTAXES,
    DicomHeader,
    Fault,
    Unread,
    frame_hash,
    read_header,
)
from pipeline.files.dicom_pixels import stack_values
from pipeline.files.dicom_stack import LANDING_MM, Stack, check_stack, in_plane
from pipeline.files.foreign_image import MAX_VOXELS
from pipeline.geometry.volume import CtVolume, corner_points, in_lps_order

Read = Callable[[str], bytes]

#: Most files of a folder that are looked at.
MAX_FILES = 20_000
#: Fewest slices that make a volume.
MIN_SLICES = 3

_COPY_AGAIN = "Export the series from the PACS again, or copy it again, and compare the number and size of the files."
_ONE_SERIES = "Keep the files of the one series to be used in the case folder and move all others out."
_EXPORT_AGAIN = "Export the original axial series from the PACS again, uncompressed."
#: Files that computers and disc burners add.
_JUNK_NAMES = {"thumbs.db", "desktop.ini", ".ds_store", "dicomdir", "autorun.inf", "lockfile", "version", "readme"}
_DICOM_ENDINGS = re.compile(r"|\.(dcm|dicom|dic|ima|img|[0-9]+)", re.IGNORECASE)
_NO_ARCHIVES = (".zip", ".7z", ".rar", ".tar", ".gz", ".tgz", ".iso")
#: Tag -> field that a slice cannot do without.
_REQUIRED = {
    "SOPInstanceUID": "sop_uid",
    "SeriesInstanceUID": "series_uid",
    "StudyInstanceUID": "study_uid",
    "Rows": "rows",
    "Columns": "columns",
    "NumberOfFrames": "frames",
    "SamplesPerPixel": "samples",
    "PhotometricInterpretation": "photometric",
    "BitsAllocated": "bits_allocated",
    "BitsStored": "bits_stored",
    "HighBit": "high_bit",
    "PixelRepresentation": "signed",
    "PixelSpacing": "pixel_spacing",
    "ImageOrientationPatient": "orientation",
    "ImagePositionPatient": "position",
}
#: Tag -> field that is equal in all slices, to within its tolerance.
_ALIKE = {
    "Rows": ("rows", 0.0),
    "Columns": ("columns", 0.0),
    "PixelSpacing": ("pixel_spacing", 1e-5),
    "ImageOrientationPatient": ("orientation", 1e-4),
    "RescaleSlope": ("slope", 0.0),
    "RescaleIntercept": ("intercept", 0.0),
}


@dataclass(frozen=True)
class ChosenSeries:
    """The slices of the one CT series, in the order given, and the files that are not part of it, each with its why."""

    slices: tuple[DicomHeader, ...]
    set_aside: tuple[tuple[str, str], ...]


def read_dicom_series(names: Sequence[str], read: Read) -> CtScan:
    """Read the one CT series among files, and refuse what cannot be trusted.

    Parameters
    ----------
    names : sequence of str
        Names relative to the case folder, in any order.
    read : callable
        Name -> all bytes of that file; each slice is read twice, and must be the same.

    Raises
    ------
    CaseRejected
        E-DCM-*, E-IO-*, E-GEO-*, E-CT-*; see ``docs/messages.md``.
    """
    if len(names) > MAX_FILES:
        problem = f"The case folder holds {len(names)} files, expected at most {MAX_FILES}."
        raise CaseRejected("E-IO-14", problem, _ONE_SERIES)
    headers, junk = _headers(sorted(names), read)
    chosen = choose_series(headers, junk)
    stack = check_stack(chosen.slices)
    values, notes = stack_values(stack, read)
    volume = in_lps_order(CtVolume(values, stack.lps_from_index))
    _check_landing(volume, stack, values)
    series = f"The CT series ({len(stack.slices)} slices)"
    findings = (
        *stack.findings,
        *_remarks(chosen),
        *_missing_at_an_end(chosen, headers),
        *notes,
        *check_hounsfield(volume.values, series),
    )
    first = stack.slices[0]
    facts = CtFacts(
        first.kvp,
        first.kernel or None,
        first.body_part or None,
        first.slice_thickness_mm,
        first.tilt_deg,
        any(header.lossy for header in stack.slices),
    )
    return CtScan(
        volume,
        findings,
        chosen.set_aside,
        _laterality(stack.slices),
        facts,
        frame_of_reference=frame_hash(first.frame_uid),
    )


def choose_series(headers: Sequence[DicomHeader], set_aside: Sequence[tuple[str, str]] = ()) -> ChosenSeries:
    """The one CT series among headers: one patient, one study, one series, equal slices.

    Parameters
    ----------
    headers : sequence of DicomHeader
    set_aside : sequence of (str, str)
        Files that were set aside before, with the reason.

    Raises
    ------
    CaseRejected
        E-DCM-01..08, E-DCM-10, E-DCM-12, E-DCM-13, E-DCM-15, E-IO-11, E-IO-14.
    """
    reasons = [(header, _not_a_slice(header)) for header in headers]
    slices, copies = _without_copies([header for header, reason in reasons if not reason])
    others = [*set_aside, *((header.file, reason) for header, reason in reasons if reason), *copies]
    if not slices:
        raise _no_ct(others)
    _check_one_source(slices)
    for header in slices:
        _check_kind(header)
        _check_tags(header)
    slices, scouts = _without_scouts(slices)
    if len(slices) < MIN_SLICES:
        problem = f"The CT series has {len(slices)} slices ({slices[0].file}), expected at least {MIN_SLICES}."
        raise CaseRejected("E-DCM-15", problem, _ONE_SERIES)
    _check_alike(slices)
    _check_size(slices)
    return ChosenSeries(tuple(slices), tuple(sorted([*others, *scouts])))


def _headers(names: Sequence[str], read: Read) -> tuple[list[DicomHeader], list[tuple[str, str]]]:
    """Headers of what is DICOM, and what is not; a file that should be DICOM and cannot be read is refused."""
    headers, junk = [], []
    salt = secrets.token_bytes(16)
    for name in names:
        base = PurePosixPath(name).name.lower()
        if base.startswith("._") or base in _JUNK_NAMES or base.endswith(_NO_ARCHIVES):
            junk.append((name, "archive, unpack it" if base.endswith(_NO_ARCHIVES) else "not an image"))
            continue
        found = read_header(read(name), name, salt)
        if isinstance(found, DicomHeader):
            headers.append(found)
        elif found.fault is Fault.OTHER_OBJECT:
            junk.append((name, "not a CT image"))
        elif found.fault is Fault.NOT_DICOM and not _DICOM_ENDINGS.fullmatch(PurePosixPath(name).suffix):
            junk.append((name, "not DICOM"))
        else:
            raise _unread(found)
    return headers, junk


def _unread(found: Unread) -> CaseRejected:
    if found.fault is Fault.COMPRESSION:
        return CaseRejected("E-DCM-04", f"{found.file} cannot be read: it {found.reason}.", _EXPORT_AGAIN)
    if found.fault is Fault.TOO_LARGE:
        return CaseRejected("E-IO-14", f"{found.file} is too large: it {found.reason} GB.", _EXPORT_AGAIN)
    return CaseRejected("E-IO-11", f"{found.file} is damaged or no DICOM file: it {found.reason}.", _COPY_AGAIN)


def _not_a_slice(header: DicomHeader) -> str:
    """Why a file is not a slice of a CT; empty for one that is, or should have been."""
    if header.modality not in ("CT", ""):
        known = re.fullmatch("[A-Z]{2,16}", header.modality)
        return f"modality {header.modality}, not CT" if known else "another modality than CT"
    if header.sop_class != CT_SLICE and header.sop_class not in ENHANCED_CT:
        return "not a CT image, but a capture or report"
    return "localiser" if {"LOCALIZER", "SCOUT"} & {word.upper() for word in header.image_type} else ""


def _without_copies(headers: Sequence[DicomHeader]) -> tuple[list[DicomHeader], list[tuple[str, str]]]:
    first: dict[str, DicomHeader] = {}
    kept, copies = [], []
    for header in headers:
        same = first.setdefault(header.sop_uid, header) if header.sop_uid else header
        if same is header:
            kept.append(header)
        elif same.sha256 == header.sha256:
            copies.append((header.file, f"copy of {same.file}"))
        else:
            problem = f"{same.file} and {header.file} claim to be the same image and differ."
            raise CaseRejected("E-DCM-10", problem, _COPY_AGAIN)
    return kept, copies


def _no_ct(set_aside: Sequence[tuple[str, str]]) -> CaseRejected:
    reasons = Counter(reason for _, reason in set_aside)
    found = ", ".join(f"{count} x {reason}" for reason, count in sorted(reasons.items())) or "no file at all"
    return CaseRejected(
        "E-DCM-01",
        f"The case folder holds no CT slice; it holds {found}.",
        "Put the DICOM files of one CT series there, unpacked.",
    )


def _check_one_source(slices: Sequence[DicomHeader]) -> None:
    if len({header.patient for header in slices}) > 1:
        problem = f"The CT slices are of more than one patient: {_listed(slices, 'patient')}."
        raise CaseRejected("E-DCM-02", problem, _ONE_SERIES)
    for what in ("study", "series", "frame"):
        if len({getattr(header, f"{what}_uid") for header in slices}) > 1:
            kind = "frame of reference" if what == "frame" else what
            problem = f"The CT slices are of more than one {kind}: {_listed(slices, f'{what}_uid')}."
            raise CaseRejected("E-DCM-03", problem, _ONE_SERIES)


def _listed(slices: Sequence[DicomHeader], field: str) -> str:
    """How many slices have each value of a field, named by a file that has it; the value itself may name a patient."""
    counts = Counter(getattr(header, field) for header in slices)
    files = {getattr(header, field): header.file for header in reversed(slices)}
    return ", ".join(f"{count} slices with {files[value]}" for value, count in counts.most_common(8))


def _check_kind(header: DicomHeader) -> None:
    """One plain grey slice of 16 bits, else refused."""
    if header.sop_class in ENHANCED_CT:
        problem = f"{header.file} is an enhanced multi-frame CT, which is not read."
        raise CaseRejected(
            "E-DCM-05", problem, "Export the series from the PACS as classic CT, one file for each slice."
        )
    if header.frames is not None and header.frames > 1:
        problem = f"{header.file} is a multi-frame image of {header.frames} frames, which is not read."
        raise CaseRejected(
            "E-DCM-05", problem, "Export the series from the PACS as classic CT, one file for each slice."
        )
    expected = {"photometric": "MONOCHROME2", "samples": 1, "bits_allocated": 16}
    for field, value in expected.items():
        if (got := getattr(header, field)) not in (value, None, ""):
            problem = f"The pixels of {header.file} are not those of a CT: {field} {got}, expected {value}."
            raise CaseRejected("E-DCM-06", problem, _EXPORT_AGAIN)


def _check_tags(header: DicomHeader) -> None:
    """Every tag that the geometry and the CT numbers need is there and can be meant."""
    faults = dict(header.faults)
    for keyword, field in _REQUIRED.items():
        if keyword in faults or getattr(header, field) in (None, ""):
            raise _bad_tag(header, keyword, faults.get(keyword, "is missing"))
    for keyword, usable, problem in (
        ("NumberOfFrames", header.frames == 1, "is below 1"),
        ("Rows", header.rows, "is 0"),
        ("Columns", header.columns, "is 0"),
        ("PixelSpacing", all(0 < x < 1e3 for x in header.pixel_spacing or ()), "is not a length"),
        ("ImagePositionPatient", all(abs(x) < 1e5 for x in header.position or ()), "is beyond 100 m"),
        ("ImageOrientationPatient", all(abs(x) < 1.001 for x in header.orientation or ()), "is not two directions"),
        ("BitsStored", 0 < (header.bits_stored or 0) <= 16, "is not 1 to 16"),
        ("HighBit", header.high_bit == (header.bits_stored or 0) - 1, "is not BitsStored - 1"),
    ):
        if not usable:
            raise _bad_tag(header, keyword, problem)
    for keyword, value, limit in (("RescaleSlope", header.slope, 1e3), ("RescaleIntercept", header.intercept, 1e6)):
        problem = faults.get(keyword, "is missing") if value is None else f"is {value:g}"
        if value is None or abs(value) > limit or (keyword == "RescaleSlope" and value <= 0):
            raise CaseRejected(
                "E-DCM-12", f"{keyword} of {header.file} {problem}; CT numbers cannot be had without it.", _EXPORT_AGAIN
            )
    row, column = np.array(header.orientation).reshape(2, 3)
    lengths = np.linalg.norm([row, column], axis=1)
    if np.abs(lengths - 1.0).max() > 1e-4 or abs(row @ column) > 1e-4:
        problem = f"ImageOrientationPatient of {header.file} is not two directions at right angles."
        raise CaseRejected("E-DCM-08", problem, _EXPORT_AGAIN)


def _bad_tag(header: DicomHeader, keyword: str, problem: str) -> CaseRejected:
    return CaseRejected("E-DCM-07", f"{keyword} of {header.file} {problem}.", _EXPORT_AGAIN)


def _without_scouts(slices: list[DicomHeader]) -> tuple[list[DicomHeader], list[tuple[str, str]]]:
    """One or two images that look at the stack from another side are scouts, whatever they call themselves."""
    normals = np.array([np.cross(*in_plane(header)) for header in slices])
    main = max(normals, key=lambda normal: int(np.count_nonzero(np.abs(normals @ normal) > 0.9)))
    aside = np.abs(normals @ main) < 0.5
    if aside.sum() > 2 or len(slices) - aside.sum() < MIN_SLICES:
        return slices, []
    scouts = [
        (header.file, "localiser: lies across the other slices")
        for header, out in zip(slices, aside, strict=True)
        if out
    ]
    return [header for header, out in zip(slices, aside, strict=True) if not out], scouts


def _check_alike(slices: Sequence[DicomHeader]) -> None:
    """Refuse slices that differ in what the grid and the CT numbers are made of."""
    for keyword, (field, tolerance) in _ALIKE.items():
        counts = Counter(getattr(header, field) for header in slices)
        usual, count = counts.most_common(1)[0]
        for header in slices:
            found = getattr(header, field)
            if np.abs(np.asarray(found, dtype=np.float64) - np.asarray(usual)).max() > tolerance:
                problem = (
                    f"{keyword} of {header.file} is {_text(found)}, but {_text(usual)} in {count} of "
                    f"{len(slices)} slices."
                )
                raise CaseRejected("E-DCM-13", problem, _ONE_SERIES)


def _text(value: Any) -> str:
    return " x ".join(f"{number:g}" for number in value) if isinstance(value, tuple) else f"{value:g}"


def _check_size(slices: Sequence[DicomHeader]) -> None:
    """Refuse what is too large before anything is allocated, and pixels that are not as many as declared."""
    rows, columns = slices[0].rows or 0, slices[0].columns or 0
    if rows * columns * len(slices) > MAX_VOXELS:
        raise CaseRejected(
            "E-IO-14",
            f"The CT series declares {columns} x {rows} x {len(slices)} voxels, expected at most {MAX_VOXELS:,}.",
            "Export only the part of the series that shows the joint.",
        )
    for header in slices:
        native = not SYNTAXES[header.transfer_syntax][2]
        if native and (found := header.pixels[1] - header.pixels[0]) != rows * columns * 2:
            problem = f"{header.file} is damaged: it holds {found} bytes of pixels, expected {rows * columns * 2}."
            raise CaseRejected("E-IO-11", problem, _COPY_AGAIN)


def _check_landing(scan: CtVolume, stack: Stack, values: NDArray[np.int16]) -> None:
    """The promise of this module: the first voxel of either end slice is where its own header says.

    Raises
    ------
    CaseRejected
        E-DCM-16.
    """
    corners = corner_points(scan.lps_from_index, scan.values.shape)
    voxels = scan.values[np.ix_((0, -1), (0, -1), (0, -1))].reshape(8)
    for header, end in ((stack.slices[0], 0), (stack.slices[-1], -1)):
        off = np.linalg.norm(corners - np.asarray(header.position), axis=1)
        nearest = int(np.argmin(off))
        if not (off[nearest] <= LANDING_MM and voxels[nearest] == values[0, 0, end]):
            problem = (
                f"{header.file} would lie {off[nearest]:.3g} mm off its own header, expected at most {LANDING_MM} mm."
            )
            raise CaseRejected("E-DCM-16", problem, _EXPORT_AGAIN)


def _remarks(chosen: ChosenSeries) -> tuple[Finding, ...]:
    """Notes on what was left out, and a warning of pixels that lost something."""
    out = []
    if chosen.set_aside:
        shown = ", ".join(f"{file} ({why})" for file, why in chosen.set_aside[:5])
        more = f" and {len(chosen.set_aside) - 5} more" if len(chosen.set_aside) > 5 else ""
        out.append(Finding("N-DCM-01", Severity.NOTE, f"Files that are not slices of the CT: {shown}{more}."))
    if lossy := [header.file for header in chosen.slices if header.lossy]:
        text = (
            f"{len(lossy)} slices of the CT ({lossy[0]}) went through a compression that loses detail; use the "
            "original series if there is one."
        )
        out.append(Finding("W-DCM-01", Severity.REVIEW, text))
    return tuple(out)


def _missing_at_an_end(chosen: ChosenSeries, headers: Sequence[DicomHeader]) -> tuple[Finding, ...]:
    """Signs of slices that never came; inside the series a gap shows, at its ends none does."""
    series = chosen.slices[0].series_uid
    mine = {header.sop_uid: header for header in headers if header.series_uid == series}
    declared = max((header.declared_images or 0 for header in chosen.slices), default=0)
    if declared > len(mine):
        text = (
            f"The CT series says that it has {declared} images, and {len(mine)} are here: slices may be missing at an "
            "end. Export the series again, and compare the number of its files."
        )
        return (Finding("W-DCM-03", Severity.REVIEW, text),)
    numbers = [header.instance for header in mine.values()]
    known = [number for number in numbers if number is not None]
    if len(known) < len(numbers) or min(known, default=1) <= 1:
        return ()
    text = f"The images of the CT series are numbered from {min(known)} on; {min(known) - 1} may be missing at an end."
    return (Finding("N-DCM-05", Severity.NOTE, text),)


def _laterality(slices: Sequence[DicomHeader]) -> str | None:
    sides = {header.laterality for header in slices}
    return {"R": "right", "L": "left"}.get(sides.pop()) if len(sides) == 1 else None
