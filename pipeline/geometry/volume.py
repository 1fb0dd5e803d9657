"""Volumes: an array of voxels, labels or CT numbers, and where it lies in the patient."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Voxels that share a face, an edge or a corner are one piece ...
_CONNECTED_26 = np.ones((3, 3, 3), dtype=bool)
#: Positive direction of each LPS axis, and its opposite.
_LETTERS = ("LPS", "RAI")


@dataclass(frozen=True, eq=False)
class LabelVolume:
    """A segmentation.

    Attributes
    ----------
    values : (I, J, K) uint8 or uint16
        Label of each voxel; 0 is background.
    lps_from_index : (4, 4) float64
        Takes voxel indices (i, j, k, 1), centre of a voxel, to LPS millimetres. Columns orthogonal; right-handed.
    """

    values: NDArray[np.generic]
    lps_from_index: NDArray[np.float64]

    @property
    def spacing_mm(self) -> NDArray[np.float64]:
        """(3,) voxel size along i, j, k."""
        return np.asarray(np.linalg.norm(self.lps_from_index[:3, :3], axis=0))


@dataclass(frozen=True, eq=False)
class CtVolume:
    """A CT.

    Attributes
    ----------
    values : (I, J, K) int16
        CT number of each voxel, Hounsfield units.
    lps_from_index : (4, 4) float64
        As in :class:`LabelVolume`.
    """

    values: NDArray[np.int16]
    lps_from_index: NDArray[np.float64]

    @property
    def spacing_mm(self) -> NDArray[np.float64]:
        """(3,) voxel size along i, j, k."""
        return np.asarray(np.linalg.norm(self.lps_from_index[:3, :3], axis=0))


AnyVolume = TypeVar("AnyVolume", LabelVolume, CtVolume)


class Pieces(NamedTuple):
    """The 26-connected pieces of a mask: their numbers (0 is background) and their sizes in voxels, largest first."""

    numbers: NDArray[np.int32]
    voxels: tuple[int, ...]


def corner_points(lps_from_index: Float, shape: tuple[int, ...]) -> Float:
    """(8, 3) centres of the corner voxels, mm, in the frame that the (4, 4) matrix leads to."""
    corners = np.array(np.meshgrid(*((0, n - 1) for n in shape[:3]), indexing="ij"), dtype=np.float64).reshape(3, 8)
    return (lps_from_index[:3, :3] @ corners + lps_from_index[:3, 3:]).T


def axis_codes(lps_from_index: Float) -> str:
    """Where i, j and k mostly run to in the patient, such as ``LPS`` or ``PIR``; ``?`` for an axis of no length."""
    out = ""
    for column in lps_from_index[:3, :3].T:
        main = int(np.argmax(np.abs(column)))
        out += _LETTERS[int(column[main] < 0)][main] if np.abs(column[main]) > 0 else "?"
    return out


def shear(lps_from_index: Float) -> float:
    """Largest |cosine| between two index axes: 0 for an orthogonal grid; NaN for an axis of no length."""
    with np.errstate(invalid="ignore", divide="ignore"):
        axes = lps_from_index[:3, :3] / np.linalg.norm(lps_from_index[:3, :3], axis=0)
    return float(np.abs(axes.T @ axes - np.eye(3)).max())


def in_lps_order(volume: AnyVolume) -> AnyVolume:
    """The same voxels stored in the order that is nearest to +L, +P, +S and right-handed.

    Every file that holds the same anatomy on the same grid, however its axes were stored, gives the same volume.

    Parameters
    ----------
    volume : LabelVolume or CtVolume
        Index axes in any order and direction, also left-handed.

    Returns
    -------
    LabelVolume or CtVolume
        No voxel is resampled: axes are exchanged and reversed, data and matrix together.
    """
    order: tuple[int, ...] = _nearest_order(volume.lps_from_index)
    values = np.transpose(volume.values, order)
    matrix = volume.lps_from_index[:, (*order, 3)].copy()
    flips = matrix[[0, 1, 2], [0, 1, 2]] < 0
    if (np.linalg.det(matrix[:3, :3]) < 0) ^ (int(flips.sum()) % 2 == 1):
        # very oblique: nearest would be left-handed, so the axis that is least sure of its direction gives way
        weakest = int(np.argmin(np.abs(np.diag(matrix)[:3]) / np.linalg.norm(matrix[:3, :3], axis=0)))
        flips[weakest] = not flips[weakest]
    for axis in np.flatnonzero(flips):
        matrix[:3, 3] += matrix[:3, axis] * (values.shape[axis] - 1)
        matrix[:3, axis] *= -1.0
        values = np.flip(values, int(axis))
    # + 0.0 turns -0.0 into 0.0, so that equal geometry is equal bytes
    return replace(volume, values=np.ascontiguousarray(values), lps_from_index=matrix + 0.0)


def _nearest_order(lps_from_index: Float) -> tuple[int, ...]:
    """Which index axis runs along L/R, along P/A and along S/I: the assignment of the largest total |cosine|."""
    cosines = np.abs(lps_from_index[:3, :3] / np.linalg.norm(lps_from_index[:3, :3], axis=0))
    # rounded, so that a tie (axes at 45 degrees) is settled by the order of candidates, not by the last bit
    return max(permutations(range(3)), key=lambda order: round(sum(cosines[row, order[row]] for row in range(3)), 6))


def cropped(volume: LabelVolume, margin: int) -> LabelVolume:
    """The part that holds every non-zero voxel and ``margin`` voxels around it, as far as the volume reaches.

    Raises
    ------
    ValueError
        When all voxels are zero.
    """
    box = box_of(volume.values != 0)
    begin = np.array([max(edge.start - margin, 0) for edge in box])
    part = tuple(slice(int(start), edge.stop + margin) for start, edge in zip(begin, box, strict=True))
    matrix = volume.lps_from_index.copy()
    matrix[:3, 3] += matrix[:3, :3] @ begin
    return LabelVolume(np.ascontiguousarray(volume.values[part]), matrix)


def box_of(mask: Mask) -> tuple[slice, slice, slice]:
    """The smallest box of indices that holds every voxel of a mask.

    Raises
    ------
    ValueError
        When the mask is empty.
    """
    spans = [np.flatnonzero(mask.any(axis=tuple(a for a in range(3) if a != axis))) for axis in range(3)]
    if not len(spans[0]):
        raise ValueError("a mask without voxels has no box")
    i, j, k = (slice(int(span[0]), int(span[-1]) + 1) for span in spans)
    return i, j, k


def averaged(ct: CtVolume, voxel_mm: float) -> tuple[NDArray[np.float32], Float, tuple[int, int, int]]:
    """Means over blocks of voxels up to the size asked for, the last of each axis perhaps of fewer.

    Parameters
    ----------
    ct : CtVolume
    voxel_mm : float
        Largest side of a block, where a voxel is not larger already.

    Returns
    -------
    values : (I, J, K) float32
    lps_from_index : (4, 4) float64
        Of the centres of whole blocks.
    blocks : (int, int, int)
        Voxels in a block along each axis.
    """
    i, j, k = (max(int(voxel_mm / step + 1e-6), 1) for step in ct.spacing_mm)
    begins = [np.arange(0, size, block) for size, block in zip(ct.values.shape, (i, j, k), strict=True)]
    sums = np.zeros([len(begin) for begin in begins], dtype=np.int32)
    for a, b, c in product(range(i), range(j), range(k)):  # strided views: a tenth of the time of a reduction
        part = ct.values[a::i, b::j, c::k]
        sums[: part.shape[0], : part.shape[1], : part.shape[2]] += part
    counts = [np.diff([*begin, size]) for begin, size in zip(begins, ct.values.shape, strict=True)]
    values = (sums / np.einsum("i,j,k->ijk", *counts)).astype(np.float32)
    matrix = ct.lps_from_index.copy()
    matrix[:3, 3] += matrix[:3, :3] @ ((np.array([i, j, k]) - 1) / 2)
    matrix[:3, :3] *= [i, j, k]
    return values, matrix, (i, j, k)


def label_counts(values: NDArray[np.uint16]) -> NDArray[np.int64]:
    """(65536,) how many voxels have each label; slab by slab, since counting copies to 64 bits."""
    counts = np.zeros(65_536, dtype=np.int64)
    for slab in values:
        counts += np.bincount(slab.ravel(), minlength=65_536)
    return counts


def pieces(mask: Mask) -> Pieces:
    """Number the 26-connected pieces of a mask, the largest first (ties: the one met first in memory order)."""
    from scipy import ndimage  # noqa: PLC0415 - half a second that a run of cached stages need not pay

    numbers, count = ndimage.label(mask, _CONNECTED_26)
    sizes = np.bincount(numbers.ravel(), minlength=count + 1)[1:]
    order = np.argsort(-sizes, kind="stable")
    rank = np.zeros(count + 1, dtype=np.int32)
    rank[order + 1] = np.arange(1, count + 1)
    return Pieces(rank[numbers], tuple(int(size) for size in sizes[order]))


def cavities(mask: Mask) -> Mask:
    """Voxels outside the mask that no 6-connected path leads out of (the border of the array is outside)."""
    from scipy import ndimage  # noqa: PLC0415 - half a second that a run of cached stages need not pay

    numbers, count = ndimage.label(~mask)  # by faces, the complement of 26-connected bone
    faces = [numbers.take(end, axis) for axis in range(3) for end in (0, -1)]
    enclosed = np.ones(count + 1, dtype=bool)
    enclosed[np.concatenate([np.unique(face) for face in faces])] = False
    enclosed[0] = False
    return np.asarray(enclosed[numbers])


def border_areas_mm2(mask: Mask, spacing_mm: Float) -> Float:
    """(6,) area of the mask on each face of the array, where the field of view cuts it: i low, i high, j low, ..."""
    areas = []
    for axis in range(3):
        voxel_face = float(np.prod(np.delete(spacing_mm, axis)))
        areas += [voxel_face * np.count_nonzero(mask.take(end, axis)) for end in (0, -1)]
    return np.array(areas)


def shared_area_mm2(values: NDArray[Any], pair: tuple[int, int], spacing_mm: Float) -> float:
    """Area of the voxel faces that have one label of the pair on one side and the other on the other side."""
    first, second = values == pair[0], values == pair[1]
    total = 0.0
    for axis in range(3):
        face = float(np.prod(np.delete(spacing_mm, axis)))
        low, high = (slice(None),) * axis + (slice(None, -1),), (slice(None),) * axis + (slice(1, None),)
        total += face * (np.count_nonzero(first[low] & second[high]) + np.count_nonzero(second[low] & first[high]))
    return total


def centroid_lps(mask: Mask, lps_from_index: Float) -> Float:
    """(3,) centre of the mask's voxels, LPS mm.

    Raises
    ------
    ValueError
        When the mask is empty.
    """
    if not mask.any():
        raise ValueError("an empty mask has no centroid")
    counts = [np.count_nonzero(mask, axis=tuple(a for a in range(3) if a != axis)) for axis in range(3)]
    index = [np.average(np.arange(len(count)), weights=count) for count in counts]
    return np.asarray(lps_from_index[:3, :3] @ index + lps_from_index[:3, 3])
