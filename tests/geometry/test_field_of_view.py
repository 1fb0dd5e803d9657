"""What a scan shows of a knee, counted in voxels: against blocks of known size, other code and the phantom's meshes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pipeline.geometry.field_of_view import (
    LEAST_BEYOND_MM,
    coarse_copy,
    knee_extent,
    metal_mm3,
    shaft_needed_mm,
    side_signs,
)
from pipeline.geometry.long_axis import LEAST_SECTIONS, LongAxis, long_axis
from pipeline.geometry.phantom import PHANTOM_LABELS, phantom_labels
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.geometry.volume import CtVolume, LabelVolume, in_lps_order
from pipeline.records import Side
from tests.geometry.knees import SPEC, phantom_knee

SPACING_MM = (1.0, 1.5, 2.0)


def blocks(gap_layers: int) -> LabelVolume:
    """Tibia 2: 9 layers of shaft below 5 of plateau; femur 1: 4 layers of condyles below 12 of shaft."""
    values = np.zeros((50, 40, 30 + gap_layers), dtype=np.uint8)
    values[20:28, 15:23, 0:9] = 2
    values[5:45, 5:35, 9:14] = 2
    values[5:45, 5:35, 14 + gap_layers : 18 + gap_layers] = 1
    values[20:28, 15:23, 18 + gap_layers : 30 + gap_layers] = 1
    return LabelVolume(values, np.diag([*SPACING_MM, 1.0]))


@pytest.mark.parametrize("gap", [0, 1, 3])
def test_blocks_are_measured_to_the_layer(gap: int) -> None:
    found = knee_extent(blocks(gap), 1, 2)
    assert found.layer_mm == 2.0
    assert found.space_mm == 2.0 * gap
    # the joint line lies in the middle of the gap
    assert (found.femur.reach_mm, found.tibia.reach_mm) == (2.0 * 16 + gap, 2.0 * 14 + gap)
    assert (found.femur.shaft_mm, found.tibia.shaft_mm) == (24.0, 18.0)
    # the widest layer is the first of equals: three more of the condyles, four more of the plateau
    assert (found.femur.beyond_mm, found.tibia.beyond_mm) == (24.0 + 6.0, 18.0 + 8.0)


def test_a_layer_that_the_border_cuts_is_no_shaft() -> None:
    volume = blocks(1)
    np.asarray(volume.values)[22:28, :, 0] = 0  # a quarter of the section is left
    assert knee_extent(volume, 1, 2).tibia.shaft_mm == 16.0


def test_bones_beside_each_other_have_no_joint_space() -> None:
    volume = blocks(1)
    values = np.array(volume.values)
    moved = np.zeros((100, *values.shape[1:]), dtype=np.uint8)
    moved[:50][values == 1] = 1
    moved[50:][values == 2] = 2
    assert math.isnan(knee_extent(LabelVolume(moved, volume.lps_from_index), 1, 2).space_mm)


def test_a_bone_without_voxels_is_refused() -> None:
    with pytest.raises(ValueError, match="a bone without voxels has no extent"):
        knee_extent(blocks(1), 1, 7)


def test_the_shaft_is_that_of_the_long_axis() -> None:
    meshes, _ = phantom_knee()
    volume = in_lps_order(phantom_labels(SPEC))
    found = knee_extent(volume, PHANTOM_LABELS["femur"], PHANTOM_LABELS["tibia"])
    for name, extent, away in (("femur", found.femur, 1.0), ("tibia", found.tibia, -1.0)):
        axis = long_axis(meshes[name], np.array([0.0, 0.0, away]))
        assert extent.shaft_mm == pytest.approx(axis.length_mm, abs=6.0), name


@pytest.mark.parametrize("limit_deg", [2.0, 10.0, 20.0])
def test_with_the_shaft_that_is_needed_the_axis_is_at_its_limit(limit_deg: float) -> None:
    meshes, _ = phantom_knee()
    axis: LongAxis = long_axis(meshes["tibia"], np.array([0.0, 0.0, -1.0]))
    needed = shaft_needed_mm(limit_deg)
    # the tangent of what is beyond the least uncertainty falls with the length
    scaled = math.tan(math.radians(axis.uncertainty_deg - 0.5)) * axis.length_mm / needed
    assert 0.5 + math.degrees(math.atan(scaled)) == pytest.approx(limit_deg)


def test_no_shaft_is_long_enough_for_a_limit_below_the_least() -> None:
    assert shaft_needed_mm(0.4) == math.inf
    assert LEAST_BEYOND_MM == 2.0 * LEAST_SECTIONS


def scan() -> CtVolume:
    values = np.random.default_rng(3).integers(-1000, 3000, (23, 16, 31)).astype(np.int16)
    matrix = np.diag([0.6, 0.9, 0.5, 1.0])
    matrix[:3, 3] = (-7.0, 4.0, 11.0)
    return CtVolume(values, matrix)


def test_a_coarse_copy_is_the_mean_of_whole_blocks() -> None:
    ct = scan()
    found = coarse_copy(ct, 2.0)
    means = ct.values[:21, :16, :28].reshape(7, 3, 8, 2, 7, 4).mean(axis=(1, 3, 5))
    np.testing.assert_allclose(found.values, means, atol=0.501)
    np.testing.assert_allclose(np.diag(found.lps_from_index), (1.8, 1.8, 2.0, 1.0))
    np.testing.assert_allclose(found.lps_from_index[:3, 3], (-7.0 + 0.6, 4.0 + 0.45, 11.0 + 0.75))


def test_a_coarse_ct_is_its_own_copy() -> None:
    ct = scan()
    found = coarse_copy(ct, 0.4)
    np.testing.assert_array_equal(found.values, ct.values)
    np.testing.assert_allclose(found.lps_from_index, ct.lps_from_index)


def test_metal_counts_inside_the_box_only() -> None:
    ct = CtVolume(np.zeros((20, 20, 20), dtype=np.int16), np.diag([1.0, 1.0, 0.5, 1.0]))
    ct.values[4:6, 4, 4] = 3000
    ct.values[15, 15, 15] = 3000
    coarse = np.diag([2.0, 2.0, 2.0, 1.0])
    coarse[:3, 3] = (0.5, 0.5, 0.75)  # centres of blocks of 2 x 2 x 4 voxels
    assert metal_mm3(ct, LabelVolume(np.zeros((5, 5, 3), np.uint8), coarse), 2200.0) == 2 * 0.5
    assert metal_mm3(ct, LabelVolume(np.zeros((2, 5, 3), np.uint8), coarse), 2200.0) == 0.0
    assert metal_mm3(ct, LabelVolume(np.zeros((40, 40, 40), np.uint8), coarse), 2200.0) == 3 * 0.5


@pytest.mark.parametrize(("declared", "agrees"), [("right", True), ("left", False)])
def test_the_fibula_tells_the_side(declared: Side, agrees: bool) -> None:  # noqa: FBT001
    labels = in_lps_order(phantom_labels(PhantomSpec(shaft_length_mm=20.0, spacing_mm=(1.5, 1.5, 1.5))))
    bones = {name: PHANTOM_LABELS[name] for name in ("femur", "tibia", "fibula")}
    (sign,) = side_signs(labels, bones, declared)
    assert sign.agrees is agrees
    assert sign.sentence.endswith(f"mm to the {'outer' if agrees else 'inner'} side of the tibia")
    assert len(side_signs(labels, PHANTOM_LABELS, declared)) == 3
    assert all(each.agrees is agrees for each in side_signs(labels, PHANTOM_LABELS, declared))
    assert side_signs(labels, {"femur": PHANTOM_LABELS["femur"]}, declared) == ()
