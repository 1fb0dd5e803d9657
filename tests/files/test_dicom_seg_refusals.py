"""DICOM segmentations that are refused, each with its code and in words that name nobody."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from pydicom import Dataset

from pipeline.errors import CaseRejected
from pipeline.geometry.volume import LabelVolume
from tests.files.dicom_samples import deflated, edited, other_object, refused, series
from tests.files.label_samples import nrrd_bytes
from tests.files.seg_samples import (
    EXPLICIT,
    KNEE,
    RLE,
    SegSpec,
    assert_same,
    edited_dataset,
    frame_groups,
    moved,
    read_seg,
    reordered,
    sample,
    seg_bytes,
    spoilt,
)


def of_frame(sequence: str, keyword: str, value: object, frame: int = 5) -> Callable[[Dataset], None]:
    """One tag of one frame, which gets a functional group of its own where it was shared; None takes the tag away."""

    def spoil(dataset: Dataset) -> None:
        group = frame_groups(dataset)[frame]
        if sequence not in group:
            shared = dataset.SharedFunctionalGroupsSequence[0]
            setattr(group, sequence, [Dataset()])
            getattr(group, sequence)[0].update(getattr(shared, sequence)[0])
        set_or_delete(getattr(group, sequence)[0], keyword, value)

    return spoil


def of_all(sequence: str, keyword: str, value: object) -> Callable[[Dataset], None]:
    return lambda dataset: set_or_delete(
        getattr(dataset.SharedFunctionalGroupsSequence[0], sequence)[0], keyword, value
    )


def top(**tags: object) -> Callable[[Dataset], None]:
    def spoil(dataset: Dataset) -> None:
        for keyword, value in tags.items():
            set_or_delete(dataset, keyword, value)

    return spoil


def set_or_delete(dataset: Dataset, keyword: str, value: object) -> None:
    if value is None:
        delattr(dataset, keyword)
    else:
        setattr(dataset, keyword, value)


def third_segment(**tags: object) -> Callable[[Dataset], None]:
    return lambda dataset: top(**tags)(dataset.SegmentSequence[2])


def same_names(dataset: Dataset) -> None:
    for number in (0, 2):
        dataset.SegmentSequence[number].SegmentLabel = "Femur"


def one_plane(dataset: Dataset) -> None:
    place = frame_groups(dataset)[0].PlanePositionSequence
    for group in frame_groups(dataset):
        group.PlanePositionSequence = place


def doubled_frame(dataset: Dataset) -> None:
    """The first frame comes again, as of another point in time."""
    count = int(dataset.NumberOfFrames)
    reordered(dataset, [*range(count), 0])
    dataset.NumberOfFrames = count + 1


def finer(dataset: Dataset) -> None:
    """A frame out of place by a fifth of a step, and nothing that tells the step."""
    moved(dataset, {5: (0.0, 0.0, 0.4)})
    del dataset.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0].SpacingBetweenSlices


def one_frame_less(dataset: Dataset) -> None:
    """The pixels of 22 frames, and the header of 21."""
    frame_groups(dataset).pop()
    dataset.NumberOfFrames = len(frame_groups(dataset))


def one_frame_more(dataset: Dataset) -> None:
    """The pixels of 22 frames, and the header of 23."""
    group = Dataset()
    group.update(frame_groups(dataset)[0])
    frame_groups(dataset).append(group)
    at = np.asarray(dataset.PerFrameFunctionalGroupsSequence[21].PlanePositionSequence[0].ImagePositionPatient)
    before = np.asarray(dataset.PerFrameFunctionalGroupsSequence[20].PlanePositionSequence[0].ImagePositionPatient)
    place = Dataset()
    place.ImagePositionPatient = [f"{x:.10g}" for x in 2.0 * at.astype(float) - before.astype(float)]
    group.PlanePositionSequence = [place]
    dataset.NumberOfFrames = len(frame_groups(dataset))


def overlapping(dataset: Dataset) -> None:
    """Every frame is full."""
    dataset.PixelData = b"\xff" * len(dataset.PixelData)


def tilted(dataset: Dataset) -> None:
    bottom = min(float(g.PlanePositionSequence[0].ImagePositionPatient[2]) for g in frame_groups(dataset))
    shifts = {
        n: (0.02 * (float(g.PlanePositionSequence[0].ImagePositionPatient[2]) - bottom), 0.0, 0.0)
        for n, g in enumerate(frame_groups(dataset))
    }
    moved(dataset, shifts)


REFUSALS: list[tuple[str, Callable[[Dataset], object], str, str]] = [
    # geometry
    ("binary", lambda d: moved(d, {5: (0.0, 0.0, 0.4)}), "E-DCM-11", "not evenly spaced: gaps from"),
    ("label map", lambda d: moved(d, {5: (0.0, 0.0, 0.4)}), "E-DCM-11", r"planes of labels\.dcm are not evenly"),
    ("binary", finer, "E-DCM-11", r"gaps from 0\.\d+ to"),
    ("binary", lambda d: moved(d, dict.fromkeys(range(10), (0.0, 0.0, 0.7))), "E-DCM-11", "gaps from"),
    ("binary", lambda d: moved(d, {5: (0.05, 0.0, 0.0)}), "E-DCM-16", r"Frame 6 of labels\.dcm would lie 0\.0"),
    ("binary", tilted, "E-GEO-04", "not at right angles: 1"),
    ("binary", one_plane, "E-LBL-04", "lie in one plane"),
    ("binary", of_all("PixelMeasuresSequence", "SpacingBetweenSlices", 1.0), "E-GEO-02", "1 and 2 mm"),
    ("binary", of_all("PixelMeasuresSequence", "SpacingBetweenSlices", 4.0), "E-GEO-02", "4 and 2 mm"),
    ("binary", of_frame("PixelMeasuresSequence", "SpacingBetweenSlices", 1.5), "E-GEO-02", r"1\.5 and 2 mm"),
    ("binary", of_frame("PixelMeasuresSequence", "PixelSpacing", [1.5, 1.25]), "E-DCM-13", "PixelSpacing of frame 6"),
    ("binary", of_all("PixelMeasuresSequence", "PixelSpacing", [1.5, 0.0]), "E-IO-13", "PixelSpacing is not a length"),
    ("binary", of_all("PixelMeasuresSequence", "PixelSpacing", [1.5, 1.0, 2.0]), "E-IO-13", "is not 2 numbers"),
    ("binary", of_all("PixelMeasuresSequence", "PixelSpacing", None), "E-GEO-01", "frame 1 has no PixelSpacing"),
    (
        "binary",
        of_frame("PlaneOrientationSequence", "ImageOrientationPatient", [0, 1, 0, 0, 0, -1]),
        "E-DCM-13",
        "ImageOrientationPatient of frame 6",
    ),
    (
        "binary",
        of_all("PlaneOrientationSequence", "ImageOrientationPatient", [1, 0, 0, 0.1, 1, 0]),
        "E-DCM-08",
        r"labels\.dcm is not two directions at right angles",
    ),
    (
        "binary",
        of_all("PlaneOrientationSequence", "ImageOrientationPatient", None),
        "E-GEO-01",
        "frame 1 has no ImageOrientationPatient",
    ),
    (
        "label map",
        of_frame("PlanePositionSequence", "ImagePositionPatient", None),
        "E-GEO-01",
        "frame 6 has no ImagePositionPatient",
    ),
    (
        "label map",
        of_frame("PlanePositionSequence", "ImagePositionPatient", [0, 0, 2e5]),
        "E-IO-13",
        "beyond 100 m",
    ),
    ("label map", lambda d: delattr(d, "SharedFunctionalGroupsSequence"), "E-GEO-01", "ImageOrientationPatient"),
    # frames and segments
    ("binary", doubled_frame, "E-LBL-04", "several frames of one segment in the same plane"),
    ("binary", overlapping, "E-LBL-04", r"to segment 1 \(femur\) and segment 4 \(patella\) \(572 of them"),
    ("binary", lambda d: frame_groups(d).pop(), "E-IO-13", r"it declares \d+ frames and describes \d+"),
    ("binary", third_segment(SegmentNumber=2), "E-IO-13", "segment 2 is described more than once"),
    ("binary", third_segment(SegmentNumber=7), "E-IO-13", "a frame is of segment 3, which is not described"),
    ("binary", third_segment(SegmentNumber=None), "E-IO-13", "a segment has no number"),
    (
        "binary",
        same_names,
        "E-IO-13",
        "segments 1 and 3 have the same name",
    ),
    ("binary", top(SegmentSequence=[]), "E-IO-13", "describes no segment"),
    (
        "binary",
        of_frame("SegmentIdentificationSequence", "ReferencedSegmentNumber", None),
        "E-IO-13",
        "does not say which segment",
    ),
    # kinds
    ("binary", top(SegmentationType="FRACTIONAL"), "E-LBL-02", "probabilities, not labels"),
    ("binary", top(SegmentationType="LABELMAP"), "E-IO-13", "not that of its SOP class"),
    ("label map", top(SegmentationType="BINARY"), "E-IO-13", "not that of its SOP class"),
    ("binary", top(SegmentationType=None), "E-IO-13", "SegmentationType is missing"),
    ("binary", top(BitsAllocated=8), "E-IO-13", "bits_allocated 8, expected 1"),
    ("label map", top(BitsAllocated=32), "E-IO-13", "bits_allocated 32, expected 8 or 16"),
    ("label map", top(SamplesPerPixel=3), "E-IO-13", "samples 3, expected 1"),
    ("label map", top(PixelRepresentation=1), "E-IO-13", "signed True, expected False"),
    # sizes
    ("binary", top(Rows=0), "E-IO-13", "26 x 0 x"),
    ("binary", top(Rows=23), "E-IO-11", r"expected \d+ bytes of voxels, got"),
    ("label map", top(Columns=60000, Rows=60000), "E-IO-14", "declares 60000 x 60000 x 22 voxels"),
    ("label map", top(NumberOfFrames=2_000_000_000), "E-IO-14", "2000000000 voxels"),
    ("label map", top(NumberOfFrames=1_000_000), "E-IO-14", "1000000 frames, expected at most 50000"),
    ("label map", top(NumberOfFrames=0), "E-IO-13", "26 x 22 x 0"),
    ("label map RLE", top(Rows=23), "E-IO-11", "cannot be decoded to 26 x 23"),
    ("label map RLE", one_frame_less, "E-IO-11", "expected 21 frames, got more"),
    ("label map RLE", one_frame_more, "E-IO-11", "expected 23 frames, got 22"),
]


@pytest.mark.parametrize(("spec", "spoil", "code", "problem"), REFUSALS)
def test_what_cannot_be_trusted_is_refused(
    spec: str, spoil: Callable[[Dataset], object], code: str, problem: str
) -> None:
    with refused(code, problem):
        read_seg(spoilt(spoil, spec))


def test_probabilities_as_highdicom_writes_them() -> None:
    with refused("E-LBL-02", "holds probabilities, not labels"):
        read_seg(seg_bytes(KNEE, SegSpec("FRACTIONAL")))


SERIES = series()


@pytest.mark.parametrize(
    ("data", "code", "problem"),
    [
        (SERIES["IM0001.dcm"], "E-IO-12", "it is a CT image, not a segmentation"),
        (other_object(SERIES, "RTSTRUCT", "1.2.840.10008.5.1.4.1.1.481.3"), "E-IO-12", "RT structure set"),
        (other_object(SERIES, "SEG", "1.2.840.10008.5.1.4.1.1.66.5"), "E-IO-12", "surface segmentation"),
        (other_object(SERIES, "SR", "1.2.840.10008.5.1.4.1.1.88.33"), "E-IO-12", "another kind of DICOM object"),
        (b"", "E-IO-11", "has only 0 bytes"),
        (bytes(5000), "E-IO-11", "does not begin as a DICOM file does"),
        (nrrd_bytes(KNEE), "E-IO-11", "does not begin as a DICOM file does"),
    ],
)
def test_other_things_under_this_name(data: bytes, code: str, problem: str) -> None:
    with refused(code, problem):
        read_seg(data)


@pytest.mark.parametrize(
    ("spec", "syntax", "problem"),
    [
        ("binary", "1.2.840.10008.1.2.4.90", r"encoded in a way that is not read \(1\.2\.840\.10008\.1\.2\.4\.90\)"),
        ("label map", "1.2.840.10008.1.2.4.80", "encoded in a way that is not read"),
        ("binary", RLE, "encoded in a way that is not read"),
        ("binary", "1.2.840.10008.1.2.8.1", "compressed in a way that is not read"),
    ],
)
def test_compressions_that_are_not_read(spec: str, syntax: str, problem: str) -> None:
    data = sample(spec)
    old, new = EXPLICIT.encode() + b"\0", syntax.encode()
    at = data.index(b"UI\x14\0" + old)
    padded = new + b"\0" * (len(new) % 2)
    length = int.from_bytes(data[140:144], "little") + len(padded) - len(old)
    changed = b"UI" + len(padded).to_bytes(2, "little") + padded
    swapped = data[:140] + length.to_bytes(4, "little") + data[144:at] + changed + data[at + 4 + len(old) :]
    with refused("E-IO-12", problem):
        read_seg(swapped)


def test_a_bomb_is_not_inflated() -> None:
    bomb = deflated(sample(), surplus=300_000_000)
    assert len(bomb) < 1_000_000
    tracemalloc.start()
    with refused("E-IO-12", "deflated as a whole"):
        read_seg(bomb)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 5_000_000


@pytest.mark.parametrize("keyword", ["SharedFunctionalGroupsSequence", "SegmentSequence"])
def test_a_sequence_that_is_none(keyword: str) -> None:
    with refused("E-IO-11", "its header cannot be read to its end"):
        read_seg(edited(sample(), {keyword: b"\xfe\xff\x00\xe0"}))


@pytest.mark.parametrize("count", [b"1700000", b"2000000000"])
def test_a_declared_size_is_refused_before_anything_is_allocated(count: bytes) -> None:
    data = edited(sample("label map"), {"NumberOfFrames": count})
    tracemalloc.start()
    with refused("E-IO-14", "voxels|frames"):
        read_seg(data)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 5_000_000


def test_frames_far_apart_are_refused_before_the_planes_between_are_allocated(monkeypatch: pytest.MonkeyPatch) -> None:
    upright = LabelVolume(KNEE.values, np.diag([1.0, 1.5, 2.0, 1.0]))
    data = seg_bytes(upright, SegSpec("LABELMAP"))
    far = edited_dataset(data, lambda dataset: moved(dataset, {0: (0.0, 0.0, -90_000.0)}))
    monkeypatch.setattr("pipeline.files.foreign_image.MAX_VOXELS", 20_000_000)
    with refused("E-IO-14", "declares 26 x 22 x 45"):
        read_seg(far)


@pytest.mark.parametrize("spec", ["binary", "label map", "label map RLE"])
def test_truncated_anywhere(spec: str) -> None:
    data = sample(spec)
    for part in range(33):
        with refused("E-IO-11", r"labels\.dcm is damaged or incomplete"):
            read_seg(data[: min(len(data) * part // 32, len(data) - 1)])


@pytest.mark.parametrize("spec", ["binary", "binary implicit", "label map RLE"])
def test_mutated_headers_end_in_a_refusal_or_in_the_same_volume(spec: str) -> None:
    """Bytes that carry nothing may change; what can be told from the rest of the file is refused."""
    data = sample(spec)
    end = data.rindex(b"\xe0\x7f\x10\x00")
    random = np.random.default_rng(20240502)
    refusals = 0
    for _ in range(100):
        try:
            found = read_seg(mutated(data, end, random))
        except CaseRejected:
            refusals += 1
            continue
        assert_same(found, KNEE, atol=1e-5)
    assert 25 < refusals < 90


def mutated(data: bytes, end: int, random: np.random.Generator) -> bytes:
    """A few bits flipped, bytes changed, deleted or inserted before ``end``."""
    out = bytearray(data)
    place = int(random.integers(0, end))
    kind = int(random.integers(0, 5))
    if kind < 2:
        for at in random.integers(0, end, 1 + kind):
            out[at] ^= 1 << int(random.integers(0, 8))
    elif kind == 2:
        out[place] = int(random.integers(0, 256))
    elif kind == 3:
        del out[place : place + int(random.integers(1, 9))]
    else:
        out[place:place] = random.integers(0, 256, random.integers(1, 5)).astype(np.uint8).tobytes()
    return bytes(out)


def test_mutated_run_lengths_end_in_a_refusal_or_a_volume() -> None:
    data = sample("label map RLE")
    begin = data.rindex(b"\xe0\x7f\x10\x00")
    random = np.random.default_rng(5)
    refusals = 0
    for _ in range(60):
        out = bytearray(data)
        out[int(random.integers(begin, len(out)))] ^= 1 << int(random.integers(0, 8))
        try:
            assert read_seg(bytes(out)).volume.values.shape == KNEE.values.shape
        except CaseRejected:
            refusals += 1
    assert 5 < refusals < 60


# --- nobody is named


CANARY = {
    "PatientName": b"Canary^Token",
    "PatientID": b"CANARY-ID",
    "StudyDescription": b"canary study",
    "SeriesDescription": b"canary series",
    "ContentLabel": b"CANARY",
    "ContentDescription": b"canary content",
    "ContentCreatorName": b"Canary^Creator",
    "InstitutionName": b"canary hospital",
    "FrameOfReferenceUID": b"1.2.3.4.777777",
}


def named(spec: str) -> bytes:
    """A file whose every free text names somebody, the labels of its segments among them."""

    def spoil(dataset: Dataset) -> None:
        for segment in dataset.SegmentSequence:
            segment.SegmentLabel = f"Canary {segment.SegmentNumber}"

    return edited(spoilt(spoil, spec), dict(CANARY))


@pytest.mark.parametrize("spec", ["binary", "label map"])
def test_no_name_in_findings_or_facts(spec: str) -> None:
    found = read_seg(named(spec))
    said = repr((found.findings, found.side, found.frame_of_reference)).lower()
    assert "canary" not in said
    assert "777777" not in said


@pytest.mark.parametrize(("spec", "spoil", "code", "problem"), REFUSALS)
def test_no_name_in_refusals(spec: str, spoil: Callable[[Dataset], object], code: str, problem: str) -> None:
    data = named(spec)
    with pytest.raises(CaseRejected, match=r"^E-\w+-\d\d ") as caught:
        read_seg(edited_dataset(data, spoil))
    chain = f"{caught.value} {caught.value.__cause__}".lower()
    assert "canary" not in chain
    assert "777777" not in chain
