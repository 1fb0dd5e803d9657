"""Islands and cavities of one structure."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.label_cleaning import clean_label
from pipeline.geometry.volume import Mask


def bone() -> Mask:
    mask = np.zeros((20, 20, 20), dtype=bool)
    mask[2:12, 2:12, 2:12] = True
    return mask


def test_a_clean_label_stays() -> None:
    mask, repair = clean_label(bone(), ~bone(), one_piece=True)
    np.testing.assert_array_equal(mask, bone())
    assert (repair.voxels, repair.pieces, repair.second_fraction) == (1000, 1, 0.0)
    assert (repair.removed_voxels, repair.filled_voxels) == (0, 0)


@pytest.mark.parametrize(("one_piece", "kept"), [(True, 1000), (False, 1027)])
def test_large_islands_stay_only_in_soft_tissue(one_piece: bool, kept: int) -> None:  # noqa: FBT001
    spoiled = bone()
    spoiled[15:18, 15:18, 15:18] = True
    spoiled[0, 0, 19] = True
    mask, repair = clean_label(spoiled, ~spoiled, one_piece=one_piece)
    assert np.count_nonzero(mask) == repair.voxels == kept
    assert not mask[0, 0, 19]
    assert (repair.pieces, repair.second_fraction) == (3, 0.027)
    assert repair.removed_voxels == 1028 - kept


def test_cavities_are_filled_unless_they_hold_another_structure() -> None:
    hollow = bone()
    hollow[4:6, 4:6, 4:6] = False
    hollow[8, 8, 8] = False
    background = ~bone()
    background[4:6, 4:6, 4:6] = True
    mask, repair = clean_label(hollow, background, one_piece=True)
    assert repair.filled_voxels == 8
    assert repair.filled_fraction == pytest.approx(8 / 999)
    assert mask[4, 4, 4]
    assert not mask[8, 8, 8]


def test_an_empty_label_is_an_argument_error() -> None:
    with pytest.raises(ValueError, match="empty label"):
        clean_label(np.zeros((3, 3, 3), dtype=bool), np.ones((3, 3, 3), dtype=bool), one_piece=True)
