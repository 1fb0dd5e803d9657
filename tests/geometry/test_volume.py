"""Voxels and their place in the patient."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.geometry.volume import (
    CtVolume,
    LabelVolume,
    averaged,
    axis_codes,
    border_areas_mm2,
    box_of,
    cavities,
    centroid_lps,
    corner_points,
    cropped,
    in_lps_order,
    label_counts,
    pieces,
    shared_area_mm2,
    shear,
)

SHAPE = (4, 5, 6)


def numbered(matrix: NDArray[np.float64]) -> LabelVolume:
    """Every voxel has its own value, so a value tells where its voxel went."""
    return LabelVolume(np.arange(1, 121, dtype=np.uint8).reshape(SHAPE), matrix)


def place_of_values(volume: LabelVolume) -> dict[int, NDArray[np.float64]]:
    values = np.asarray(volume.values)
    index = np.argwhere(values > 0)
    places = index @ volume.lps_from_index[:3, :3].T + volume.lps_from_index[:3, 3]
    return {int(values[tuple(i)]): place for i, place in zip(index, places, strict=True)}


def matrix_of(rotation: NDArray[np.float64], spacing: tuple[float, float, float]) -> NDArray[np.float64]:
    out = np.eye(4)
    out[:3, :3] = rotation * spacing
    out[:3, 3] = (10.0, -20.0, 30.0)
    return out


angles = st.floats(-180.0, 180.0)


@settings(deadline=None)
@given(angles, angles, angles, st.tuples(*[st.sampled_from((0.5, 1.0, 2.0))] * 3), st.booleans())
def test_lps_order_moves_no_voxel(
    a: float,
    b: float,
    c: float,
    spacing: tuple[float, float, float],
    mirrored: bool,  # noqa: FBT001
) -> None:
    """For every rotation and handedness: right-handed, each value stays where it was, twice is once."""
    rotation = Rotation.from_euler("zyx", (a, b, c), degrees=True).as_matrix()
    rotation[:, 1] *= -1.0 if mirrored else 1.0
    before = numbered(matrix_of(rotation, spacing))
    after = in_lps_order(before)
    assert np.linalg.det(after.lps_from_index[:3, :3]) > 0
    assert sorted(after.spacing_mm) == pytest.approx(sorted(spacing))
    old, new = place_of_values(before), place_of_values(after)
    assert old.keys() == new.keys()
    np.testing.assert_allclose([new[value] for value in old], list(old.values()), atol=1e-9)
    again = in_lps_order(after)
    np.testing.assert_array_equal(again.values, after.values)
    np.testing.assert_array_equal(again.lps_from_index, after.lps_from_index)


def test_lps_order_is_lps_for_scans_near_the_axes() -> None:
    tilt = Rotation.from_euler("xyz", (12.0, -20.0, 9.0), degrees=True).as_matrix()
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            stored = matrix_of((tilt * signs)[:, order], (1.0, 1.0, 1.0))
            assert axis_codes(in_lps_order(numbered(stored)).lps_from_index) == "LPS"


def test_axis_codes() -> None:
    assert axis_codes(np.eye(4)) == "LPS"
    assert axis_codes(np.diag([-1.0, -1.0, 1.0, 1.0])) == "RAS"
    assert axis_codes(np.diag([0.0, 1.0, -1.0, 1.0])) == "?PI"


def test_shear_is_the_cosine_between_axes() -> None:
    matrix = matrix_of(Rotation.from_euler("x", 33.0, degrees=True).as_matrix(), (0.5, 1.0, 2.0))
    assert shear(matrix) == pytest.approx(0.0, abs=1e-15)
    matrix[:3, 1] += np.tan(np.radians(10.0)) * matrix[:3, 0] / 0.5
    assert shear(matrix) == pytest.approx(np.sin(np.radians(10.0)))
    assert np.isnan(shear(np.diag([0.0, 1.0, 1.0, 1.0])))


def test_corner_points() -> None:
    corners = corner_points(matrix_of(np.eye(3), (0.5, 1.0, 2.0)), SHAPE)
    assert corners.shape == (8, 3)
    np.testing.assert_array_equal(corners.min(axis=0), (10.0, -20.0, 30.0))
    np.testing.assert_array_equal(corners.max(axis=0), (11.5, -16.0, 40.0))


@pytest.mark.parametrize("margin", [0, 1, 2, 99])
def test_cropping_keeps_labels_in_place(margin: int) -> None:
    values = np.zeros((9, 9, 9), dtype=np.uint8)
    values[3:5, 4, 0:2] = 7
    matrix = matrix_of(Rotation.from_euler("y", 20.0, degrees=True).as_matrix(), (0.5, 1.0, 2.0))
    found = cropped(LabelVolume(values, matrix), margin)
    expected = [min(3, margin) + 2 + min(4, margin), min(4, margin) + 1 + min(4, margin), 2 + min(7, margin)]
    assert list(found.values.shape) == expected
    assert label_counts(np.asarray(found.values).astype(np.uint16))[7] == 4
    np.testing.assert_allclose(
        centroid_lps(np.asarray(found.values) == 7, found.lps_from_index), centroid_lps(values == 7, matrix), atol=1e-12
    )


def test_nothing_cannot_be_cropped_or_centred() -> None:
    empty = np.zeros(SHAPE, dtype=np.uint8)
    with pytest.raises(ValueError, match="has no box"):
        cropped(LabelVolume(empty, np.eye(4)), 2)
    with pytest.raises(ValueError, match="no centroid"):
        centroid_lps(empty > 0, np.eye(4))


def test_box() -> None:
    mask = np.zeros(SHAPE, dtype=bool)
    mask[1, 2:4, 5] = True
    assert box_of(mask) == (slice(1, 2), slice(2, 4), slice(5, 6))


def test_label_counts_agree_with_unique() -> None:
    values = np.random.default_rng(3).integers(0, 900, (7, 8, 9)).astype(np.uint16)
    labels, counts = np.unique(values, return_counts=True)
    found = label_counts(values)
    np.testing.assert_array_equal(np.flatnonzero(found), labels)
    np.testing.assert_array_equal(found[labels], counts)


def test_pieces_touch_by_corners_and_are_sorted_by_size() -> None:
    mask = np.zeros((9, 9, 9), dtype=bool)
    mask[0, 0, 0] = True
    mask[3:5, 3:5, 3:5] = True
    mask[5, 5, 5] = True  # by a corner: the same piece
    found = pieces(mask)
    assert found.voxels == (9, 1)
    assert found.numbers[5, 5, 5] == found.numbers[3, 3, 3] == 1
    assert found.numbers[0, 0, 0] == 2
    assert found.numbers[8, 8, 8] == 0


def test_cavities_are_what_no_path_leads_out_of() -> None:
    mask = np.zeros((9, 9, 9), dtype=bool)
    mask[1:8, 1:8, 1:8] = True
    mask[3:5, 3:5, 3:5] = False
    assert np.count_nonzero(cavities(mask)) == 8
    mask[5, 5, 5] = False  # by a corner only: a cavity of its own
    assert np.count_nonzero(cavities(mask)) == 9
    mask[3, 3, 5:8] = False  # a channel
    assert np.count_nonzero(cavities(mask)) == 1
    full = np.ones((3, 3, 3), dtype=bool)
    full[1, 1, 0] = False  # open to the border of the array
    assert not cavities(full).any()
    assert not cavities(np.ones((3, 3, 3), dtype=bool)).any()


def test_areas_of_a_box() -> None:
    """Against the areas of a box worked out by hand: voxels 0.5 x 1 x 2 mm."""
    spacing = np.array([0.5, 1.0, 2.0])
    values = np.zeros((10, 10, 10), dtype=np.uint8)
    values[0:4, 2:5, 6:10] = 1
    values[4:6, 2:5, 6:8] = 2
    np.testing.assert_array_equal(border_areas_mm2(values == 1, spacing), [3 * 4 * 2.0, 0, 0, 0, 0, 4 * 3 * 0.5])
    assert shared_area_mm2(values, (1, 2), spacing) == 3 * 2 * 2.0
    assert shared_area_mm2(values, (2, 1), spacing) == 3 * 2 * 2.0
    assert shared_area_mm2(values, (1, 3), spacing) == 0.0


def test_averages_keep_the_mean_and_the_place() -> None:
    ramp = np.arange(40, dtype=np.int16)[:, None, None] * np.ones((40, 20, 12), np.int16)
    matrix = np.diag([0.6, 0.7, 1.5, 1.0])
    values, coarse, factors = averaged(CtVolume(ramp, matrix), 1.5)
    assert factors == (2, 2, 1)
    assert values.mean() == pytest.approx(ramp.mean())
    # the ramp is linear in space: the average at the new centre is the ramp there
    np.testing.assert_allclose(values[:, 0, 0], (coarse[0, 0] * np.arange(20) + coarse[0, 3]) / 0.6, rtol=1e-6)


def test_the_last_blocks_are_the_means_of_what_is_left() -> None:
    values = np.random.default_rng(3).integers(-1000, 3000, (7, 5, 9)).astype(np.int16)
    found, _, (i, j, k) = averaged(CtVolume(values, np.diag([0.6, 0.9, 0.5, 1.0])), 2.0)
    assert (i, j, k) == (3, 2, 4)
    assert found.shape == (3, 3, 3)
    for at in np.ndindex(3, 3, 3):
        block = values[tuple(slice(n * size, (n + 1) * size) for n, size in zip(at, (i, j, k), strict=True))]
        assert found[at] == pytest.approx(block.mean(), rel=1e-6)
