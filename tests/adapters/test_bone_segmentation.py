"""Bones found in a synthetic CT against the label map it was made from; a real CT of feet is refused."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.adapters.bone_segmentation import BoneSegmentation, SegmentationSettings, segment_bones
from pipeline.files.volumes import read_label_map
from pipeline.geometry.phantom import PHANTOM_LABELS, phantom_labels
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.geometry.synthetic_ct import SyntheticCtSpec, synthetic_ct, truth_on
from pipeline.geometry.volume import CtVolume, LabelVolume, in_lps_order

Mask = NDArray[np.bool_]
Spacing = tuple[float, float, float]

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
BONES = {name: PHANTOM_LABELS[name] for name in ("femur", "tibia", "patella", "fibula")}
SHORT = PhantomSpec(shaft_length_mm=20.0, spacing_mm=(1.0, 1.0, 1.0))
COARSE = SyntheticCtSpec(spacing_mm=(1.0, 1.0, 1.0))
BLURRED = replace(COARSE, blur_mm=0.9)


@cache
def knee(spec: PhantomSpec = SHORT) -> LabelVolume:
    return phantom_labels(spec)


def found_in(labels: LabelVolume, spec: SyntheticCtSpec) -> BoneSegmentation:
    return segment_bones(synthetic_ct(labels, BONES, spec), "right")


@cache
def blurred() -> BoneSegmentation:
    return found_in(knee(), BLURRED)


def truth_of(labels: LabelVolume, found: BoneSegmentation) -> NDArray[np.generic]:
    """The labels on the grid of what was found."""
    return truth_on(labels, CtVolume(np.zeros(found.labels.values.shape, np.int16), found.labels.lps_from_index)).values


def rms_voxels(labels: LabelVolume, found: BoneSegmentation, name: str) -> float:
    """Distance between the two surfaces, both ways, in voxels of the geometric mean size."""
    spacing = found.labels.spacing_mm
    truth = _faces(truth_of(labels, found) == BONES[name], spacing)
    mine = _faces(found.labels.values == found.structures[name], spacing)
    away = np.concatenate([cKDTree(truth).query(mine)[0], cKDTree(mine).query(truth)[0]])
    return float(np.sqrt(np.mean(away**2)) / np.cbrt(np.prod(spacing)))


def _faces(mask: Mask, spacing: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) centres of the voxel faces between inside and outside, mm."""
    out = []
    for axis in range(3):
        index = np.argwhere(np.diff(mask.astype(np.int8), axis=axis) != 0).astype(np.float64)
        index[:, axis] += 0.5
        out.append(index * spacing)
    return np.vstack(out)


@pytest.mark.parametrize(("spacing", "noise"), [((0.7, 0.7, 0.7), 15.0), ((0.6, 0.6, 1.5), 40.0)])
def test_the_bones_of_the_phantom_within_half_a_voxel(spacing: Spacing, noise: float) -> None:
    labels = knee(replace(SHORT, spacing_mm=(0.7, 0.7, 0.7)))
    found = found_in(labels, SyntheticCtSpec(spacing_mm=spacing, noise_hu=noise))
    assert found.facts.missing == ()
    for name in BONES:
        assert rms_voxels(labels, found, name) <= 0.5, name
        assert found.confidence[name] > 0.9, name


def test_no_bone_owns_voxels_of_another() -> None:
    found = blurred()
    truth = truth_of(knee(), found)
    for name, value in found.structures.items():
        others = [label for other, label in BONES.items() if other != name]
        assert not np.isin(truth[found.labels.values == value], others).any(), name


def test_cut_shafts_stay_cut_and_full() -> None:
    found = blurred()
    truth = truth_of(knee(), found)
    for name, end in (("femur", -1), ("tibia", 0)):
        mine = found.labels.values[:, :, end] == found.structures[name]
        assert np.count_nonzero(mine) == pytest.approx(np.count_nonzero(truth[:, :, end] == BONES[name]), rel=0.1)
        assert found.bones[name].cut_mm2 > 200.0
    assert found.bones["patella"].cut_mm2 == 0.0


