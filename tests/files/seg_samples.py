"""DICOM segmentations that highdicom writes, and ways to spoil them."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, MutableSequence, Sequence
from dataclasses import dataclass, replace
from functools import cache

import highdicom
import numpy as np
from highdicom.seg import Segmentation, SegmentDescription
from pydicom import Dataset, dcmread
from pydicom.sr.coding import Code

from pipeline.files.dicom_writer import SeriesSpec, encode_series
from pipeline.files.volumes import LabelMap, read_label_map
from pipeline.geometry.volume import CtVolume, LabelVolume
from tests.files.label_samples import knee_like

EXPLICIT, IMPLICIT, RLE = "1.2.840.10008.1.2.1", "1.2.840.10008.1.2", "1.2.840.10008.1.2.5"

FEMUR, TIBIA = Code("71341001", "SCT", "Femur"), Code("12611008", "SCT", "Tibia")
PATELLA, FIBULA = Code("64234005", "SCT", "Patella"), Code("87342007", "SCT", "Fibula")
CARTILAGE, MENISCUS = Code("309312004", "SCT", "Cartilage"), Code("74135004", "SCT", "Meniscus")
BONE, KNEE_JOINT = Code("272673000", "SCT", "Bone"), Code("49076000", "SCT", "Knee joint")
MEDIAL, LATERAL = Code("255561001", "SCT", "Medial"), Code("49370004", "SCT", "Lateral")
RIGHT, LEFT = Code("24028007", "SCT", "Right"), Code("7771000", "SCT", "Left")
OTHER = Code("91723000", "SCT", "Anatomical Structure")


@dataclass(frozen=True)
class Described:
    """One segment: its label, the code of its type, of its place, and what both are modified by."""

    label: str
    code: Code = OTHER
    place: Code | None = None
    modifiers: tuple[Code, ...] = ()


#: What highdicom copies from a CT that ours does not have.
_LEFT_EMPTY = (
    "PatientBirthDate",
    "PatientSex",
    "AccessionNumber",
    "StudyID",
    "StudyDate",
    "StudyTime",
    "ReferringPhysicianName",
)
#: Of :func:`knee`.
SEGMENTS = (
    Described("Femur", FEMUR),
    Described("Tibia", TIBIA),
    Described("Femoral cartilage", CARTILAGE, FEMUR),
    Described("Patella", PATELLA),
)


@dataclass(frozen=True)
class SegSpec:
    """How a segmentation is written; ``frame_uid`` of the CT it was drawn on, kept where empty."""

    kind: str = "BINARY"
    syntax: str = EXPLICIT
    segments: Sequence[Described] = SEGMENTS
    omit_empty: bool = True


def knee() -> LabelVolume:
    """The small label map with the values 1 to 4, as segments are numbered: femur, tibia, cartilage, patella."""
    values = np.asarray(knee_like().values)
    number_of = np.zeros(8, dtype=np.uint8)
    number_of[[5, 6, 1, 7]] = (1, 2, 3, 4)
    return replace(knee_like(), values=number_of[values])


def with_gap(volume: LabelVolume) -> LabelVolume:
    """The same with the planes between femur and tibia, and a few at both ends, without a label."""
    values = np.array(volume.values)
    values[:, :, [0, 1, 9, 10, 11, 12, 13, 23]] = 0
    return LabelVolume(values, volume.lps_from_index)


def source_images(volume: LabelVolume) -> list[Dataset]:
    """A CT series on the grid of a label map, as highdicom wants it."""
    ct = CtVolume(np.zeros(volume.values.shape, dtype=np.int16), volume.lps_from_index)
    images: list[Dataset] = [dcmread(io.BytesIO(data)) for data in encode_series(ct, SeriesSpec()).values()]
    for image in images:
        image.PatientName = "SYNTHETIC^"
        for keyword in _LEFT_EMPTY:
            setattr(image, keyword, image.get(keyword, ""))
    return images


def seg_dataset(volume: LabelVolume, spec: SegSpec | None = None) -> Dataset:
    """A segmentation of a label map whose geometry is written as exactly as DICOM can."""
    spec = spec or SegSpec()
    columns, spacing = volume.lps_from_index[:3], volume.spacing_mm
    directions = columns[:, :3] / spacing
    measures = highdicom.PixelMeasuresSequence((spacing[1], spacing[0]), spacing[2], spacing[2])
    positions = [
        highdicom.PlanePositionSequence("PATIENT", tuple(columns[:, 3] + k * columns[:, 2]))
        for k in range(volume.values.shape[2])
    ]
    pixels = np.transpose(np.asarray(volume.values), (2, 1, 0))
    if spec.kind == "FRACTIONAL":
        pixels = np.stack([pixels == n + 1 for n in range(len(spec.segments))], axis=-1).astype(np.float32) * 0.5
    return Segmentation(
        source_images=source_images(volume),
        pixel_array=pixels,
        segmentation_type=spec.kind,
        segment_descriptions=[_description(n, one) for n, one in enumerate(spec.segments, start=1)],
        series_instance_uid="1.2.3.4.50",
        series_number=2,
        sop_instance_uid="1.2.3.4.51",
        instance_number=1,
        manufacturer="SYNTHETIC",
        manufacturer_model_name="SYNTHETIC",
        software_versions="1",
        device_serial_number="1",
        transfer_syntax_uid=spec.syntax,
        pixel_measures=measures,
        plane_orientation=highdicom.PlaneOrientationSequence("PATIENT", tuple(directions.T[:2].ravel())),
        plane_positions=positions,
        omit_empty_frames=spec.omit_empty,
    )


def seg_bytes(volume: LabelVolume, spec: SegSpec | None = None) -> bytes:
    """The file of :func:`seg_dataset`."""
    buffer = io.BytesIO()
    seg_dataset(volume, spec).save_as(buffer)
    return buffer.getvalue()


def frame_groups(dataset: Dataset) -> MutableSequence[Dataset]:
    """The functional groups of each frame."""
    groups: MutableSequence[Dataset] = dataset.PerFrameFunctionalGroupsSequence
    return groups


def moved(dataset: Dataset, shifts: Mapping[int, tuple[float, float, float]]) -> None:
    """Frames pushed to another place, mm."""
    for frame, shift in shifts.items():
        position = frame_groups(dataset)[frame].PlanePositionSequence[0]
        position.ImagePositionPatient = [
            f"{x + d:.10g}" for x, d in zip(position.ImagePositionPatient, shift, strict=True)
        ]


def reordered(dataset: Dataset, order: Sequence[int]) -> None:
    """The frames in another order, their pixels with them."""
    size = int(dataset.Rows) * int(dataset.Columns)
    bits = np.unpackbits(np.frombuffer(dataset.PixelData, np.uint8), bitorder="little")
    pictures = bits[: size * int(dataset.NumberOfFrames)].reshape(-1, size)[list(order)]
    packed = np.packbits(pictures.ravel(), bitorder="little").tobytes()
    dataset.PixelData = packed + b"\0" * (len(packed) % 2)
    groups = list(dataset.PerFrameFunctionalGroupsSequence)
    dataset.PerFrameFunctionalGroupsSequence = [groups[frame] for frame in order]


def _description(number: int, one: Described) -> SegmentDescription:
    out = SegmentDescription(
        segment_number=number,
        segment_label=one.label,
        segmented_property_category=Code("91723000", "SCT", "Anatomical Structure"),
        segmented_property_type=one.code,
        algorithm_type="MANUAL",
        anatomic_regions=[] if one.place is None else [one.place],
    )
    if one.modifiers:
        inner = out.SegmentedPropertyTypeCodeSequence[0]
        inner.SegmentedPropertyTypeModifierCodeSequence = [_coded(code) for code in one.modifiers]
    return out


def _coded(code: Code) -> Dataset:
    item = Dataset()
    item.CodeValue, item.CodingSchemeDesignator, item.CodeMeaning = code.value, code.scheme_designator, code.meaning
    return item


KNEE = knee()
SPECS = {
    "binary": SegSpec(),
    "binary implicit": SegSpec(syntax=IMPLICIT),
    "binary with empty frames": SegSpec(omit_empty=False),
    "label map": SegSpec("LABELMAP"),
    "label map RLE": SegSpec("LABELMAP", RLE),
}


def read_seg(data: bytes) -> LabelMap:
    return read_label_map(data, "labels.dcm")


@cache
def sample(spec: str = "binary") -> bytes:
    """The knee, written in one of the ways of SPECS."""
    return seg_bytes(KNEE, SPECS[spec])


def spoilt(spoil: Callable[[Dataset], object], spec: str = "binary") -> bytes:
    """The sample with something changed."""
    return edited_dataset(sample(spec), spoil)


def edited_dataset(data: bytes, spoil: Callable[[Dataset], object]) -> bytes:
    """A file with something changed in its data set."""
    dataset = dcmread(io.BytesIO(data))
    spoil(dataset)
    buffer = io.BytesIO()
    dataset.save_as(buffer)
    return buffer.getvalue()


def assert_same(found: LabelMap, expected: LabelVolume, *, atol: float = 1e-9) -> None:
    np.testing.assert_array_equal(found.volume.values, expected.values)
    np.testing.assert_allclose(found.volume.lps_from_index, expected.lps_from_index, rtol=0, atol=atol)
