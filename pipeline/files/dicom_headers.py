"""The header of one DICOM file: bytes to the few facts that may be known of it, or the reason why there are none.

Format: DICOM PS3.5 (encoding) and PS3.10 (file meta group). pydicom walks the data set; the file meta group, the
values and the extent of the pixels are judged here, from raw bytes, because libraries guess at what is damaged. Free
text, names and dates are never kept.
"""

from __future__ import annotations

import hashlib
import io
import logging
import re
import secrets
import struct
import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum

from pipeline.files.dicom_tags import PARSE_ERRORS, Tags

#: Largest file whose header is read; an enhanced CT of a whole body is smaller.
MAX_FILE_BYTES = 2_000_000_000
#: Transfer syntaxes that are read: UID -> (implicit VR, little endian, encapsulated).
SYNTAXES = {
    "1.2.840.10008.1.2": (True, True, False),
    "1.2.840.10008.1.2.1": (False, True, False),
    "1.2.840.10008.1.2.2": (False, False, False),
    **{
        f"1.2.840.10008.1.2.{end}": (False, True, True) for end in ("5", "4.57", "4.70", "4.80", "4.81", "4.90", "4.91")
    },
}
#: Never handed to a library: a few kilobytes of it can inflate to any size.
DEFLATED = "1.2.840.10008.1.2.1.99"
#: SOP classes that hold CT: one slice a file, enhanced, legacy converted enhanced.
CT_SLICE = "1.2.840.10008.5.1.4.1.1.2"
ENHANCED_CT = ("1.2.840.10008.5.1.4.1.1.2.1", "1.2.840.10008.5.1.4.1.1.2.2")
CT_CLASSES = (CT_SLICE, *ENHANCED_CT)

_LOSSY = ("1.2.840.10008.1.2.4.81", "1.2.840.10008.1.2.4.91")
_PREAMBLE = 128
_MAX_META_BYTES = 100_000
_LONG_VRS = (b"OB", b"OW", b"OF", b"OD", b"OL", b"OV", b"SQ", b"UC", b"UN", b"UR", b"UT", b"SV", b"UV")
_UNDEFINED = 0xFFFFFFFF
_ITEM, _END_OF_ITEMS = b"\xfe\xff\x00\xe0", b"\xfe\xff\xdd\xe0"
#: Two UIDs can be compared within one run and told by nobody after it.
_RUN_SALT = secrets.token_bytes(16)


class Fault(StrEnum):
    """Why a file gives no header."""

    NOT_DICOM = "not DICOM"
    DAMAGED = "damaged"
    COMPRESSION = "compression"
    TOO_LARGE = "too large"
    OTHER_OBJECT = "other object"


@dataclass(frozen=True)
class Unread:
    """A file without a usable header.

    Attributes
    ----------
    file : str
        Its name relative to the case folder.
    fault : Fault
    reason : str
        Half a sentence that follows "it".
    """

    file: str
    fault: Fault
    reason: str


@dataclass(frozen=True)
class DicomHeader:
    """What is known of one DICOM file; ``None`` or an empty text stands for a tag that is absent or unusable.

    Attributes
    ----------
    file, sha256 : str
        Its name relative to the case folder, and the hash of all its bytes.
    sop_uid, series_uid, study_uid, frame_uid, sop_class, transfer_syntax : str
    patient : str
        Salted hash of identifier, name and date of birth: tells patients apart, names none.
    pixel_spacing : tuple of 2 floats
        Between rows (along a column), between columns, mm.
    orientation, position : tuple of 6, 3 floats
        ImageOrientationPatient, ImagePositionPatient (mm), LPS.
    instance, declared_images : int or None
        InstanceNumber; how many images the series or the acquisition says it has.
    padding : tuple of 2 ints
        Lowest and highest stored value that stands for "nothing here".
    pixels : (int, int)
        First and last byte + 1 of the pixels; of all items with their delimiter where the pixels are encapsulated.
    faults : tuple of (str, str)
        Keyword of a tag that is there but unusable -> what is wrong with it.
    """

    file: str
    sha256: str
    sop_uid: str
    series_uid: str
    study_uid: str
    frame_uid: str
    patient: str
    modality: str
    sop_class: str
    image_type: tuple[str, ...]
    rows: int | None
    columns: int | None
    pixel_spacing: tuple[float, ...] | None
    orientation: tuple[float, ...] | None
    position: tuple[float, ...] | None
    slope: float | None
    intercept: float | None
    bits_allocated: int | None
    bits_stored: int | None
    high_bit: int | None
    signed: bool | None
    samples: int | None
    photometric: str
    transfer_syntax: str
    frames: int | None
    padding: tuple[int, int] | None
    laterality: str
    body_part: str
    kvp: float | None
    kernel: str
    slice_thickness_mm: float | None
    tilt_deg: float | None
    lossy: bool
    instance: int | None
    declared_images: int | None
    pixels: tuple[int, int]
    faults: tuple[tuple[str, str], ...]


