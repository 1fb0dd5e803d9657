"""NRRD label maps, also 3D Slicer's ``.seg.nrrd``: bytes to volume, and our own volume to bytes.

Format: http://teem.sourceforge.net/nrrd/format.html; segment keys: 3D Slicer, "Segmentation labelmap file format".
pynrrd parses the header; the voxels are taken here, because a data file named by a header must never be opened.
"""

from __future__ import annotations

import gzip
import io
import re
from collections.abc import Mapping
from typing import Any

import nrrd
import numpy as np
from numpy.typing import NDArray

from pipeline.errors import CaseRejected
from pipeline.files.foreign_image import (
    ForeignImage,
    Layout,
    bad_header,
    check_layout,
    damaged,
    gunzip,
    no_orientation,
    unsupported,
    voxels,
    wrong_unit,
)
from pipeline.geometry.volume import CtVolume, LabelVolume

_MAX_HEADER_BYTES = 4_000_000
_END_OF_HEADER = re.compile(rb"\r?\n\r?\n")
_SEGMENT_KEY = re.compile(r"(Segment\d+)_(Name|LabelValue)")

#: How hard each type is compressed: noise of a CT gains nothing for its time.
_LEVEL_OF = {"uint8": 6, "uint16": 6, "int16": 1}

#: What turns a vector of the file's space into LPS.
_LPS_FROM_SPACE = {
    "left-posterior-superior": (1.0, 1.0, 1.0),
    "lps": (1.0, 1.0, 1.0),
    "right-anterior-superior": (-1.0, -1.0, 1.0),
    "ras": (-1.0, -1.0, 1.0),
    "left-anterior-superior": (1.0, -1.0, 1.0),
    "las": (1.0, -1.0, 1.0),
}
_TYPES = {
    name: code
    for code, names in {
        "i1": "signed char|int8|int8_t",
        "u1": "uchar|unsigned char|uint8|uint8_t",
        "i2": "short|short int|signed short|signed short int|int16|int16_t",
        "u2": "ushort|unsigned short|unsigned short int|uint16|uint16_t",
        "i4": "int|signed int|int32|int32_t",
        "u4": "uint|unsigned int|uint32|uint32_t",
        "i8": "longlong|long long|long long int|signed long long|signed long long int|int64|int64_t",
        "u8": "ulonglong|unsigned long long|unsigned long long int|uint64|uint64_t",
        "f4": "float",
        "f8": "double",
    }.items()
    for name in names.split("|")
}


def read_nrrd(data: bytes, file: str) -> ForeignImage:
    """Read one NRRD volume with attached data.

    Parameters
    ----------
    data : bytes
        The whole file.
    file : str
        Its name relative to the case folder, for messages.

    Returns
    -------
    ForeignImage
        With segment names where the header has them.

    Raises
    ------
    CaseRejected
        E-IO-11..14, E-GEO-01, E-GEO-05, E-LBL-04 (overlapping layers).
    """
    header, body = _split(data, file)
    layout = _layout(header, file)
    check_layout(layout, file)
    directions, domain = _directions(header, layout, file)
    values = voxels(_voxel_bytes(body, str(header.get("encoding")), layout.nbytes, file), layout, file)
    return ForeignImage(
        values.reshape([layout.shape[axis] for axis in domain], order="F"),
        _lps_from_index(header, directions, file),
        _segments(header, file),
    )


def encode_nrrd(volume: LabelVolume | CtVolume) -> bytes:
    """NRRD bytes of a label volume or a CT: LPS, gzip without a date; equal volumes give equal bytes."""
    values = np.asarray(volume.values)
    kind = values.dtype.name
    if kind not in _LEVEL_OF or values.ndim != 3:
        raise ValueError(f"expected a uint8, uint16 or int16 volume, got {values.dtype} of shape {values.shape}")
    columns = volume.lps_from_index[:3]
    lines = (
        "NRRD0004",
        f"# {'CT' if kind == 'int16' else 'label map'}, millimetres, LPS",
        f"type: {kind}",
        "dimension: 3",
        "space: left-posterior-superior",
        f"sizes: {' '.join(map(str, values.shape))}",
        f"space directions: {' '.join(_vector(columns[:, axis]) for axis in range(3))}",
        "kinds: domain domain domain",
        "endian: little",
        "encoding: gzip",
        f"space origin: {_vector(columns[:, 3])}",
    )
    raw = values.astype(values.dtype.newbyteorder("<")).tobytes(order="F")
    return ("\n".join(lines) + "\n\n").encode() + _gzip(raw, _LEVEL_OF[kind])


def _gzip(raw: bytes, level: int) -> bytes:
    buffer = io.BytesIO()
    with gzip.GzipFile(filename="", mode="wb", fileobj=buffer, mtime=0, compresslevel=level) as stream:
        stream.write(raw)
    return buffer.getvalue()


