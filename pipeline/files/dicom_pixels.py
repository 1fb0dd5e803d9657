"""The pixels of DICOM slices to CT numbers: plain ones taken here, compressed ones by the decoder that is exact.

Format: DICOM PS3.5 chapter 8, PS3.3 C.7.6.3 (image pixel), C.11.1 (rescale), C.7.5.1 (padding).
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.stage import Finding, Severity
from pipeline.errors import CaseRejected
from pipeline.files.ct_volumes import AIR_HU, TOP_HU, hounsfield
from pipeline.files.dicom_headers import SYNTAXES, DicomHeader, silent_pydicom
from pipeline.files.dicom_stack import Stack

#: What is written where the scanner saw nothing.
NOTHING_HU = -1024

#: End of a compressed syntax -> its decoder, where there is a choice one that raises and does not abort the process.
_DECODERS = {
    "5": "pydicom",
    "57": "gdcm",
    "70": "gdcm",
    "80": "pyjpegls",
    "81": "pyjpegls",
    "90": "pillow",
    "91": "pillow",
}
#: What every stream but RLE ends with, before zeros.
_END_OF_IMAGE = b"\xff\xd9"
#: Markers of JPEG and JPEG-LS that the size of the picture follows.
_START_OF_FRAME = {*range(0xC0, 0xD0), 0xF7} - {0xC4, 0xC8, 0xCC}
_DECODE_ERRORS = (ArithmeticError, AttributeError, EOFError, LookupError, OSError, RuntimeError, TypeError, ValueError)
_COPY_AGAIN = "Export the series from the PACS again, or copy it again, and compare the number and size of the files."


def stack_values(stack: Stack, read: Callable[[str], bytes]) -> tuple[NDArray[np.int16], tuple[Finding, ...]]:
    """(columns, rows, slices) CT numbers of a stack, and what was changed on the way.

    Parameters
    ----------
    stack : Stack
    read : callable
        Name -> all bytes of that file.

    Raises
    ------
    CaseRejected
        E-IO-11 pixels that cannot be decoded, E-IO-17 a file that changed since its header was read, E-CT-02.
    """
    first = stack.slices[0]
    out = np.empty((first.columns or 0, first.rows or 0, len(stack.slices)), dtype=np.int16)
    findings: dict[str, Finding] = {}
    padded = 0
    for k, header in enumerate(stack.slices):
        stored = stored_pixels(_unchanged(read(header.file), header), header)
        hidden = _padding(stored, header, findings)
        padded += int(np.count_nonzero(hidden))
        slope, intercept = header.slope or 1.0, header.intercept or 0.0
        values, notes = hounsfield(np.where(hidden, 0, stored), (slope, intercept), header.file)
        findings.update({note.code: note for note in notes})
        values[hidden] = NOTHING_HU
        out[:, :, k] = values.T
    if padded:
        text = f"{padded} voxels that the scanner marked as outside of the scan were set to {NOTHING_HU} HU."
        findings["N-DCM-02"] = Finding("N-DCM-02", Severity.NOTE, text)
    return out, tuple(findings.values())


def stored_pixels(data: bytes, header: DicomHeader) -> NDArray[Any]:
    """(rows, columns) stored values of one slice, 16 bits, bits above BitsStored removed.

    Raises
    ------
    CaseRejected
        E-IO-11 when they cannot be decoded to the declared size.
    """
    begin, end = header.pixels
    _, little, encapsulated = SYNTAXES[header.transfer_syntax]
    kind = np.dtype("i2" if header.signed else "u2")
    shape = (header.rows or 0, header.columns or 0)
    if encapsulated:
        found = _decoded(data[begin:end], header)
    else:
        found = np.frombuffer(data[begin:end], kind.newbyteorder("<" if little else ">"))
        found = found.reshape(shape) if found.size == shape[0] * shape[1] else found
    if found.shape != shape:
        raise _undecodable(header)
    spare = 16 - (header.bits_stored or 16)
    # up and down again: what overlays left in the spare bits goes, and the sign comes back
    return np.asarray((found.astype(kind) << spare) >> spare)


def _decoded(items: bytes, header: DicomHeader) -> NDArray[Any]:
    """The picture in encapsulated items, once what makes decoders abort or hang is refused: cuts, another size."""
    decoder = _DECODERS[header.transfer_syntax.rpartition(".")[2]]
    if decoder != "pydicom":
        frame = _frame(items)
        ended = frame.rstrip(b"\0").endswith(_END_OF_IMAGE)
        if not ended or _frame_size(frame) != (header.rows, header.columns, 1):
            raise _undecodable(header)
    options: dict[str, Any] = {
        "decoding_plugin": decoder,
        "rows": header.rows,
        "columns": header.columns,
        "number_of_frames": 1,
        "samples_per_pixel": 1,
        "bits_allocated": 16,
        "bits_stored": header.bits_stored,
        "photometric_interpretation": header.photometric,
        "pixel_representation": int(header.signed is True),
        "pixel_keyword": "PixelData",
    }
    with silent_pydicom():  # a stream that is odd but decodes; the shape is checked
        from pydicom.pixels.decoders.base import get_decoder  # noqa: PLC0415 - loads every decoder

        try:
            found, _ = get_decoder(header.transfer_syntax).as_array(items, raw=True, **options)
        except _DECODE_ERRORS as error:
            raise _undecodable(header) from error
    return found


def _frame(items: bytes) -> bytes:
    """The fragments after the first item, which is the table of offsets, as one stream."""
    parts, at = [], 0
    while at + 16 <= len(items):  # the delimiter takes the last 8
        length = int.from_bytes(items[at + 4 : at + 8], "little")
        parts.append(items[at + 8 : at + 8 + length])
        at += 8 + length
    return b"".join(parts[1:])


def _frame_size(frame: bytes) -> tuple[int, int, int] | None:
    """Rows, columns and components as a JPEG, JPEG-LS or JPEG 2000 stream declares them."""
    if frame.startswith(b"\xff\x4f\xff\x51") and len(frame) >= 42:
        right, bottom, left, top = struct.unpack_from(">4I", frame, 8)
        return bottom - top, right - left, int.from_bytes(frame[40:42], "big")
    at = 2 if frame.startswith(b"\xff\xd8") else len(frame)
    while at + 10 <= len(frame) and frame[at] == 0xFF:
        if frame[at + 1] in _START_OF_FRAME:
            rows, columns, components = struct.unpack_from(">2HB", frame, at + 5)
            return rows, columns, components
        # a filling byte, or a segment that tells its length
        at += 1 if frame[at + 1] == 0xFF else 2 + int.from_bytes(frame[at + 2 : at + 4], "big")
    return None


def _undecodable(header: DicomHeader) -> CaseRejected:
    problem = f"{header.file} is damaged: its pixels cannot be decoded to {header.columns} x {header.rows}."
    return CaseRejected("E-IO-11", problem, _COPY_AGAIN)


def _unchanged(data: bytes, header: DicomHeader) -> bytes:
    if hashlib.sha256(data).hexdigest() != header.sha256:
        raise CaseRejected(
            "E-IO-17",
            f"{header.file} changed while it was being read.",
            "Wait until the file is copied completely, then run again.",
        )
    return data


def _padding(stored: NDArray[Any], header: DicomHeader, findings: dict[str, Finding]) -> NDArray[np.bool_]:
    """Pixels that stand for "nothing here"; none where that value is one of tissue, which is then told."""
    if header.padding is None:
        return np.zeros(stored.shape, dtype=bool)
    low, high = header.padding
    hidden = np.asarray((stored >= low) & (stored <= high))
    slope, intercept = header.slope or 1.0, header.intercept or 0.0
    if high * slope + intercept < AIR_HU or low * slope + intercept > TOP_HU or not hidden.any():
        return hidden
    text = (
        f"{header.file} marks as outside of the scan what has {low * slope + intercept:g} HU or more, which may be "
        "tissue; it was left as it is."
    )
    findings["N-DCM-03"] = Finding("N-DCM-03", Severity.NOTE, text)
    return np.zeros(stored.shape, dtype=bool)
