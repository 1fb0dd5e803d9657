"""Voxel masks made fit for a surface: framed in air, without specks, cavities and one-voxel gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.volume import LabelVolume, box_of, cavities
from pipeline.records import Side

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Voxels of air around a framed mask: one to close the surface, one for the closing of gaps to reach into.
MARGIN = 2
#: A piece below this share of the mask is a speck.
SPECK_FRACTION = 0.01


@dataclass(frozen=True, eq=False)
class FramedMask:
    """A mask cut to its bounding box with air around it; index 0 is at ``offset`` in the array it came from."""

    inside: Mask
    offset: tuple[int, int, int]


def framed(mask: Mask, like: Mask | None = None) -> FramedMask:
    """The part of a mask in the bounding box of another (of itself by default), padded by MARGIN voxels of air.

    Raises
    ------
    ValueError
        When the mask that gives the box is empty or not three-dimensional.
    """
    guide = mask if like is None else like
    if guide.ndim != 3 or not guide.any():
        raise ValueError(f"expected a 3-D mask with at least one voxel, got shape {guide.shape}")
    box = box_of(guide)
    low, middle, high = (int(edge.start) - MARGIN for edge in box)
    return FramedMask(np.pad(mask[box], MARGIN), (low, middle, high))


def shifted_index(lps_from_index: Float, offset: tuple[int, int, int]) -> Float:
    """(4, 4) to LPS mm from the indices of a part whose index 0 is at ``offset`` in the whole."""
    shift = np.eye(4)
    shift[:3, 3] = offset
    return np.asarray(lps_from_index @ shift)


def voxels_of(values: NDArray[np.generic], labels: Sequence[int]) -> Mask:
    """Where an array of labels has one of some labels."""
    mask = np.zeros_like(values, dtype=np.bool_)
    for label in labels:
        mask |= values == label
    return mask


def part_with(volume: LabelVolume, labels: Sequence[int]) -> LabelVolume:
    """The part of a volume that holds some labels, and MARGIN voxels of air; all of it where it has none of them."""
    mask = voxels_of(volume.values, labels)
    if not mask.any():
        return volume
    box = box_of(mask)
    low, middle, high = (int(edge.start) - MARGIN for edge in box)
    return LabelVolume(np.pad(volume.values[box], MARGIN), shifted_index(volume.lps_from_index, (low, middle, high)))


def without_specks(mask: Mask) -> Mask:
    """The mask without pieces below SPECK_FRACTION of it.

    Pieces are voxels joined by faces: an iso-surface half-way between voxel centres parts those that share only an
    edge or a corner.
    """
    from scipy import ndimage  # noqa: PLC0415 - half a second that a run of cached stages need not pay

    numbers, _ = ndimage.label(mask)
    sizes = np.bincount(numbers.ravel())
    keep = sizes >= SPECK_FRACTION * np.count_nonzero(mask)
    keep[0] = False
    return np.asarray(keep[numbers])


def without_cavities(mask: Mask) -> Mask:
    """The mask with everything filled that it encloses."""
    return mask | cavities(mask)


def without_gaps(mask: Mask, keep_out: Mask) -> Mask:
    """The mask with gaps of one voxel closed (morphological closing by face neighbours) and cavities filled.

    Parameters
    ----------
    mask : (I, J, K) bool
        Framed.
    keep_out : (I, J, K) bool
        Voxels of other structures, which are not taken to close a gap.
    """
    from scipy import ndimage  # noqa: PLC0415 - half a second that a run of cached stages need not pay

    return without_cavities(mask | (ndimage.binary_closing(mask) & ~keep_out))


def seen_as_right(volume: LabelVolume, side: Side) -> LabelVolume:
    """The same volume, its first index axis reversed for a left joint.

    The triangles of an iso-surface depend on the direction of the index axes. Canonical volumes run to the patient's
    left, so the array of a left joint is the mirror image of that of the same joint on the right; reversed, the arrays
    are equal and the meshes exact mirror images.
    """
    if side == "right":
        return volume
    matrix = volume.lps_from_index.copy()
    matrix[:3, 3] += matrix[:3, 0] * (volume.values.shape[0] - 1)
    matrix[:3, 0] *= -1.0
    return LabelVolume(volume.values[::-1], matrix)
