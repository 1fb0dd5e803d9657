"""MetaImage label maps with local data (``.mha``): bytes to volume.

Format: https://itk.org/Wiki/ITK/MetaIO/Documentation. As ITK has it, world coordinates are LPS millimetres whatever
``AnatomicalOrientation`` says, and the i-th row of ``TransformMatrix`` is the direction of axis i.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import CaseRejected
from pipeline.files.foreign_image import (
    ForeignImage,
    Layout,
    bad_header,
    check_layout,
    damaged,
    inflate,
    no_orientation,
    unsupported,
    voxels,
)

_MAX_HEADER_BYTES = 100_000
_TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
#: Older names of a key -> the name used here.
_ALIASES = {
    "Position": "Offset",
    "Origin": "Offset",
    "Rotation": "TransformMatrix",
    "Orientation": "TransformMatrix",
    "ElementByteOrderMSB": "BinaryDataByteOrderMSB",
}


def read_metaimage(data: bytes, file: str) -> ForeignImage:
    """Read one MetaImage volume with local data.

    Parameters
    ----------
    data : bytes
        The whole file.
    file : str
        Its name relative to the case folder, for messages.

    Raises
    ------
    CaseRejected
        E-IO-11..14, E-GEO-01, E-LBL-04.
    """
    header, body = _split(data, file)
    if header.get("NDims") != "3":
        raise CaseRejected(
            "E-LBL-04",
            f"{file} has {header.get('NDims', 'no')} dimensions, expected one 3-D label map.",
            "Export the segmentation as one 3-D label map.",
        )
    layout = _layout(header, file)
    check_layout(layout, file)
    lps_from_index = _lps_from_index(header, file)
    content = inflate(body, layout.nbytes, file) if _flag(header, "CompressedData", file) else body
    return ForeignImage(voxels(content, layout, file), lps_from_index)


def _split(data: bytes, file: str) -> tuple[Mapping[str, str], bytes]:
    """Header as key -> text, and what follows its last line (``ElementDataFile``)."""
    header: dict[str, str] = {}
    begin = 0
    while "ElementDataFile" not in header:
        end = data.find(b"\n", begin, _MAX_HEADER_BYTES)
        if end < 0:
            raise damaged(file, "it is not a MetaImage file with a complete header")
        key, equals, value = data[begin:end].decode("latin-1").partition("=")
        key = _ALIASES.get(key.strip(), key.strip())
        if not equals or key in header:
            raise bad_header(file, f"line {len(header) + 1} has no '=' or repeats a key")
        header[key] = value.strip()
        begin = end + 1
    if header["ElementDataFile"].upper() != "LOCAL":
        raise unsupported(file, "its voxels are in another file")
    return header, data[begin:]


def _layout(header: Mapping[str, str], file: str) -> Layout:
    for key, expected in (
        ("ObjectType", "Image"),
        ("BinaryData", "True"),
        ("ElementNumberOfChannels", "1"),
        ("HeaderSize", "0"),
    ):
        if header.get(key, expected) != expected:
            raise unsupported(file, f"{key} is {header[key]}, expected {expected}")
    code = _TYPES.get(header.get("ElementType", ""))
    if code is None:
        raise unsupported(file, f"its voxels are of type {header.get('ElementType', 'none')}")
    order = ">" if _flag(header, "BinaryDataByteOrderMSB", file) else "<"
    size = _numbers(header, "DimSize", 3, file)
    if not (size == size.astype(np.int64)).all():
        raise bad_header(file, "DimSize is not whole numbers")
    return Layout(tuple(int(n) for n in size), np.dtype(order + code))


def _lps_from_index(header: Mapping[str, str], file: str) -> NDArray[np.float64]:
    for key in ("TransformMatrix", "Offset", "ElementSpacing"):
        if key not in header:
            raise no_orientation(file, f"{key} missing")
    rows = _numbers(header, "TransformMatrix", 9, file).reshape(3, 3)
    out = np.eye(4)
    out[:3, :3] = rows.T * _numbers(header, "ElementSpacing", 3, file)
    out[:3, 3] = _numbers(header, "Offset", 3, file)
    return out


def _numbers(header: Mapping[str, str], key: str, count: int, file: str) -> NDArray[np.float64]:
    try:
        out = np.array([float(word) for word in header.get(key, "").split()])
    except ValueError as error:
        raise bad_header(file, f"{key} is not numbers") from error
    if len(out) != count or not np.isfinite(out).all():
        raise bad_header(file, f"{key} is not {count} finite numbers")
    return out


def _flag(header: Mapping[str, str], key: str, file: str) -> bool:
    value = header.get(key, "False").lower()
    if value not in ("true", "false"):
        raise bad_header(file, f"{key} is neither True nor False")
    return value == "true"