def _vector(vector: NDArray[np.float64]) -> str:
    # + 0.0 turns -0.0 into 0.0, so that equal geometry is equal text
    return f"({','.join(repr(float(x) + 0.0) for x in vector)})"


def _split(data: bytes, file: str) -> tuple[Mapping[str, Any], bytes]:
    """Parsed header and what follows it."""
    end = _END_OF_HEADER.search(data, 0, _MAX_HEADER_BYTES)
    if not data.startswith(b"NRRD") or end is None:
        raise damaged(file, "it is not a NRRD file with a complete header")
    try:
        header = nrrd.read_header(data[: end.start()].decode("utf-8").splitlines())
    except (nrrd.NRRDError, ValueError, KeyError, IndexError, TypeError) as error:
        raise bad_header(file, str(error).strip().rstrip(".") or type(error).__name__) from error
    return header, data[end.end() :]


def _layout(header: Mapping[str, Any], file: str) -> Layout:
    for detached in ("data file", "datafile"):
        if detached in header:
            raise unsupported(file, "its voxels are in another file")
    for skip in ("line skip", "lineskip", "byte skip", "byteskip"):
        if header.get(skip, 0) != 0:
            raise unsupported(file, f"it asks to skip data ({skip})")
    missing = [name for name in ("type", "dimension", "sizes", "encoding") if name not in header]
    if missing:
        raise bad_header(file, f"{', '.join(missing)} missing")
    shape = tuple(int(size) for size in header["sizes"])
    if header["dimension"] != len(shape):
        raise bad_header(file, f"it declares {header['dimension']} dimensions and {len(shape)} sizes")
    return Layout(shape, _dtype(header, file))


def _dtype(header: Mapping[str, Any], file: str) -> np.dtype[Any]:
    code = _TYPES.get(str(header["type"]).lower())
    if code is None:
        raise unsupported(file, f"its voxels are of type {header['type']}")
    order = {"little": "<", "big": ">"}.get(str(header.get("endian", "little" if code.endswith("1") else "")).lower())
    if order is None:
        raise bad_header(file, "endian is missing or neither little nor big")
    return np.dtype(order + code)


def _directions(header: Mapping[str, Any], layout: Layout, file: str) -> tuple[NDArray[np.float64], list[int]]:
    """(3, 3) rows of the spatial axes in the file's space, and which axes of the array they are."""
    if "space directions" not in header:
        raise no_orientation(file, "space directions missing")
    rows = np.asarray(header["space directions"], dtype=np.float64)
    if rows.ndim != 2 or rows.shape != (len(layout.shape), 3):
        raise no_orientation(file, "space directions do not match its axes")
    domain = [axis for axis, row in enumerate(rows) if not np.isnan(row).all()]
    others = [size for axis, size in enumerate(layout.shape) if axis not in domain]
    if len(domain) != 3 or any(size != 1 for size in others):
        raise CaseRejected(
            "E-LBL-04",
            f"{file} has {' x '.join(map(str, others)) or 'no'} layers, expected one 3-D label map.",
            "In 3D Slicer remove the overlap of the segments, or export the segmentation as a label map.",
        )
    return rows[domain], domain


def _lps_from_index(header: Mapping[str, Any], directions: NDArray[np.float64], file: str) -> NDArray[np.float64]:
    signs = _LPS_FROM_SPACE.get(str(header.get("space", "")).lower())
    if signs is None:
        raise no_orientation(file, f"its space is {header.get('space', 'missing')}, expected left-posterior-superior")
    origin = np.asarray(header.get("space origin", ()), dtype=np.float64)
    if origin.shape != (3,):
        raise no_orientation(file, "space origin missing")
    units = set(header.get("space units", ()))
    if units - {"mm", "millimeter", "millimeters", ""}:
        raise wrong_unit(file, ", ".join(sorted(units)))
    out = np.eye(4)
    out[:3, :3] = (directions * signs).T
    out[:3, 3] = origin * signs
    return out


def _voxel_bytes(body: bytes, encoding: str, expected: int, file: str) -> bytes:
    if encoding == "raw":
        return body
    if encoding in ("gzip", "gz"):
        return gunzip(body, expected, file)
    raise unsupported(file, f"its encoding is {encoding}, expected raw or gzip")


def _segments(header: Mapping[str, Any], file: str) -> dict[str, int]:
    """Segment name -> label value; a name or a value that occurs twice is refused."""
    keys: dict[str, dict[str, str]] = {}
    for key, value in header.items():
        if match := _SEGMENT_KEY.fullmatch(key):
            keys.setdefault(match[1], {})[match[2]] = str(value)
    out: dict[str, int] = {}
    for segment in keys.values():
        name, value = segment.get("Name", ""), segment.get("LabelValue", "")
        if not name or not re.fullmatch(r"[0-9]{1,5}", value) or name in out or int(value) in out.values():
            raise bad_header(file, f"segment {name or 'without a name'} has no name or label value of its own")
        out[name] = int(value)
    return out
