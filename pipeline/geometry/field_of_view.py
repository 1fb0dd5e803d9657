"""What of a knee a scan shows: how much of either shaft, how far apart the bones are, which side, how much metal.

For ``ct2lut check``: everything is counted in layers of voxels across the axis nearest to the body's, without a
surface, so that a coarse copy of a CT will do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.knee_side import LATERAL_OF, SideSign
from pipeline.geometry.long_axis import LEAST_SECTIONS, LEAST_UNCERTAINTY_DEG, SHAFT_AREA_SHARE, SPACING_MM, STRAY_MM
from pipeline.geometry.volume import CtVolume, LabelVolume, Mask, averaged, centroid_lps
from pipeline.records import Side

Float = NDArray[np.float64]

#: Bone that has to lie beyond the widest part of a bone's end for an axis to be found at all, mm.
LEAST_BEYOND_MM = LEAST_SECTIONS * SPACING_MM
#: A layer with less than this share of the shaft's usual area is one that the border of the scan cuts obliquely.
_WHOLE_SHARE = 0.5
#: Share of the columns that may lie nearer than the joint space: single voxels at the eminence (as for made cartilage).
_NEAREST_PERCENT = 2.0


@dataclass(frozen=True)
class BoneExtent:
    """How much of one long bone is there, mm along the axis of the layers.

    Attributes
    ----------
    reach_mm : float
        From the joint line to the end of what the scan shows.
    beyond_mm : float
        Of that, beyond the widest part of the end of the bone.
    shaft_mm : float
        Of that, shaft: beyond the flare, as stage ``anatomy`` understands it.
    """

    reach_mm: float
    beyond_mm: float
    shaft_mm: float


@dataclass(frozen=True)
class KneeExtent:
    """Both bones and the space between them.

    Attributes
    ----------
    femur, tibia : BoneExtent
    space_mm : float
        Smallest distance between the two along the axis of the layers; NaN where they do not face each other.
    layer_mm : float
        Thickness of a layer: lengths are no finer than this.
    """

    femur: BoneExtent
    tibia: BoneExtent
    space_mm: float
    layer_mm: float


def coarse_copy(ct: CtVolume, voxel_mm: float) -> CtVolume:
    """Means over whole blocks of voxels, as many as fit into the size asked for, rounded to whole Hounsfield units.

    Parameters
    ----------
    ct : CtVolume
    voxel_mm : float
        Largest voxel side of the copy, where those of the CT are not larger already.
    """
    values, matrix, blocks = averaged(ct, voxel_mm)
    i, j, k = (max(size // block, 1) for size, block in zip(ct.values.shape, blocks, strict=True))
    return CtVolume(np.rint(values[:i, :j, :k]).astype(np.int16), matrix)


def shaft_needed_mm(limit_deg: float) -> float:
    """Length of shaft with which the uncertainty of a long axis is at the limit; infinite for a limit never met."""
    room = limit_deg - LEAST_UNCERTAINTY_DEG
    return float(STRAY_MM / np.tan(np.radians(room))) if room > 0 else float("inf")


def knee_extent(volume: LabelVolume, femur: int, tibia: int) -> KneeExtent:
    """Measure what is there of a knee.

    Parameters
    ----------
    volume : LabelVolume
        Index axes near +L, +P, +S; the third is the axis of the layers.
    femur, tibia : int
        Their labels.

    Raises
    ------
    ValueError
        When either bone has no voxels.
    """
    values = np.asarray(volume.values)
    layer_mm = float(volume.spacing_mm[2])
    upper, lower = values == femur, values == tibia
    areas = [np.count_nonzero(bone, axis=(0, 1)) for bone in (upper, lower)]
    if not all(area.any() for area in areas):
        raise ValueError("a bone without voxels has no extent")
    bottom, top = int(np.flatnonzero(areas[0])[0]), int(np.flatnonzero(areas[1])[-1])
    joint = (bottom + top) / 2
    return KneeExtent(
        _extent(areas[0], joint, layer_mm),
        _extent(areas[1][::-1], len(areas[1]) - 1 - joint, layer_mm),
        _space_layers(upper, lower) * layer_mm,
        layer_mm,
    )


def _extent(areas: NDArray[np.integer], joint: float, layer_mm: float) -> BoneExtent:
    """One bone from its areas layer by layer, from the joint outwards."""
    last, widest = int(np.flatnonzero(areas)[-1]), int(np.argmax(areas))
    beyond = areas[widest + 1 : last + 1]
    narrow = beyond[beyond < SHAFT_AREA_SHARE * areas[widest]]
    whole = int(np.count_nonzero(narrow > _WHOLE_SHARE * np.median(narrow))) if len(narrow) else 0
    return BoneExtent((last + 0.5 - joint) * layer_mm, len(beyond) * layer_mm, whole * layer_mm)


def _space_layers(upper: Mask, lower: Mask) -> float:
    """Layers between the lowest voxel of the upper bone and the highest of the lower one, where they are nearest."""
    both = upper.any(axis=2) & lower.any(axis=2)
    if not both.any():
        return float("nan")
    low = np.argmax(upper[both], axis=1)
    high = upper.shape[2] - 1 - np.argmax(lower[both][:, ::-1], axis=1)
    return float(np.percentile(low - high - 1, _NEAREST_PERCENT))


def side_signs(volume: LabelVolume, structures: Mapping[str, int], side: Side) -> tuple[SideSign, ...]:
    """What tells the side, as :mod:`pipeline.geometry.knee_side` asks it, with the patient's own right for lateral.

    Parameters
    ----------
    volume : LabelVolume
    structures : mapping of str to int
        Structure name -> label; each has voxels.
    side : "right" or "left"
        As declared.
    """
    values = np.asarray(volume.values)
    signs = []
    for first, second, least_mm in LATERAL_OF:
        if first in structures and second in structures:
            one, other = (centroid_lps(values == structures[name], volume.lps_from_index) for name in (first, second))
            way = float((other - one)[0]) if side == "right" else float((one - other)[0])
            if abs(way) >= least_mm:
                signs.append(SideSign(_sentence(first, second, way), way, way > 0))
    return tuple(signs)


def _sentence(first: str, second: str, way_mm: float) -> str:
    where = "outer" if way_mm > 0 else "inner"
    return f"the {first} lies {abs(way_mm):.0f} mm to the {where} side of the {second}".replace("_", " ")


def metal_mm3(ct: CtVolume, around: LabelVolume, metal_hu: float) -> float:
    """Volume of what is denser than bone, in the box of a label volume.

    Parameters
    ----------
    ct : CtVolume
    around : LabelVolume
        On a grid with the axes of the CT, finer or coarser.
    metal_hu : float
        CT number above which it is metal.
    """
    edges = np.array([[-0.5] * 3, np.array(around.values.shape) - 0.5])
    lps = edges @ around.lps_from_index[:3, :3].T + around.lps_from_index[:3, 3]
    index = (lps - ct.lps_from_index[:3, 3]) @ np.linalg.inv(ct.lps_from_index[:3, :3]).T + 0.5
    low, high = np.clip(np.rint(np.sort(index, axis=0)), 0, ct.values.shape).astype(np.int64)
    box = tuple(slice(int(start), int(stop)) for start, stop in zip(low, high, strict=True))
    return float(np.count_nonzero(ct.values[box] > metal_hu) * np.prod(ct.spacing_mm))
