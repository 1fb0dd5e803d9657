"""Masks are mended by voxels: what is removed, filled and left alone."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.volume import LabelVolume
from pipeline.geometry.voxel_mask import (
    MARGIN,
    framed,
    part_with,
    seen_as_right,
    shifted_index,
    voxels_of,
    without_cavities,
    without_gaps,
    without_specks,
)


def _block() -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    mask = np.zeros((14, 14, 14), dtype=np.bool_)
    mask[2:12, 2:12, 2:12] = True
    return mask


def test_framing_keeps_every_voxel_where_it_was() -> None:
    mask = np.zeros((9, 8, 7), dtype=np.bool_)
    mask[0, 3, 6] = mask[4, 7, 2] = True
    frame = framed(mask)
    assert np.array_equal(np.argwhere(frame.inside) + frame.offset, np.argwhere(mask))
    assert not frame.inside[:MARGIN].any()
    assert not frame.inside[:, :, -MARGIN:].any()


def test_an_empty_mask_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one voxel"):
        framed(np.zeros((3, 3, 3), dtype=np.bool_))


def _labelled() -> LabelVolume:
    values = np.zeros((9, 8, 7), dtype=np.uint8)
    values[0, 3, 6], values[4, 7, 2], values[2, 5, 4], values[8, 0, 0] = 1, 2, 3, 4
    matrix = np.array([[0.5, 0, 0, -7.0], [0, 0.6, 0, 2.0], [0, 0, -0.7, 3.0], [0, 0, 0, 1.0]])
    return LabelVolume(values, matrix)


def test_a_part_holds_its_labels_and_what_lies_between_where_they_were() -> None:
    whole = _labelled()
    part = part_with(whole, [1, 2])
    for label in (1, 2, 3):
        here, there = (np.argwhere(volume.values == label)[0] for volume in (part, whole))
        placed = [v.lps_from_index[:3] @ [*index, 1.0] for v, index in ((part, here), (whole, there))]
        assert np.allclose(*placed)
    assert not (part.values == 4).any()
    assert not part.values[:MARGIN].any()
    assert not part.values[:, :, -MARGIN:].any()


def test_a_part_is_framed_as_the_whole_is() -> None:
    """Cut out or not, the surface is made from the same voxels at the same place, to the last bit."""
    whole = _labelled()
    part = part_with(whole, [1, 2])
    frames = [framed(voxels_of(volume.values, [1, 2])) for volume in (whole, part)]
    assert np.array_equal(frames[0].inside, frames[1].inside)
    one, other = (shifted_index(v.lps_from_index, f.offset) for v, f in zip((whole, part), frames, strict=True))
    assert np.array_equal(one, other)


def test_labels_that_are_nowhere_leave_the_volume_as_it_is() -> None:
    whole = _labelled()
    assert part_with(whole, [7]) is whole
    assert part_with(whole, []) is whole


def test_specks_go_and_pieces_stay() -> None:
    mask = _block()
    mask[0, 0, 0] = True
    mask[1, 1, 1] = True  # touches the block in a corner only: the surface parts it
    assert np.array_equal(without_specks(mask), _block())
    halves = _block()
    halves[6] = False
    assert np.array_equal(without_specks(halves), halves)


def test_cavities_are_filled() -> None:
    mask = _block()
    mask[5:7, 5:7, 5:7] = False
    assert np.array_equal(without_cavities(mask), _block())


def test_a_tunnel_of_one_voxel_is_closed_unless_another_structure_lies_in_it() -> None:
    mask, nothing = _block(), np.zeros((14, 14, 14), dtype=np.bool_)
    mask[2:12, 6, 6] = False
    assert without_gaps(mask, nothing)[3:11, 6, 6].all()
    assert np.array_equal(without_gaps(mask, ~mask), mask)


def test_a_left_volume_is_stored_as_a_right_one_and_lies_where_it_was() -> None:
    values = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    matrix = np.array([[0.5, 0, 0, -7.0], [0, 0.6, 0, 2.0], [0, 0, 0.7, 3.0], [0, 0, 0, 1.0]])
    mirrored = seen_as_right(LabelVolume(values, matrix), "left")
    for index in np.ndindex(2, 3, 4):
        other = (1 - index[0], *index[1:])
        assert mirrored.values[other] == values[index]
        assert np.allclose(mirrored.lps_from_index @ [*other, 1.0], matrix @ [*index, 1.0])
    assert seen_as_right(LabelVolume(values, matrix), "right").values is values