@contextmanager
def silent_pydicom() -> Iterator[None]:
    """Keep back what pydicom says of odd values, which are judged here tag by tag: its words may name a patient."""
    log = logging.getLogger("pydicom")
    before, log.disabled = log.disabled, True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.disabled = before


def read_header(data: bytes, file: str, salt: bytes = b"") -> DicomHeader | Unread:
    """Read the header of one DICOM file.

    Parameters
    ----------
    data : bytes
        The whole file.
    file : str
        Its name relative to the case folder, for messages.
    salt : bytes
        Goes into the hash that stands for the patient.

    Returns
    -------
    DicomHeader or Unread
        Never raises for what is in the file. Of a CT the pixels are there to their last byte.
    """
    found = open_dicom(data, file, salt)
    return found.header if isinstance(found, DicomFile) else found


def open_dicom(data: bytes, file: str, salt: bytes = b"", classes: Collection[str] = CT_CLASSES) -> DicomFile | Unread:
    """Read the header of one DICOM file and keep the data set it came from, without its pixels.

    Parameters
    ----------
    data : bytes
        The whole file.
    file : str
        Its name relative to the case folder, for messages.
    salt : bytes
        Goes into the hash that stands for the patient.
    classes : collection of str
        SOP classes that are asked for; a file of another one that is encoded in an unread way is another object.

    Returns
    -------
    DicomFile or Unread
        Never raises for what is in the file.
    """
    if len(data) > MAX_FILE_BYTES:
        return Unread(
            file, Fault.TOO_LARGE, f"has {len(data) / 1e9:.1f} GB, expected at most {MAX_FILE_BYTES / 1e9:.0f}"
        )
    if data[_PREAMBLE : _PREAMBLE + 4] != b"DICM":
        what = f"has only {len(data)} bytes" if len(data) < _PREAMBLE + 4 else "does not begin as a DICOM file does"
        return Unread(file, Fault.NOT_DICOM, what)
    meta = _file_meta(data)
    if meta is None or 0x0010 not in meta:
        return Unread(file, Fault.DAMAGED, "ends or is broken in its first part, the file meta information")
    syntax, sop_class = meta[0x0010], meta.get(0x0002, "")
    if syntax not in SYNTAXES:
        if sop_class and sop_class not in classes:
            return Unread(file, Fault.OTHER_OBJECT, "is another kind of DICOM object")
        return Unread(file, Fault.COMPRESSION, _unread_syntax(syntax))
    return _read_data_set(data, _Source(file, syntax, sop_class, salt))


def frame_hash(frame_uid: str) -> str:
    """What stands for a frame of reference: equal for equal UIDs within one run; empty for none. Never to be stored."""
    return hashlib.sha256(_RUN_SALT + frame_uid.encode()).hexdigest() if frame_uid else ""


@dataclass(frozen=True)
class _Source:
    """Where a data set comes from: its file, how it is encoded, and the SOP class that the file meta group names."""

    file: str
    syntax: str
    sop_class: str
    salt: bytes


def _unread_syntax(syntax: str) -> str:
    if syntax == DEFLATED:
        return "is deflated as a whole (Deflated Explicit VR Little Endian)"
    return "is compressed in a way that is not read" + (f" ({syntax})" if re.fullmatch(r"[0-9.]{1,64}", syntax) else "")


def _file_meta(data: bytes) -> dict[int, str] | None:
    """Element number -> text of group 0002 (always explicit VR, little endian); None where it is broken."""
    out: dict[int, str] = {}
    at = _PREAMBLE + 4
    while data[at : at + 2] == b"\x02\x00" and at < _MAX_META_BYTES:
        element, vr = int.from_bytes(data[at + 2 : at + 4], "little"), data[at + 4 : at + 6]
        head, width = (12, 4) if vr in _LONG_VRS else (8, 2)
        end = at + head + int.from_bytes(data[at + head - width : at + head], "little")
        # an element that comes twice could tell pydicom another syntax than it tells us
        if end > len(data) or at + head > len(data) or element in out or not re.fullmatch(rb"[A-Z]{2}", vr):
            return None
        out[element] = data[at + head : end].decode("latin-1").strip(" \0")
        at = end
    return out


def _read_data_set(data: bytes, source: _Source) -> DicomFile | Unread:
    from pydicom import dcmread  # noqa: PLC0415 - a third of a second that only a DICOM case pays
    from pydicom.errors import InvalidDicomError  # noqa: PLC0415 - as above

    stream = io.BytesIO(data)
    try:
        with silent_pydicom():
            tags = Tags(dcmread(stream, stop_before_pixels=True, force=False))
            header = _header(tags, source, data, stream.tell())
    except (*PARSE_ERRORS, InvalidDicomError):
        return Unread(source.file, Fault.DAMAGED, "has a header that cannot be read to its end")
    return header if isinstance(header, Unread) else DicomFile(header, tags)


@dataclass(frozen=True, eq=False)
class DicomFile:
    """A DICOM file that was read up to its pixels.

    Attributes
    ----------
    header : DicomHeader
    tags : Tags
        Of the top level.
    """

    header: DicomHeader
    tags: Tags


