"""DICOM segmentations to a volume: Segmentation Storage of kind BINARY, and Label Map Segmentation Storage.

Format: DICOM PS3.3 A.51 and C.8.20, PS3.5 8.1.1 (pixels of one bit). Frames come in any order, and those without a
label may be left out; each is put where its own header says. pydicom walks the data set; libraries that read these
files whole take positions as they come.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import CaseRejected
from pipeline.files.dicom_headers import (
    CT_CLASSES,
    SYNTAXES,
    DicomFile,
    DicomHeader,
    Fault,
    Unread,
    frame_hash,
    open_dicom,
    silent_pydicom,
)
from pipeline.files.dicom_seg_grid import Grid, functional_groups, grid_of, group_item, read_places
from pipeline.files.dicom_seg_names import Segment, contradictions, read_segments, side_of, values_by_name
from pipeline.files.dicom_tags import PARSE_ERRORS
from pipeline.files.foreign_image import (
    ForeignImage,
    Layout,
    bad_header,
    check_layout,
    damaged,
    not_labels,
    unsupported,
)

SEGMENTATION = "1.2.840.10008.5.1.4.1.1.66.4"
LABEL_MAP = "1.2.840.10008.5.1.4.1.1.66.7"
#: Most frames of a file; a whole leg with ten structures has a tenth of it.
MAX_FRAMES = 50_000

_RLE = "1.2.840.10008.1.2.5"
_BIG_ENDIAN = "1.2.840.10008.1.2.2"
#: What else a PACS may give under this name.
_OTHER_KINDS = {
    **dict.fromkeys(CT_CLASSES, "it is a CT image, not a segmentation"),
    "1.2.840.10008.5.1.4.1.1.4": "it is an MR image, not a segmentation",
    "1.2.840.10008.5.1.4.1.1.481.3": "it is an RT structure set, which holds outlines, not voxels",
    "1.2.840.10008.5.1.4.1.1.66.5": "it is a surface segmentation, which holds meshes, not voxels",
}
#: Kind -> tags of its pixels -> what they may be.
_PIXELS: dict[str, dict[str, tuple[int, ...]]] = {
    "BINARY": {"samples": (1,), "bits_allocated": (1,), "bits_stored": (1,), "high_bit": (0,), "signed": (False,)},
    "LABELMAP": {"samples": (1,), "bits_allocated": (8, 16), "signed": (False,)},
}


@dataclass(frozen=True, eq=False)
class _Frames:
    """What the header says of the frames.

    Attributes
    ----------
    header : DicomHeader
    segments : tuple of Segment
    numbers : (F,) int
        The segment of each frame; 0 in a label map.
    grid : Grid
    """

    header: DicomHeader
    segments: tuple[Segment, ...]
    numbers: tuple[int, ...]
    grid: Grid


def read_dicom_seg(data: bytes, file: str) -> ForeignImage:
    """Read one DICOM segmentation.

    Parameters
    ----------
    data : bytes
        The whole file.
    file : str
        Its name relative to the case folder, for messages.

    Returns
    -------
    ForeignImage
        Values uint16, index: column, row, plane; each voxel has the number of its segment.

    Raises
    ------
    CaseRejected
        E-IO-11..14, E-GEO-01, E-GEO-02, E-DCM-08, E-DCM-11, E-DCM-13, E-DCM-16, E-LBL-02, E-LBL-04.
    """
    opened = open_dicom(data, file, classes=(SEGMENTATION, LABEL_MAP))
    if isinstance(opened, Unread):
        raise _unread(opened)
    kind = _kind(opened, file)
    try:
        with silent_pydicom():
            frames = _frames(opened, kind, file)
    except PARSE_ERRORS as error:
        raise damaged(file, "its header cannot be read to its end") from error
    values = _painted(data, frames, kind, file)
    return ForeignImage(
        values,
        frames.grid.lps_from_index,
        values_by_name(frames.segments, file),
        contradictions(frames.segments, file),
        side_of(frames.segments),
        frame_hash(opened.header.frame_uid),
    )


def _unread(found: Unread) -> CaseRejected:
    if found.fault is Fault.TOO_LARGE:
        return _too_large(f"{found.file} {found.reason} GB.")
    if found.fault in (Fault.COMPRESSION, Fault.OTHER_OBJECT):
        return unsupported(found.file, f"it {found.reason}")
    return damaged(found.file, f"it {found.reason}")


def _too_large(problem: str) -> CaseRejected:
    return CaseRejected("E-IO-14", problem, "Crop the segmentation to the joint and export it again.")


def _kind(opened: DicomFile, file: str) -> str:
    """``BINARY`` or ``LABELMAP``; anything else is refused before its frames are looked at."""
    header = opened.header
    if header.sop_class not in (SEGMENTATION, LABEL_MAP):
        raise unsupported(file, _OTHER_KINDS.get(header.sop_class, "it is another kind of DICOM object"))
    encapsulated = SYNTAXES[header.transfer_syntax][2]
    run_lengths = (header.transfer_syntax, header.sop_class) == (_RLE, LABEL_MAP)
    if header.transfer_syntax == _BIG_ENDIAN or (encapsulated and not run_lengths):
        raise unsupported(file, f"its frames are encoded in a way that is not read ({header.transfer_syntax})")
    if header.pixels == (0, 0):
        raise damaged(file, "it ends before the last of its pixels")
    kind = opened.tags.text("SegmentationType")
    if kind == "FRACTIONAL":
        raise not_labels(file, "it holds probabilities, not labels (SegmentationType FRACTIONAL)")
    if kind != {SEGMENTATION: "BINARY", LABEL_MAP: "LABELMAP"}[header.sop_class]:
        raise bad_header(file, "SegmentationType is missing or not that of its SOP class")
    for field, expected in _PIXELS[kind].items():
        if (got := getattr(header, field)) not in expected:
            raise bad_header(file, f"its pixels have {field} {got}, expected {' or '.join(map(str, expected))}")
    return kind


def _frames(opened: DicomFile, kind: str, file: str) -> _Frames:
    """Everything that stands before the pixels, and how large the volume is."""
    header = opened.header
    check_layout(Layout(_size(header), np.dtype(np.uint8)), file)
    if (header.frames or 0) > MAX_FRAMES:
        raise _too_large(f"{file} has {header.frames} frames, expected at most {MAX_FRAMES}.")
    groups = functional_groups(opened, file)
    segments = read_segments(opened.tags, file)
    grid = grid_of(read_places(groups, file), header, file)
    check_layout(Layout((*_size(header)[:2], grid.count), np.dtype(np.uint16)), file)
    numbers = tuple(_number(one, file) for one in groups) if kind == "BINARY" else (0,) * len(groups)
    if unknown := set(numbers) - {0, *(segment.number for segment in segments)}:
        raise bad_header(file, f"a frame is of segment {min(unknown)}, which is not described")
    seen = set(zip(numbers, grid.planes.tolist(), strict=True))
    if len(seen) != len(numbers):
        raise CaseRejected(
            "E-LBL-04",
            f"{file} has several frames of one segment in the same plane, expected one 3-D label map.",
            "Export one segmentation of one point in time.",
        )
    return _Frames(header, segments, numbers, grid)


def _size(header: DicomHeader) -> tuple[int, int, int]:
    return header.columns or 0, header.rows or 0, header.frames or 0


def _number(groups: Any, file: str) -> int:
    item = group_item(groups, "SegmentIdentificationSequence")
    number = None if item is None else item.short("ReferencedSegmentNumber")
    if not number:
        raise bad_header(file, "a frame does not say which segment it shows")
    return number


def _painted(data: bytes, frames: _Frames, kind: str, file: str) -> NDArray[np.uint16]:
    """(columns, rows, planes) the number of the segment that each voxel belongs to."""
    columns, rows, _ = _size(frames.header)
    values = np.zeros((frames.grid.count, rows, columns), dtype=np.uint16)
    labels = (_from_bits if kind == "BINARY" else _from_numbers)(data, frames, file)
    for k, found in zip(frames.grid.planes, labels, strict=True):
        picture = found.reshape(rows, columns)
        _check_free(values[k], picture, frames.segments, file)
        values[k] += picture
    return values.transpose(2, 1, 0)


def _check_free(
    plane: NDArray[np.uint16], picture: NDArray[np.uint16], segments: tuple[Segment, ...], file: str
) -> None:
    """No voxel of a picture has a label already."""
    taken = np.flatnonzero((plane > 0) & (picture > 0))
    if not len(taken):
        return
    pair = {int(plane.flat[taken[0]]), int(picture.flat[taken[0]])}
    shown = " and ".join(segment.shown for segment in segments if segment.number in pair)
    raise CaseRejected(
        "E-LBL-04",
        f"{file} gives the same voxels to {shown} ({len(taken)} of them in one plane), expected one label for each.",
        "In 3D Slicer remove the overlap of the segments, or export the segmentation as a label map.",
    )


def _from_bits(data: bytes, frames: _Frames, file: str) -> Iterator[NDArray[np.uint16]]:
    """Frame by frame; eight voxels share a byte, and frames follow one another without a gap."""
    columns, rows, count = _size(frames.header)
    each = columns * rows
    packed = _native(data, frames.header, math.ceil(each * count / 8), file)
    for begin, number in zip(range(0, each * count, each), frames.numbers, strict=True):
        part = packed[begin // 8 : math.ceil((begin + each) / 8)]
        bits = np.unpackbits(part, bitorder="little")[begin % 8 : begin % 8 + each]
        yield bits * np.uint16(number)


def _from_numbers(data: bytes, frames: _Frames, file: str) -> Iterator[NDArray[np.uint16]]:
    """Frame by frame, with 0 for what the file names as its background."""
    header = frames.header
    columns, rows, count = _size(header)
    low, high = header.padding or (0, 0)
    if SYNTAXES[header.transfer_syntax][2]:
        pictures = _run_lengths(data, header, file)
    else:
        kind = np.dtype(f"<u{(header.bits_allocated or 0) // 8}")
        flat = _native(data, header, columns * rows * count * kind.itemsize, file)
        pictures = iter(flat.view(kind).reshape(count, -1))
    for picture in pictures:
        yield np.where((picture >= low) & (picture <= high), 0, picture).astype(np.uint16)


def _native(data: bytes, header: DicomHeader, expected: int, file: str) -> NDArray[np.uint8]:
    """The bytes of the pixels, without the one that makes their number even."""
    begin, end = header.pixels
    if end - begin not in (expected, expected + expected % 2):
        raise damaged(file, f"expected {expected} bytes of voxels, got {end - begin}")
    return np.frombuffer(data, np.uint8, expected, begin)


def _run_lengths(data: bytes, header: DicomHeader, file: str) -> Iterator[NDArray[Any]]:
    from pydicom.pixels.decoders.base import get_decoder  # noqa: PLC0415 - loads every decoder

    columns, rows, count = _size(header)
    options: dict[str, Any] = {
        "decoding_plugin": "pydicom",
        "rows": rows,
        "columns": columns,
        "number_of_frames": count,
        "samples_per_pixel": 1,
        "bits_allocated": header.bits_allocated,
        "bits_stored": header.bits_allocated,
        "photometric_interpretation": "MONOCHROME2",
        "pixel_representation": 0,
        "pixel_keyword": "PixelData",
    }
    found = 0
    begin, end = header.pixels
    try:
        with silent_pydicom():
            decoded = get_decoder(_RLE).iter_array(data[begin:end], raw=True, **options)
            for found, (picture, _) in enumerate(decoded, start=1):
                if found > count:
                    break
                yield picture
    except PARSE_ERRORS as error:
        raise damaged(file, f"its frames cannot be decoded to {columns} x {rows}") from error
    if found != count:
        raise damaged(file, f"expected {count} frames, got {'more' if found > count else found}")
