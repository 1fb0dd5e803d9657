"""Labels held against a CT: those that lie on bone, those that do not."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.label_fit import bone_fit
from pipeline.geometry.volume import CtVolume, LabelVolume


def block(low: int, high: int) -> LabelVolume:
    values = np.zeros((40, 40, 40), dtype=np.uint8)
    values[low:high, low:high, low:high] = 3
    return LabelVolume(values, np.diag([0.8, 0.8, 0.8, 1.0]))


def ct_of(labels: LabelVolume) -> CtVolume:
    return CtVolume(np.where(labels.values == 3, 900, 50).astype(np.int16), labels.lps_from_index)


def test_labels_of_the_bone_itself() -> None:
    fit = bone_fit(ct_of(block(10, 30)), block(10, 30), 3)
    assert (fit.inside_hu, fit.outside_hu, fit.covered) == (900.0, 50.0, 1.0)


def test_labels_of_another_place_lie_on_no_edge() -> None:
    fit = bone_fit(ct_of(block(14, 34)), block(4, 24), 3)
    assert fit.inside_hu - fit.outside_hu < 100.0


def test_the_grids_may_differ_and_what_is_outside_the_ct_is_counted() -> None:
    labels = block(10, 30)
    coarse = CtVolume(ct_of(labels).values[::2, ::2, :20:2], np.diag([1.6, 1.6, 1.6, 1.0]))
    fit = bone_fit(coarse, labels, 3)
    assert 0.3 < fit.covered < 0.7
    assert fit.inside_hu > fit.outside_hu + 300.0


def test_an_empty_label_is_refused() -> None:
    with pytest.raises(ValueError, match="without voxels"):
        bone_fit(ct_of(block(10, 30)), block(10, 30), 4)
