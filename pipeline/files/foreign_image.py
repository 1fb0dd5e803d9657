"""What the readers of label maps share: their result, their limits, and the refusals every format can end in.

A reader gets bytes, never a path, and fails closed: header first, then the arithmetic of declared against actual size,
only then voxels. Libraries that read these formats by name report success on truncated and damaged files.
"""

from __future__ import annotations

import gzip
import io
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.stage import Finding
from pipeline.errors import CaseRejected

#: Largest volume that is read; a whole leg at 0.5 mm has a quarter of it.
MAX_VOXELS = 1_000_000_000
#: Largest volume in memory as declared by the header.
MAX_BYTES = 4_000_000_000

_COPY_AGAIN = "Export the file again from the segmentation program, or copy it again, and compare the sizes."
_EXPORT_AGAIN = "Export it again from the segmentation program, or load it in 3D Slicer and save it there."


@dataclass(frozen=True, eq=False)
class ForeignImage:
    """A volume as its file holds it, before any judgement of its geometry or values.

    Attributes
    ----------
    values : (I, J, K, ...) array
        Voxels in file order, first index fastest on disk.
    lps_from_index : (4, 4) float64
        Takes the index of a voxel's centre to LPS millimetres.
    segments : mapping of str to int
        Segment name -> label value where the file names them (``.seg.nrrd``), else empty.
    findings : tuple of Finding
        What the reader had to assume.
    side : str
        ``right`` or ``left`` where the codes of the segments say so, else empty.
    frame_of_reference : str
        Stands for the space that the file lies in, to be compared within one run only; empty where it names none.
    """

    values: NDArray[Any]
    lps_from_index: NDArray[np.float64]
    segments: Mapping[str, int] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    side: str = ""
    frame_of_reference: str = ""


@dataclass(frozen=True)
class Layout:
    """Shape and type of the voxels as the header declares them.

    Attributes
    ----------
    shape : tuple of int
    dtype : numpy dtype
        With byte order.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def nbytes(self) -> int:
        """Bytes that the voxels take."""
        return math.prod(self.shape) * self.dtype.itemsize


def damaged(file: str, problem: str) -> CaseRejected:
    """E-IO-11: the bytes are not what the header says."""
    return CaseRejected("E-IO-11", f"{file} is damaged or incomplete: {problem}.", _COPY_AGAIN)


def unsupported(file: str, problem: str) -> CaseRejected:
    """E-IO-12: a kind of file that is not read."""
    return CaseRejected("E-IO-12", f"{file} is not supported: {problem}.", _EXPORT_AGAIN)


def bad_header(file: str, problem: str) -> CaseRejected:
    """E-IO-13: a header that is not understood."""
    return CaseRejected("E-IO-13", f"The header of {file} cannot be understood: {problem}.", _EXPORT_AGAIN)


def no_orientation(file: str, problem: str) -> CaseRejected:
    """E-GEO-01: the file does not say how it lies in the patient."""
    return CaseRejected(
        "E-GEO-01",
        f"The orientation of {file} in the patient is unknown: {problem}.",
        "Export the label map with its geometry (the same as the CT's); left and right cannot be told otherwise.",
    )


def not_finite(file: str) -> CaseRejected:
    """E-GEO-03: the matrix of the volume holds NaN, infinity or no volume."""
    return CaseRejected(
        "E-GEO-03",
        f"The geometry of {file} is not usable: its matrix is not finite or flattens the volume.",
        "Export the label map again with the CT's geometry.",
    )


def wrong_unit(file: str, unit: str) -> CaseRejected:
    """E-GEO-05: lengths are not in millimetres."""
    return CaseRejected(
        "E-GEO-05",
        f"{file} gives its lengths in {unit}, expected millimetres.",
        "Export it again in millimetres; programs disagree on how to convert this.",
    )


def not_labels(file: str, problem: str) -> CaseRejected:
    """E-LBL-02: a volume of something else than labels."""
    return CaseRejected(
        "E-LBL-02",
        f"{file} is not a label map: {problem}.",
        "Give the segmentation (one whole number for each structure), not the CT itself.",
    )


def check_layout(layout: Layout, file: str) -> None:
    """Refuse a declared size that is empty or beyond the limits, before anything is allocated.

    Raises
    ------
    CaseRejected
        E-IO-13 for an empty or negative axis, E-IO-14 beyond MAX_VOXELS or MAX_BYTES.
    """
    if not layout.shape or min(layout.shape) < 1:
        raise bad_header(file, f"it declares the size {_times(layout.shape)}")
    if math.prod(layout.shape) > MAX_VOXELS or layout.nbytes > MAX_BYTES:
        raise CaseRejected(
            "E-IO-14",
            f"{file} declares {_times(layout.shape)} voxels ({layout.nbytes / 1e9:.1f} GB), "
            f"expected at most {MAX_VOXELS:,} voxels and {MAX_BYTES / 1e9:.0f} GB.",
            "Crop the label map to the joint and save it with whole numbers of 8 or 16 bits.",
        )


def voxels(data: bytes, layout: Layout, file: str) -> NDArray[Any]:
    """The voxels, first index fastest; refuses (E-IO-11) any number of bytes but the declared one."""
    if len(data) != layout.nbytes:
        raise damaged(file, f"expected {layout.nbytes} bytes of voxels, got {len(data)}")
    return np.frombuffer(data, layout.dtype).reshape(layout.shape, order="F")


def gunzip(data: bytes, expected: int, file: str) -> bytes:
    """Inflate gzip bytes to their very end, which checks the CRC, but never beyond ``expected`` bytes.

    Raises
    ------
    CaseRejected
        E-IO-11 for truncated or altered bytes, or more than ``expected``.
    """
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
            out = stream.read(expected)
            surplus = stream.read(1)
    except (EOFError, OSError, zlib.error) as error:
        raise damaged(file, "its compressed data do not match their checksum or end too early") from error
    if surplus:
        raise damaged(file, f"it holds more than the {expected} bytes that its header declares")
    return out


def gunzip_head(data: bytes, length: int, file: str) -> bytes:
    """The first ``length`` inflated bytes, or fewer where there are fewer; CRC not yet checked."""
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
            return stream.read(length)
    except (EOFError, OSError, zlib.error) as error:
        raise damaged(file, "its compressed data cannot be read") from error


def inflate(data: bytes, expected: int, file: str) -> bytes:
    """Inflate a zlib stream to its very end, which checks its checksum, but never beyond ``expected`` bytes.

    Raises
    ------
    CaseRejected
        E-IO-11 for truncated or altered bytes, trailing bytes, or more than ``expected``.
    """
    machine = zlib.decompressobj()
    try:
        out = machine.decompress(data, expected + 1)
    except zlib.error as error:
        raise damaged(file, "its compressed data do not match their checksum") from error
    if len(out) > expected:
        raise damaged(file, f"it holds more than the {expected} bytes that its header declares")
    if not machine.eof or machine.unused_data:
        raise damaged(file, "its compressed data end too early or too late")
    return out


def _times(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape)) or "nothing"
