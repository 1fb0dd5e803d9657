"""What is wrong with the label of one structure, and the part of it that can be mended without a person."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.volume import Mask, cavities, pieces

#: Pieces and cavities below this share of the structure are slips of a segmentation tool; above it, a person looks.
SLIP_FRACTION = 0.01


@dataclass(frozen=True)
class LabelRepair:
    """What was found in the label of one structure, and changed.

    Attributes
    ----------
    voxels : int
        Of the structure after the repair.
    pieces : int
        How many 26-connected pieces the label had.
    second_fraction : float
        Second largest piece over the largest; 0 where there is one piece.
    removed_voxels, filled_voxels : int
        Of islands taken away, and of cavities.
    """

    voxels: int
    pieces: int
    second_fraction: float
    removed_voxels: int
    filled_voxels: int

    @property
    def filled_fraction(self) -> float:
        """Filled cavities over the structure."""
        return self.filled_voxels / self.voxels


def clean_label(mask: Mask, background: Mask, *, one_piece: bool) -> tuple[Mask, LabelRepair]:
    """Keep the body of a structure and fill the cavities inside it.

    Parameters
    ----------
    mask : (I, J, K) bool
        The structure; at least one voxel.
    background : (I, J, K) bool
        Voxels of no structure; a cavity that holds another structure is not filled with this one.
    one_piece : bool
        Keep only the largest piece (a bone); else every piece of at least SLIP_FRACTION of the largest (worn cartilage
        may be several).

    Returns
    -------
    mask : (I, J, K) bool
    LabelRepair

    Raises
    ------
    ValueError
        When the mask is empty.
    """
    if not mask.any():
        raise ValueError("an empty label cannot be cleaned")
    found = pieces(mask)
    kept = 1 if one_piece else sum(size >= SLIP_FRACTION * found.voxels[0] for size in found.voxels)
    body: Mask = (found.numbers >= 1) & (found.numbers <= kept)
    holes = cavities(body) & background
    filled = int(np.count_nonzero(holes))
    second = found.voxels[1] / found.voxels[0] if len(found.voxels) > 1 else 0.0
    repair = LabelRepair(sum(found.voxels[:kept]) + filled, len(found.voxels), second, sum(found.voxels[kept:]), filled)
    return body | holes, repair