def _header(tags: Tags, source: _Source, data: bytes, pixels_at: int) -> DicomHeader | Unread:
    sop_class = "".join(tags.texts("SOPClassUID")[:1]) or source.sop_class
    modality = tags.text("Modality")
    pixels = _pixel_range(data, pixels_at, source.syntax)
    if problem := _contradiction(modality, sop_class, source, has_pixels=pixels is not None):
        return Unread(source.file, Fault.DAMAGED, problem)
    signed = tags.flag("PixelRepresentation")
    return DicomHeader(
        file=source.file,
        sha256=hashlib.sha256(data).hexdigest(),
        sop_uid=_uid(tags, "SOPInstanceUID"),
        series_uid=_uid(tags, "SeriesInstanceUID"),
        study_uid=_uid(tags, "StudyInstanceUID"),
        frame_uid=_uid(tags, "FrameOfReferenceUID"),
        patient=_patient(tags, source.salt),
        modality=modality,
        sop_class=sop_class,
        image_type=tags.texts("ImageType"),
        rows=tags.short("Rows"),
        columns=tags.short("Columns"),
        pixel_spacing=tags.decimals("PixelSpacing", 2),
        orientation=tags.decimals("ImageOrientationPatient", 6),
        position=tags.decimals("ImagePositionPatient", 3),
        slope=tags.decimal("RescaleSlope"),
        intercept=tags.decimal("RescaleIntercept"),
        bits_allocated=tags.short("BitsAllocated"),
        bits_stored=tags.short("BitsStored"),
        high_bit=tags.short("HighBit"),
        signed=signed,
        samples=tags.short("SamplesPerPixel"),
        photometric=tags.text("PhotometricInterpretation"),
        transfer_syntax=source.syntax,
        frames=tags.frames(),
        padding=_padding(tags, signed=signed is True),
        laterality=tags.text("ImageLaterality") or tags.text("Laterality"),
        body_part=tags.text("BodyPartExamined"),
        kvp=tags.decimal("KVP"),
        kernel=tags.text("ConvolutionKernel"),
        slice_thickness_mm=tags.decimal("SliceThickness"),
        tilt_deg=tags.decimal("GantryDetectorTilt"),
        lossy=source.syntax in _LOSSY or tags.text("LossyImageCompression") == "01",
        instance=tags.whole("InstanceNumber"),
        declared_images=tags.whole("NumberOfSeriesRelatedInstances") or tags.whole("ImagesInAcquisition"),
        pixels=pixels or (0, 0),
        faults=tuple(tags.faults.items()),
    )


def _contradiction(modality: str, sop_class: str, source: _Source, *, has_pixels: bool) -> str:
    """What tells a damaged CT from another object, which would be set aside and leave the volume shorter."""
    if not modality and not sop_class:
        return "does not say what it is (Modality and SOPClassUID missing)"
    if sop_class != (source.sop_class or sop_class):
        return "says in two places what it is, and differently (SOPClassUID)"
    if sop_class != CT_SLICE:
        return ""
    if not has_pixels:
        return "ends before the last of its pixels"
    return "" if modality in ("CT", "") else "is a CT image by its class and not by its modality"


def _uid(tags: Tags, keyword: str) -> str:
    return "".join(tags.texts(keyword)[:1])


def _patient(tags: Tags, salt: bytes) -> str:
    facts = [tags.raw(keyword).strip(b" \0") for keyword in ("PatientID", "PatientName", "PatientBirthDate")]
    return hashlib.sha256(salt + b"\n".join(facts)).hexdigest()


def _padding(tags: Tags, *, signed: bool) -> tuple[int, int] | None:
    value = tags.short("PixelPaddingValue", signed=signed)
    if value is None:
        return None
    limit = tags.short("PixelPaddingRangeLimit", signed=signed)
    return (value, value) if limit is None else (min(value, limit), max(value, limit))


def _pixel_range(data: bytes, at: int, syntax: str) -> tuple[int, int] | None:
    """First byte of the pixels and the one after the last; None where they are missing or cut."""
    implicit, little, encapsulated = SYNTAXES[syntax]
    order = "<" if little else ">"
    begin = at + (8 if implicit else 12)
    if begin > len(data) or struct.unpack_from(order + "HH", data, at) != (0x7FE0, 0x0010):
        return None
    if not implicit and data[at + 4 : at + 6] not in (b"OB", b"OW"):
        return None
    (length,) = struct.unpack_from(order + "I", data, begin - 4)
    if encapsulated:
        end = _end_of_items(data, begin) if length == _UNDEFINED else None
    else:
        end = begin + length if length != _UNDEFINED and begin + length <= len(data) else None
    return None if end is None else (begin, end)


def _end_of_items(data: bytes, at: int) -> int | None:
    """Where the delimiter of a sequence of items ends; None where it is missing or cut."""
    while at + 8 <= len(data):
        tag, length = data[at : at + 4], int.from_bytes(data[at + 4 : at + 8], "little")
        if tag == _END_OF_ITEMS:
            return at + 8 if length == 0 else None
        if tag != _ITEM or length == _UNDEFINED:
            return None
        at += 8 + length
    return None