@pytest.mark.fault("V19", "V20")
def test_the_declared_leg_of_two_on_a_table_with_metal_noted() -> None:
    x, y, z = (float(number) for number in _middle(knee(), "femur"))
    spec = replace(COARSE, other_leg="left", table_mm=10.0, metal_mm=(x, y, z))
    ct = synthetic_ct(knee(), BONES, spec)
    right, left = (segment_bones(ct, "right"), segment_bones(ct, "left"))
    assert right.facts.knees == 2
    assert right.facts.metal_mm3 == pytest.approx(4 / 3 * np.pi * 4**3, rel=0.2)
    for name in BONES:
        assert rms_voxels(knee(), right, name) <= 0.6, name
        volumes = right.bones[name].volume_mm3, left.bones[name].volume_mm3
        assert volumes[0] == pytest.approx(volumes[1], rel=0.03), name
    assert _middle(left.labels, "femur", left.structures)[0] > _middle(right.labels, "femur", right.structures)[0] + 60


def _middle(labels: LabelVolume, name: str, values: Any = None) -> NDArray[np.float64]:
    index = np.argwhere(labels.values == (values or BONES)[name]).mean(axis=0)
    return np.asarray(labels.lps_from_index[:3, :3] @ index + labels.lps_from_index[:3, 3])


def test_the_order_of_the_axes_does_not_matter() -> None:
    ct = synthetic_ct(knee(), BONES, BLURRED)
    swap = np.array([[0, 0, -1.0, ct.values.shape[0] - 1], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    turned = CtVolume(np.ascontiguousarray(ct.values.transpose(2, 1, 0)[:, :, ::-1]), ct.lps_from_index @ swap)
    first, second = blurred(), segment_bones(turned, "right")
    np.testing.assert_array_equal(first.labels.values, second.labels.values)
    np.testing.assert_allclose(first.labels.lps_from_index, second.labels.lps_from_index, atol=1e-9)


@pytest.mark.fault("V18")
def test_a_leg_of_the_other_side_is_refused() -> None:
    with pytest.raises(ValueError, match="declared as the left one, but its fibula lies"):
        segment_bones(synthetic_ct(knee(), BONES, COARSE), "left")


def test_a_femur_alone_is_no_knee() -> None:
    femur = LabelVolume(np.where(knee().values == BONES["femur"], knee().values, 0), knee().lps_from_index)
    with pytest.raises(ValueError, match="there is no knee in this CT: among its bones there are no two"):
        segment_bones(synthetic_ct(femur, BONES, COARSE), "right")


def test_a_setting_out_of_range_is_refused() -> None:
    with pytest.raises(ValueError, match="reach_mm: expected 40 to 600"):
        SegmentationSettings(reach_mm=5.0)


@pytest.mark.skipif(not (DATA / "knee_mr_a").is_dir(), reason="shared/data/knee_mr_a is not there")
def test_a_synthetic_ct_of_a_real_knee() -> None:
    labels = read_label_map((DATA / "knee_mr_a" / "labels.nrrd").read_bytes(), "labels.nrrd").volume
    found = found_in(labels, SyntheticCtSpec(spacing_mm=(0.7, 0.7, 0.7)))
    assert found.facts.missing == ()
    for name in BONES:
        assert rms_voxels(labels, found, name) <= 0.5, name


@pytest.mark.skipif(not (DATA / "foot_ct").is_dir(), reason="shared/data/foot_ct is not there")
def test_a_real_ct_of_feet_is_refused() -> None:
    image: Any = nibabel.load(DATA / "foot_ct" / "foot_ct_crop.nii.gz")
    lps_from_index = np.diag([-1.0, -1.0, 1.0, 1.0]) @ image.affine
    ct = in_lps_order(CtVolume(np.asarray(image.dataobj).astype(np.int16), lps_from_index))
    with pytest.raises(ValueError, match="there is no knee in this CT"):
        segment_bones(ct, "right")
