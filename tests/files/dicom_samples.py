"""A small leg as a DICOM series, and every way to spoil one: what scanners, exports and copies do to it."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Mapping

import numpy as np
import pytest
from pydicom import DataElement, Dataset, dcmread, dcmwrite
from pydicom.datadict import dictionary_VR, tag_for_keyword
from pydicom.dataelem import RawDataElement
from pydicom.tag import Tag
from pydicom.uid import UID

from pipeline.errors import CaseRejected
from pipeline.files.ct_volumes import CtScan
from pipeline.files.dicom_headers import DEFLATED, DicomHeader, read_header, silent_pydicom
from pipeline.files.dicom_series import read_dicom_series
from pipeline.files.dicom_writer import SeriesSpec, encode_series
from pipeline.geometry.volume import CtVolume

Files = dict[str, bytes]

SPACING_MM = (1.0, 1.25, 2.0)
ORIGIN_MM = (-12.5, 33.125, 200.75)
#: A CT image that is not one slice: enhanced.
ENHANCED = "1.2.840.10008.5.1.4.1.1.2.1"
SECONDARY_CAPTURE = "1.2.840.10008.5.1.4.1.1.7"
STRUCTURED_REPORT = "1.2.840.10008.5.1.4.1.1.88.33"


def leg(*, oblique: bool = False) -> CtVolume:
    """Bone in tissue in air, 24 x 20 x 12, no two voxels rows alike; stored in LPS order."""
    values = np.full((24, 20, 12), -1000, dtype=np.int16)
    values[4:20, 4:16] = 40
    values[8:15, 6:12] = 900
    values[15:18, 11:14, 3:] = 1300
    values += np.random.default_rng(7).integers(-20, 20, values.shape).astype(np.int16)
    matrix = np.diag([*SPACING_MM, 1.0])
    matrix[:3, 3] = ORIGIN_MM
    if oblique:
        matrix[:3, :3] = turned(7.0, -4.0) * SPACING_MM
    return CtVolume(values, matrix)


def turned(about_z_deg: float, about_x_deg: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """(3, 3) rotation about two axes of the patient."""
    a, b = np.radians([about_z_deg, about_x_deg])
    about_z = np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(b), -np.sin(b)], [0.0, np.sin(b), np.cos(b)]])
    return np.asarray(about_z @ about_x)


def series(spec: SeriesSpec | None = None) -> Files:
    """The leg, twelve files ``IM0001.dcm`` to ``IM0012.dcm``, from its lower to its upper end."""
    return encode_series(leg(), spec)


def read(files: Mapping[str, bytes]) -> CtScan:
    return read_dicom_series(list(files), files.__getitem__)


def edited(data: bytes, tags: Mapping[str, bytes | None], meta: Mapping[str, str] | None = None) -> bytes:
    """A file with the raw bytes of tags replaced, however invalid; ``None`` takes the tag away."""
    with silent_pydicom():
        return _edited(dcmread(io.BytesIO(data)), tags, meta or {})


def _edited(dataset: Dataset, tags: Mapping[str, bytes | None], meta: Mapping[str, str]) -> bytes:
    implicit, little = dataset.original_encoding
    for keyword, value in tags.items():
        number = tag_for_keyword(keyword)
        assert number is not None
        tag = Tag(number)
        if value is None:
            del dataset[tag]
            continue
        vr = dictionary_VR(tag).split(" or ", maxsplit=1)[0]
        even = value + b" " * (len(value) % 2)
        raw = RawDataElement(tag, vr, len(even), even, 0, bool(implicit), bool(little))
        dataset[tag] = raw
    for keyword, text in meta.items():
        setattr(dataset.file_meta, keyword, UID(text))
    return written(dataset)


def written(dataset: Dataset) -> bytes:
    buffer = io.BytesIO()
    dcmwrite(buffer, dataset, enforce_file_format=True)
    return buffer.getvalue()


def short(number: int) -> bytes:
    """The bytes of one US value."""
    return struct.pack("<H", number & 0xFFFF)


def with_edited(files: Files, tags: Mapping[str, bytes | None], *names: str) -> Files:
    """The series with tags replaced in some files (none named: in all)."""
    return {name: edited(data, tags) if name in names or not names else data for name, data in files.items()}


def with_positions(files: Files, positions: Mapping[str, tuple[float, ...]]) -> Files:
    """The series with slices moved, mm LPS."""
    return {
        name: edited(data, {"ImagePositionPatient": ds(*positions[name])}) if name in positions else data
        for name, data in files.items()
    }


def at_heights(files: Files, heights: Mapping[str, float]) -> Files:
    """The series with slices moved along the axis of the body."""
    return with_positions(files, {name: (ORIGIN_MM[0], ORIGIN_MM[1], z) for name, z in heights.items()})


def height(name: str) -> float:
    """Where a file of the series lies, mm."""
    return ORIGIN_MM[2] + SPACING_MM[2] * (int(name[2:6]) - 1)


def tilted(files: Files, degrees: float) -> Files:
    """The slices of a tilted gantry: upright images whose places drift sideways as the table moves."""
    drift = np.tan(np.radians(degrees))
    places = {
        name: (ORIGIN_MM[0], ORIGIN_MM[1] + drift * (height(name) - ORIGIN_MM[2]), height(name)) for name in files
    }
    return with_positions(files, places)


def ds(*numbers: float) -> bytes:
    """The bytes of a decimal string."""
    return "\\".join(f"{number:.12g}" for number in numbers).encode()


def scout(files: Files, *, localizer: bool, size: int = 20) -> bytes:
    """A coronal overview in the same series."""
    dataset = dcmread(io.BytesIO(files["IM0001.dcm"]))
    dataset.SOPInstanceUID = dataset.file_meta.MediaStorageSOPInstanceUID = UID("1.2.3.4.5")
    dataset.ImageOrientationPatient = [1, 0, 0, 0, 0, -1]
    dataset.ImageType = ["ORIGINAL", "PRIMARY", "LOCALIZER" if localizer else "AXIAL"]
    dataset.Rows = size
    dataset.PixelData = bytes(2 * size * int(dataset.Columns))
    return written(dataset)


def other_object(files: Files, modality: str, sop_class: str) -> bytes:
    """A report, structure set or capture that a PACS exports along with the series."""
    source = dcmread(io.BytesIO(files["IM0001.dcm"]))
    out = Dataset()
    out.SOPClassUID, out.SOPInstanceUID = UID(sop_class), UID("1.2.3.4.6")
    for keyword in ("PatientID", "PatientName", "StudyInstanceUID"):
        out[keyword] = source[keyword]
    out.SeriesInstanceUID, out.Modality = UID("1.2.3.4.7"), modality
    out.add(DataElement(0x0040A730, "SQ", [Dataset()]))
    out.file_meta = source.file_meta
    out.file_meta.MediaStorageSOPClassUID = out.SOPClassUID
    return written(out)


def enhanced(files: Files) -> bytes:
    """An enhanced CT in outline: its geometry lies in sequences, not at the top level."""
    tags: dict[str, bytes | None] = {
        "SOPClassUID": ENHANCED.encode(),
        "SOPInstanceUID": b"1.2.3.4.8",
        "NumberOfFrames": b"12",
        "ImagePositionPatient": None,
        "ImageOrientationPatient": None,
        "PixelSpacing": None,
    }
    return edited(files["IM0001.dcm"], tags, {"MediaStorageSOPClassUID": ENHANCED})


def deflated(data: bytes, surplus: int = 0) -> bytes:
    """A file in the deflated syntax; with a surplus a bomb: that many zeros more in a few bytes."""
    dataset = dcmread(io.BytesIO(data))
    dataset.file_meta.TransferSyntaxUID = UID(DEFLATED)
    out = written(dataset)
    if not surplus:
        return out
    machine = zlib.compressobj(9, wbits=-zlib.MAX_WBITS)
    body = machine.compress(bytes(surplus)) + machine.flush()
    meta_length = 132 + 12 + struct.unpack_from("<I", out, 140)[0]
    return out[:meta_length] + body


def refused(code: str, problem: str = "") -> pytest.RaisesExc[CaseRejected]:
    """Expects a refusal of this code, its problem or action holding a pattern."""
    return pytest.raises(CaseRejected, match=f"(?s)^{code} .*{problem}")


def assert_same(found: CtScan, expected: CtVolume) -> None:
    """The same voxels in the same place."""
    np.testing.assert_array_equal(found.volume.values, expected.values)
    np.testing.assert_allclose(found.volume.lps_from_index, expected.lps_from_index, atol=1e-6)


def codes(found: CtScan) -> list[str]:
    """Of the findings, in order."""
    return [finding.code for finding in found.findings]


def without(files: Files, *names: str) -> Files:
    """A series with files left out."""
    return {name: data for name, data in files.items() if name not in names}


def headers_of(files: Files) -> list[DicomHeader]:
    """The headers of those that can be read."""
    found = [read_header(data, name) for name, data in files.items()]
    return [header for header in found if isinstance(header, DicomHeader)]
