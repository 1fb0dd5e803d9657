"""DICOM segmentations: the same volume as from every other format, each frame where its header says, or a refusal."""

from __future__ import annotations

import io
from dataclasses import replace

import highdicom
import numpy as np
import pytest
from pydicom import Dataset, dcmread
from pydicom.sr.coding import Code

from pipeline.files.dicom_headers import frame_hash
from pipeline.files.volumes import LabelMap, check_belongs, read_label_map
from pipeline.geometry.volume import LabelVolume, cropped
from tests.files.dicom_samples import refused
from tests.files.label_samples import nifti_bytes, nrrd_bytes, restored
from tests.files.seg_samples import (
    BONE,
    CARTILAGE,
    FEMUR,
    FIBULA,
    KNEE,
    KNEE_JOINT,
    LATERAL,
    LEFT,
    MEDIAL,
    MENISCUS,
    OTHER,
    PATELLA,
    RIGHT,
    SEGMENTS,
    SPECS,
    TIBIA,
    Described,
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
    with_gap,
)

#: Order of the index axes, which of them are reversed: axial, sagittal, coronal, and stored from the top downwards.
STORED = [
    ((0, 1, 2), (False, False, False)),
    ((1, 2, 0), (False, True, False)),
    ((0, 2, 1), (True, False, False)),
    ((1, 0, 2), (True, True, True)),
]
each_spec = pytest.mark.parametrize("spec", SPECS)


@pytest.mark.parametrize(("order", "flips"), STORED)
@each_spec
def test_the_same_volume_as_from_nrrd_and_nifti(
    spec: str, order: tuple[int, int, int], flips: tuple[bool, bool, bool]
) -> None:
    stored = restored(KNEE, order, flips)
    found = read_seg(seg_bytes(stored, replace(SPECS[spec], omit_empty=False)))
    assert_same(found, KNEE)
    assert_same(found, read_label_map(nrrd_bytes(stored), "labels.nrrd").volume)
    # NIfTI keeps its matrix in 32 bits: 6e-8 of 640 mm
    assert_same(found, read_label_map(nifti_bytes(stored), "labels.nii.gz").volume, atol=1e-4)
    assert found.segments == {"femur": 1, "tibia": 2, "femoral_cartilage": 3, "patella": 4}
    assert (found.findings, found.side) == ((), "")


@pytest.mark.parametrize(("order", "flips"), STORED)
@each_spec
def test_planes_that_were_left_out_are_filled_where_they_belong(
    spec: str, order: tuple[int, int, int], flips: tuple[bool, bool, bool]
) -> None:
    """Omitted planes at the ends leave a shorter volume that lies in the same place."""
    whole = with_gap(KNEE)
    found = read_seg(seg_bytes(restored(whole, order, flips), SPECS[spec]))
    expected = read_label_map(nrrd_bytes(whole), "labels.nrrd").volume
    ours, theirs = cropped(found.volume, 0), cropped(expected, 0)
    np.testing.assert_array_equal(ours.values, theirs.values)
    np.testing.assert_allclose(ours.lps_from_index, theirs.lps_from_index, rtol=0, atol=1e-9)
    left_out = SPECS[spec].omit_empty and order[2] == 2
    assert found.volume.values.shape[2] == (21 if left_out else 24)


@pytest.mark.parametrize("kind", ["BINARY", "LABELMAP"])
def test_every_voxel_lies_where_highdicom_has_it(kind: str) -> None:
    spec = SegSpec(kind)
    data = seg_bytes(with_gap(KNEE), spec)
    theirs = highdicom.seg.segread(io.BytesIO(data)).get_volume(combine_segments=True)
    ours = read_seg(data).volume
    index = np.argwhere(np.asarray(ours.values) > 0)
    places = index @ ours.lps_from_index[:3, :3].T + ours.lps_from_index[:3, 3]
    there = np.linalg.inv(theirs.affine)
    at = np.rint(places @ there[:3, :3].T + there[:3, 3]).astype(int)
    np.testing.assert_array_equal(theirs.array[tuple(at.T)], np.asarray(ours.values)[tuple(index.T)])
    assert np.count_nonzero(theirs.array) == len(index)


