"""A synthetic CT shows the label map it was made from, and what was asked for beside it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.geometry.synthetic_ct import SyntheticCtSpec, synthetic_ct, truth_on
from pipeline.geometry.volume import CtVolume, LabelVolume

BONES = {"femur": 5, "tibia": 6}
STILL = SyntheticCtSpec(spacing_mm=(1.0, 1.0, 1.0), noise_hu=0.0, texture_hu=0.0, muscle_mm=8.0, fat_mm=5.0, air_mm=5.0)


def leg() -> LabelVolume:
    """Two blocks of bone with a layer of cartilage between them, oblique in the patient."""
    values = np.zeros((40, 36, 60), np.uint8)
    values[10:30, 10:26, 34:54] = 5
    values[10:30, 10:26, 6:28] = 6
    values[12:28, 12:24, 28:34] = 1
    matrix = np.eye(4)
    turn = np.deg2rad(8.0)
    matrix[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    matrix[:3, 3] = (-30.0, 12.0, 400.0)
    return LabelVolume(values, matrix)


def at(ct: CtVolume, truth: LabelVolume, label: int) -> NDArray[Any]:
    return np.asarray(ct.values[truth.values == label])


def test_each_tissue_has_its_ct_number() -> None:
    ct = synthetic_ct(leg(), BONES, replace(STILL, blur_mm=0.0))
    truth = truth_on(leg(), ct)
    assert ct.values.dtype == np.int16
    assert np.median(at(ct, truth, 1)) == 75
    assert set(np.unique(at(ct, truth, 5))) >= {300}
    shell = truth.values == 5
    shell[1:-1, 1:-1, 1:-1] &= ~(shell[:-2, 1:-1, 1:-1] & shell[2:, 1:-1, 1:-1])
    assert ct.values[shell].mean() > 600
    assert ct.values[0, 0, 30] == -1000
    assert {-1000, -100, 50} <= set(np.unique(at(ct, truth, 0)))


def test_nothing_is_lost_by_blur_and_new_voxels() -> None:
    def mass(spec: SyntheticCtSpec) -> float:
        ct = synthetic_ct(leg(), BONES, replace(spec, muscle_mm=25.0))
        inner = truth_on(LabelVolume(np.ones((40, 36, 60), np.uint8), leg().lps_from_index), ct).values != 0
        return float((ct.values[inner] - 50.0).sum() * np.prod(ct.spacing_mm))

    sharp = mass(replace(STILL, blur_mm=0.0))
    assert mass(replace(STILL, blur_mm=1.2)) == pytest.approx(sharp, rel=2e-3)
    assert mass(replace(STILL, blur_mm=0.5, spacing_mm=(0.8, 0.8, 2.0))) == pytest.approx(sharp, rel=1e-2)


def test_the_truth_on_the_labels_own_grid_is_the_label_map() -> None:
    labels = leg()
    same = CtVolume(np.zeros(labels.values.shape, np.int16), labels.lps_from_index)
    np.testing.assert_array_equal(truth_on(labels, same).values, labels.values)


@pytest.mark.parametrize("spacing", [(0.7, 0.7, 0.7), (0.6, 0.6, 1.5)])
def test_bone_keeps_its_place_and_volume_on_other_grids(spacing: tuple[float, float, float]) -> None:
    ct = synthetic_ct(leg(), BONES, replace(STILL, spacing_mm=spacing))
    np.testing.assert_allclose(ct.spacing_mm, spacing)
    truth = truth_on(leg(), ct)
    index = np.argwhere(truth.values == 5)
    centre = ct.lps_from_index[:3, :3] @ index.mean(axis=0) + ct.lps_from_index[:3, 3]
    expected = leg().lps_from_index @ np.array([19.5, 17.5, 43.5, 1.0])
    np.testing.assert_allclose(centre, expected[:3], atol=0.6)
    assert len(index) * np.prod(spacing) == pytest.approx(20 * 16 * 20, rel=0.12)


def test_the_same_seed_gives_the_same_bytes_and_another_does_not() -> None:
    spec = replace(STILL, noise_hu=20.0, texture_hu=30.0)
    first, again, other = (synthetic_ct(leg(), BONES, replace(spec, seed=seed)).values for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.5


def test_noise_has_the_spread_asked_for() -> None:
    noisy, clean = (synthetic_ct(leg(), BONES, replace(STILL, noise_hu=hu)).values for hu in (20.0, 0.0))
    inside = clean > -900
    assert np.std((noisy.astype(float) - clean)[inside]) == pytest.approx(20.0, rel=0.05)


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_other_leg_is_the_mirror_image_on_its_side(side: Any) -> None:
    one, both = (synthetic_ct(leg(), BONES, replace(STILL, other_leg=leg_side)) for leg_side in (None, side))
    np.testing.assert_array_equal(both.values, both.values[::-1])
    assert both.values.shape[0] == 2 * one.values.shape[0]
    same = truth_on(LabelVolume(one.values.astype(np.int32), one.lps_from_index), both).values
    here = slice(0, one.values.shape[0]) if side == "left" else slice(one.values.shape[0], None)
    np.testing.assert_array_equal(same[here], one.values)


def test_table_and_metal_where_they_were_asked_for() -> None:
    plain = synthetic_ct(leg(), BONES, STILL)
    centre = leg().lps_from_index @ np.array([20.0, 18.0, 44.0, 1.0])
    x, y, z = (float(number) for number in centre[:3])
    ct = synthetic_ct(leg(), BONES, replace(STILL, metal_mm=(x, y, z), metal_radius_mm=3.0))
    metal = ct.values == 3071
    assert np.count_nonzero(metal) == pytest.approx(4 / 3 * np.pi * 27, rel=0.15)
    np.testing.assert_allclose(
        ct.lps_from_index[:3, :3] @ np.argwhere(metal).mean(axis=0) + ct.lps_from_index[:3, 3], centre[:3], atol=0.5
    )
    table = synthetic_ct(leg(), BONES, replace(STILL, table_mm=6.0))
    assert np.count_nonzero((table.values == 200).all(axis=(0, 2))) in (5, 6)
    assert not (plain.values == 200).all(axis=(0, 2)).any()


def test_what_cannot_be_made_is_refused() -> None:
    with pytest.raises(ValueError, match="expected at least one bone"):
        synthetic_ct(leg(), {"femur": 77}, STILL)
    with pytest.raises(ValueError, match="noise_hu: expected 0 to 500"):
        SyntheticCtSpec(noise_hu=float("nan"))
    with pytest.raises(ValueError, match="other_leg: expected right, left or None"):
        SyntheticCtSpec(other_leg="both")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="not parallel"):
        truth_on(leg(), CtVolume(np.zeros((3, 3, 3), np.int16), np.eye(4)))
