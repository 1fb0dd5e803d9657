"""Labels held against a CT: those that lie on bone, those that do not, how far off, and what explains it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.geometry.label_fit import BoneFit, bone_fit, displacement_mm, edge_of, header_mistakes
from pipeline.geometry.volume import CtVolume, LabelVolume


def block(low: int, high: int) -> LabelVolume:
    values = np.zeros((40, 40, 40), dtype=np.uint8)
    values[low:high, low:high, low:high] = 3
    return LabelVolume(values, np.diag([0.8, 0.8, 0.8, 1.0]))


def ct_of(labels: LabelVolume) -> CtVolume:
    return CtVolume(np.where(labels.values == 3, 900, 50).astype(np.int16), labels.lps_from_index)


def fit(ct: CtVolume, labels: LabelVolume) -> BoneFit:
    return bone_fit(ct, edge_of(labels, 3))


def test_labels_of_the_bone_itself() -> None:
    found = fit(ct_of(block(10, 30)), block(10, 30))
    assert (found.inside_hu, found.outside_hu, found.covered) == (900.0, 50.0, 1.0)


def test_labels_of_another_place_lie_on_no_edge() -> None:
    found = fit(ct_of(block(14, 34)), block(4, 24))
    assert found.inside_hu - found.outside_hu < 100.0


def test_the_grids_may_differ_and_what_is_outside_the_ct_is_counted() -> None:
    labels = block(10, 30)
    coarse = CtVolume(ct_of(labels).values[::2, ::2, :20:2], np.diag([1.6, 1.6, 1.6, 1.0]))
    found = fit(coarse, labels)
    assert 0.3 < found.covered < 0.7
    assert found.inside_hu > found.outside_hu + 300.0


def test_an_empty_label_is_refused() -> None:
    with pytest.raises(ValueError, match="without voxels"):
        edge_of(block(10, 30), 4)


def test_what_borders_on_another_label_is_no_edge() -> None:
    labels = block(10, 30)
    values = np.array(labels.values)
    values[30:34, 10:30, 10:30] = 4
    edge = edge_of(LabelVolume(values, labels.lps_from_index), 3)
    assert edge.just_outside[:, 0].max() < 0.8 * 30
    assert edge_of(labels, 3).just_outside[:, 0].max() == pytest.approx(0.8 * 30)


def bone() -> tuple[CtVolume, LabelVolume]:
    """A lopsided bone with a hard shell, blurred as a scanner does, off the middle of an oblique CT."""
    x, y, z = np.indices((60, 54, 48)) - np.array([26.0, 30.0, 20.0])[:, None, None, None]
    mask = (x / 16) ** 2 + (y / 12) ** 2 + (z / 9) ** 2 < 1.0
    mask |= (np.hypot(x - 6, y + 4) < 6) & (z > 0) & (z < 24)
    core = ndimage.binary_erosion(mask, iterations=3)
    hu = ndimage.gaussian_filter(np.where(core, 250.0, np.where(mask, 1200.0, 40.0)), 0.8)
    hu += np.random.default_rng(1).normal(0.0, 25.0, hu.shape)
    matrix = np.eye(4)
    matrix[:3, :3] = [[0.0, 0.7, 0.0], [0.0, 0.0, 0.8], [0.9, 0.0, 0.0]]
    matrix[:3, 3] = (-31.0, 12.0, 400.0)
    return CtVolume(hu.astype(np.int16), matrix), LabelVolume(np.where(mask, 3, 0).astype(np.uint8), matrix)


def moved(labels: LabelVolume, matrix: NDArray[Any]) -> LabelVolume:
    return LabelVolume(labels.values, matrix @ labels.lps_from_index)


def shifted(labels: LabelVolume, shift: tuple[float, float, float]) -> LabelVolume:
    matrix = np.eye(4)
    matrix[:3, 3] = shift
    return moved(labels, matrix)


@pytest.mark.fault("V11")
@pytest.mark.parametrize(
    "shift", [(0, 0, 0), (0.3, 0, 0), (0, -1, 0.5), (2, 0, 0), (0, 0, -3), (-2, 2.5, 1), (1e-7, 1e-5, 1e-3)]
)
def test_how_far_labels_lie_off(shift: tuple[float, float, float]) -> None:
    ct, labels = bone()
    found = displacement_mm(ct, (edge_of(shifted(labels, shift), 3),))
    np.testing.assert_allclose(found, shift, atol=0.3)


@pytest.mark.fault("V11")
@pytest.mark.parametrize("number", range(7))
def test_each_mistake_of_a_header_is_undone_by_its_matrix_alone(number: int) -> None:
    ct, labels = bone()
    words, undone = list(header_mistakes(ct))[number]
    wrong = edge_of(moved(labels, np.linalg.inv(undone)), 3)
    contrasts = {
        name: fit.inside_hu - fit.outside_hu
        for name, matrix in header_mistakes(ct)
        for fit in [bone_fit(ct, wrong, matrix)]
        if fit.covered > 0.99
    }
    assert max(contrasts, key=lambda name: contrasts[name]) == words
    assert contrasts.pop(words) > 500.0
    assert all(contrast < 500.0 for contrast in contrasts.values())
    as_given = bone_fit(ct, wrong)
    assert as_given.covered < 0.99 or as_given.inside_hu - as_given.outside_hu < 500.0