def test_the_order_of_the_frames_is_no_matter() -> None:
    count = len(frame_groups(dcmread(io.BytesIO(sample()))))
    order = np.random.default_rng(3).permutation(count).tolist()
    assert_same(read_seg(spoilt(lambda dataset: reordered(dataset, order))), KNEE)


def test_frames_that_do_not_end_on_a_byte() -> None:
    """13 x 11 voxels a frame: 143 bits, so that each frame begins inside a byte of another."""
    small = LabelVolume(np.asarray(KNEE.values)[::2, ::2], KNEE.lps_from_index @ np.diag([2.0, 2.0, 1.0, 1.0]))
    assert small.values.shape == (13, 11, 24)
    assert_same(read_seg(seg_bytes(small)), small)


def test_numbers_beyond_a_byte_and_segments_that_are_not_described() -> None:
    values = np.asarray(KNEE.values).astype(np.uint16)
    values[values == 2] = 300
    names = (*SEGMENTS[:1], *(Described(f"part {n}") for n in range(2, 300)), SEGMENTS[1])
    found = read_seg(seg_bytes(LabelVolume(values, KNEE.lps_from_index), SegSpec("LABELMAP", segments=names)))
    assert_same(found, LabelVolume(values, KNEE.lps_from_index))
    assert (found.segments["femur"], found.segments["tibia"]) == (1, 300)


def test_a_background_that_is_not_zero() -> None:
    def spoil(dataset: Dataset) -> None:
        dataset.PixelPaddingValue = 4

    values = np.array(KNEE.values)
    values[values == 4] = 0
    assert_same(read_seg(spoilt(spoil, "label map")), LabelVolume(values, KNEE.lps_from_index))


def test_a_geometry_that_is_a_little_off_lands_within_a_hundredth_of_a_millimetre() -> None:
    found = read_seg(
        spoilt(lambda dataset: moved(dataset, {n: (0.0, 0.0, 0.004 * (-1) ** n) for n in range(0, 26, 3)}))
    )
    assert_same(found, KNEE, atol=0.01)


# --- names, sides, frames of reference


def in_all(one: Described, label: str = "Bone 7") -> LabelMap:
    """The label map whose first segment is described so."""
    return read_seg(seg_bytes(KNEE, SegSpec(segments=(replace(one, label=one.label or label), *_UNNAMED))))


_UNNAMED = (Described("two"), Described("three"), Described("four"))


@pytest.mark.parametrize(
    ("one", "name"),
    [
        (Described("", FEMUR), "femur"),
        (Described("", Code("310652005", "SCT", "Distal Femur")), "femur"),
        (Described("", Code("T-12710", "SRT", "Femur")), "femur"),
        (Described("", TIBIA, KNEE_JOINT), "tibia"),
        (Described("", PATELLA, modifiers=(LEFT,)), "patella"),
        (Described("", BONE, FIBULA), "fibula"),
        (Described("", CARTILAGE, FEMUR), "femoral_cartilage"),
        (Described("", CARTILAGE, PATELLA), "patellar_cartilage"),
        (Described("", CARTILAGE, TIBIA, (MEDIAL,)), "medial_tibial_cartilage"),
        (Described("", CARTILAGE, TIBIA, (LATERAL, RIGHT)), "lateral_tibial_cartilage"),
        (Described("", MENISCUS, modifiers=(MEDIAL,)), "medial_meniscus"),
        (Described("", MENISCUS, KNEE_JOINT, (LATERAL,)), "lateral_meniscus"),
        (Described("Lateral  meniscus", OTHER), "lateral_meniscus"),
        (Described("", CARTILAGE, TIBIA), "Bone 7"),  # of which half?
        (Described("", CARTILAGE), "Bone 7"),
        (Described("", MENISCUS), "Bone 7"),
        (Described("", FEMUR, modifiers=(OTHER,)), "Bone 7"),
        (Described("", Code("71341001", "99LOCAL", "Liver")), "Bone 7"),
        (Described("Femoral component", OTHER), "Femoral component"),
    ],
)
def test_names_come_from_labels_then_codes(one: Described, name: str) -> None:
    found = in_all(one)
    assert found.segments == {name: 1, "two": 2, "three": 3, "four": 4}
    assert found.findings == ()


