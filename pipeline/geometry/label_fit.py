"""Whether a label of bone lies on bone in a CT: density just inside its edge against density just outside."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.volume import CtVolume, LabelVolume, box_of

#: Layers of voxels on either side of the edge that are compared; the one at the edge itself is a mixture.
INNER, OUTER = 2, 3


class BoneFit(NamedTuple):
    """One label against a CT.

    Attributes
    ----------
    inside_hu, outside_hu : float
        Median CT number of the layer inside the edge, and of soft tissue around it; NaN outside the CT.
    covered : float
        Share of the compared voxels that lie in the CT.
    """

    inside_hu: float
    outside_hu: float
    covered: float


def bone_fit(ct: CtVolume, labels: LabelVolume, value: int) -> BoneFit:
    """Density on both sides of the edge of one label.

    Parameters
    ----------
    ct : CtVolume
    labels : LabelVolume
        On any grid.
    value : int

    Raises
    ------
    ValueError
        When the label is empty.
    """
    from scipy import ndimage  # noqa: PLC0415 - half a second that a run of cached stages need not pay

    every = np.asarray(labels.values)
    box = tuple(slice(max(edge.start - OUTER - 1, 0), edge.stop + OUTER + 1) for edge in box_of(every == value))
    part = every[box]
    mask = part == value
    within = mask & ~ndimage.binary_erosion(mask, iterations=INNER, border_value=1)
    around = ndimage.binary_dilation(mask, iterations=OUTER) & ~ndimage.binary_dilation(mask) & (part == 0)
    begin = np.array([edge.start for edge in box])
    index_from_index = np.linalg.inv(ct.lps_from_index) @ labels.lps_from_index
    inside, outside = (_sampled(ct, np.argwhere(layer) + begin, index_from_index) for layer in (within, around))
    known = np.concatenate([inside, outside])
    return BoneFit(_median(inside), _median(outside), float(np.isfinite(known).mean()))


def _sampled(ct: CtVolume, index: NDArray[np.int64], index_from_index: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) CT number of the voxel nearest to each place; NaN outside."""
    at = np.rint(index @ index_from_index[:3, :3].T + index_from_index[:3, 3]).astype(int)
    inside = ((at >= 0) & (at < ct.values.shape)).all(axis=1)
    out = np.full(len(at), np.nan)
    out[inside] = ct.values[tuple(at[inside].T)]
    return out


def _median(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")
