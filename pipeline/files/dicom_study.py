"""Whose CT it is: what an object for the archive repeats of a series, so that it is filed with the study.

The values are kept as the bytes they are in the series, together with its character set, and never decoded: a name in
any script comes out as it went in. They live in memory for as long as an export takes; no result ever holds them.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from pipeline.errors import CaseRejected
from pipeline.files.dicom_headers import DicomHeader, read_header, silent_pydicom
from pipeline.files.dicom_series import Read, choose_series

_TEXT = rb"[^\x00-\x1a\x1c-\x1f\x7f]*"  # without control characters; escape switches character sets
_DATE = rb"([0-9]{4}(0[1-9]|1[0-2])(0[1-9]|[12][0-9]|3[01]))?"
_TIME = rb"(([01][0-9]|2[0-3])([0-5][0-9]([0-5][0-9](\.[0-9]{1,6})?)?)?)?"
#: Without these an object is filed with nobody's study, or with somebody else's.
_ESSENTIAL = {
    "SpecificCharacterSet": rb"[A-Z0-9_ \\]*",
    "StudyInstanceUID": rb"(?=.{1,64}$)[0-9]+(\.[0-9]+)*",
    "PatientID": _TEXT,
    "PatientName": _TEXT,
}
#: May be empty in an object (type 2), and are where the series has none that may be written.
_MAY_BE_EMPTY = {
    "PatientBirthDate": _DATE,
    "PatientSex": rb"[MFO]?",
    "StudyDate": _DATE,
    "StudyTime": _TIME,
    "AccessionNumber": _TEXT,
    "StudyID": _TEXT,
    "ReferringPhysicianName": _TEXT,
}
#: Left out where the series does not have them (type 3).
_OPTIONAL = {"IssuerOfPatientID": _TEXT, "StudyDescription": _TEXT}
_ALLOWED = _ESSENTIAL | _MAY_BE_EMPTY | _OPTIONAL


@dataclass(frozen=True)
class SourceStudy:
    """The patient and the study of a CT series.

    Attributes
    ----------
    values : mapping of str to bytes
        Keyword -> its bytes without padding, as in the series.
    slices : tuple of str
        SOP Instance UIDs of the series, sorted.
    """

    values: Mapping[str, bytes] = field(repr=False)
    slices: tuple[str, ...] = field(repr=False)

    @property
    def study_uid(self) -> str:
        """StudyInstanceUID."""
        return self.values["StudyInstanceUID"].decode("ascii")

    @property
    def digest(self) -> str:
        """SHA-256 of all of it."""
        return hashlib.sha256(repr((sorted(self.values.items()), self.slices)).encode()).hexdigest()


def read_study(names: Sequence[str], read: Read) -> SourceStudy:
    """The patient and the study of the one CT series among files, as intake chooses it.

    Parameters
    ----------
    names : sequence of str
        Names relative to the case folder.
    read : callable
        Name -> all bytes of that file.

    Raises
    ------
    CaseRejected
        E-EXP-05 for a value that cannot be repeated; those of
        :func:`~pipeline.files.dicom_series.choose_series`.
    """
    found = (read_header(read(name), name) for name in sorted(names))
    chosen = choose_series([header for header in found if isinstance(header, DicomHeader)]).slices
    first = chosen[0].file
    return SourceStudy(_repeatable(_raw_values(read(first)), first), tuple(sorted(header.sop_uid for header in chosen)))


def _raw_values(data: bytes) -> dict[str, bytes]:
    """Keyword -> bytes of what is there and of its kind, from a file whose header was read before."""
    from pydicom import dcmread  # noqa: PLC0415 - a third of a second that only a DICOM case pays
    from pydicom.dataelem import RawDataElement  # noqa: PLC0415 - as above

    with silent_pydicom():
        dataset = dcmread(io.BytesIO(data), stop_before_pixels=True)
        found = {keyword: dataset.get_item(keyword) for keyword in _ALLOWED if keyword in dataset}
        raw = {name: one.value or b"" for name, one in found.items() if isinstance(one, RawDataElement)}
        # the one text that pydicom decodes by itself
        charset = dataset.get("SpecificCharacterSet") or ""
    charset = charset if isinstance(charset, str) else "\\".join(charset)
    return {name: value.strip(b" \0") for name, value in raw.items()} | {
        "SpecificCharacterSet": charset.encode("ascii", "replace")
    }


def _repeatable(raw: Mapping[str, bytes], file: str) -> dict[str, bytes]:
    """What an object says: all that is essential, the rest where it may be written."""
    usable = {keyword: value for keyword, value in raw.items() if re.fullmatch(_ALLOWED[keyword], value)}
    for keyword in _ESSENTIAL:
        if keyword not in usable and (keyword in raw or keyword == "StudyInstanceUID"):
            raise _unusable(file, keyword)
    empty = dict.fromkeys(("PatientID", "PatientName", *_MAY_BE_EMPTY), b"")
    return empty | {keyword: value for keyword, value in usable.items() if value}


def _unusable(file: str, what: str) -> CaseRejected:
    """Its value may name a patient and is not told."""
    problem = f"{what} of {file} cannot be repeated in a DICOM object, so nothing can be filed with its study."
    return CaseRejected(
        "E-EXP-05", problem, "Correct it in the archive, export the series again and run the case again."
    )