def test_a_label_that_contradicts_its_code_is_believed_and_told() -> None:
    found = in_all(Described("Tibia", FEMUR))
    assert found.segments["tibia"] == 1
    assert [finding.code for finding in found.findings] == ["W-LBL-04"]
    assert "tibia (coded as femur)" in found.findings[0].message


def test_a_part_that_is_coded_as_its_bone_keeps_its_own_name() -> None:
    segments = (Described("Femur", FEMUR), Described("Osteophyte", FEMUR), *SEGMENTS[2:])
    found = read_seg(seg_bytes(KNEE, SegSpec(segments=segments)))
    assert found.segments == {"femur": 1, "Osteophyte": 2, "femoral_cartilage": 3, "patella": 4}
    assert found.findings == ()


def test_two_legs_keep_the_names_they_have() -> None:
    segments = (
        Described("femur_right", FEMUR, modifiers=(RIGHT,)),
        Described("femur_left", FEMUR, modifiers=(LEFT,)),
        Described("Shin", TIBIA, modifiers=(RIGHT,)),
        Described("four"),
    )
    found = read_seg(seg_bytes(KNEE, SegSpec(segments=segments)))
    assert found.segments == {"femur_right": 1, "femur_left": 2, "tibia": 3, "four": 4}
    assert found.side == ""


@pytest.mark.parametrize("where", ["type", "place"])
@pytest.mark.parametrize(("code", "side"), [(RIGHT, "right"), (LEFT, "left")])
def test_the_side_that_the_codes_agree_on(code: Code, side: str, where: str) -> None:
    def spoil(dataset: Dataset) -> None:
        for segment in dataset.SegmentSequence:
            inner = segment.SegmentedPropertyTypeCodeSequence[0]
            if where == "place" and segment.get("AnatomicRegionSequence"):
                region = segment.AnatomicRegionSequence[0]
                region.AnatomicRegionModifierSequence = inner.SegmentedPropertyTypeModifierCodeSequence
                del inner.SegmentedPropertyTypeModifierCodeSequence

    segments = (
        Described("a", FEMUR, FEMUR, (code,)),
        Described("b", TIBIA, TIBIA, (code,)),
        Described("three"),
        Described("other", OTHER, modifiers=(LEFT,)),
    )
    found = read_seg(edited_dataset(seg_bytes(KNEE, SegSpec(segments=segments)), spoil))
    assert (found.side, found.segments["femur"], found.segments["tibia"]) == (side, 1, 2)
    check_belongs(found, "labels.dcm", side, "")
    opposite = {"right": "left", "left": "right"}[side]
    with refused("E-SIDE-04", f"declared {opposite}, .* coded as {side}"):
        check_belongs(found, "labels.dcm", opposite, "")


def test_the_frame_of_reference_of_another_scan() -> None:
    own = dcmread(io.BytesIO(sample())).FrameOfReferenceUID
    found = read_seg(sample())
    check_belongs(found, "labels.dcm", "right", frame_hash(own))
    check_belongs(found, "labels.dcm", "right", "")
    check_belongs(read_label_map(nrrd_bytes(KNEE), "labels.nrrd"), "labels.nrrd", "right", frame_hash(own))
    assert own not in repr((found.frame_of_reference, found.findings))
    with refused("E-GEO-08", r"labels\.dcm does not belong to the CT .* frame of reference"):
        check_belongs(found, "labels.dcm", "right", frame_hash("1.2.3.4"))
