"""From a CT to the labels of femur, tibia, patella and fibula of one knee, and how sure each of them is.

Developed on synthetic CT (:mod:`pipeline.geometry.synthetic_ct`). Cartilage and menisci are not seen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.geometry.bone_parts import (
    BONE_LABELS,
    METAL_HU,
    OTHER,
    SOFT_HU,
    FoundKnee,
    boundary_hu,
    contested,
    everywhere_nearest,
    filled,
    find_knee,
    largest_piece,
    refined,
    widened,
    worn,
)
from pipeline.geometry.volume import CtVolume, LabelVolume, Mask, border_areas_mm2, box_of, in_lps_order
from pipeline.geometry.voxel_mask import shifted_index
from pipeline.records import Side

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Labels = NDArray[np.uint8]

#: Two bones closer than this are parted by the darkest valley between them, not by the nearest one.
_CONTESTED_MM = 3.0
#: A boundary this much lower leaves no gap in a thin shell; this deep below it, all is bone.
_LOOSE_FRACTION = 0.65
_SURELY_INSIDE_MM = 2.0
#: Air and soft tissue kept around the bones.
_MARGIN_MM = 6.0
#: Volume of each bone (mm3) that a person's knee may show; a shaft that goes on makes more of it, at most to reach_mm.
PLAUSIBLE_MM3: Mapping[str, tuple[float, float]] = {
    "femur": (40_000.0, 500_000.0),
    "tibia": (30_000.0, 400_000.0),
    "patella": (5_000.0, 45_000.0),
    "fibula": (2_000.0, 60_000.0),
}
#: An edge this much denser than what lies outside it is a bone's (HU).
_EDGE_HU = 200.0


@dataclass(frozen=True)
class SegmentationSettings:
    """How bones are found.

    Attributes
    ----------
    smoothing_mm : float
        Standard deviation of a Gaussian on the CT before anything else.
    closing_mm : float
        Gaps in the cortical shell up to about twice this do not let the inside of a bone out.
    reach_mm : float
        How far from the joint line bones are followed, up and down.

    Raises
    ------
    ValueError
        When a number is not finite or outside its range.
    """

    smoothing_mm: float = 0.3
    closing_mm: float = 1.5
    reach_mm: float = 160.0

    def __post_init__(self) -> None:
        for name, low, high in (("smoothing_mm", 0.0, 3.0), ("closing_mm", 0.0, 5.0), ("reach_mm", 40.0, 600.0)):
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                raise ValueError(f"{name}: expected {low:g} to {high:g}, got {value!r}")


@dataclass(frozen=True)
class BoneFacts:
    """What was found out about one bone.

    Attributes
    ----------
    voxels : int
    volume_mm3 : float
    cut_mm2 : float
        Area of it on the border of the CT or of the part that was kept.
    edge_fraction : float
        Share of its surface at which the CT falls by at least 200 HU within 2 mm.
    shell_fraction : float
        Share of it that its shell encloses without gaps being closed.
    parted_voxels : int
        Voxels that lay so near to another bone that the darkest valley decided.
    """

    voxels: int
    volume_mm3: float
    cut_mm2: float
    edge_fraction: float
    shell_fraction: float
    parted_voxels: int


@dataclass(frozen=True)
class SegmentationFacts:
    """What was found out about the scan as a whole.

    Attributes
    ----------
    knees : int
        Knees in the CT.
    wear_mm : float
        How far bones had to be worn down until they came apart.
    joint_mm : float
        LPS z of the joint line.
    metal_mm3 : float
        Volume of metal in the part that was kept.
    missing : tuple of str
        Bones that were not found: patella, fibula.
    """

    knees: int
    wear_mm: float
    joint_mm: float
    metal_mm3: float
    missing: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class BoneSegmentation:
    """The bones of one knee.

    Attributes
    ----------
    labels : LabelVolume
        uint8, values of ``structures``; on the CT's grid in the order of LPS, cut to the knee.
    structures : mapping of str to int
        The bones that were found -> label value.
    confidence : mapping of str to float
        For each bone, 0 to 1: share of its surface with a clear edge, times share of it within a closed shell, times
        1 for a plausible volume (falling in proportion outside the plausible range).
    bones : mapping of str to BoneFacts
    facts : SegmentationFacts
    """

    labels: LabelVolume
    structures: Mapping[str, int]
    confidence: Mapping[str, float]
    bones: Mapping[str, BoneFacts]
    facts: SegmentationFacts


class _Scene(NamedTuple):
    """The part of the CT around the knee: smoothed values, where they are bone, whose bone it is, and the grid.

    The owner reaches a little farther than the bone.
    """

    values: Float32
    hard: Mask
    owner: Labels
    parted: Mask
    lps_from_index: Float

    def spacing_mm(self) -> Float:
        return np.asarray(np.linalg.norm(self.lps_from_index[:3, :3], axis=0))


def segment_bones(ct: CtVolume, side: Side, settings: SegmentationSettings | None = None) -> BoneSegmentation:
    """Find the bones of the knee of one side.

    Parameters
    ----------
    ct : CtVolume
        Any order of axes; one leg or both, with or without the table.
    side : "right" or "left"
        Which leg. A single leg of the other side is refused where its fibula shows.
    settings : SegmentationSettings, optional

    Returns
    -------
    BoneSegmentation

    Raises
    ------
    ValueError
        When there is no knee in the CT, or it is that of the other leg: one plain sentence.

    Notes
    -----
    The boundary of bone lies six tenths of the way from soft tissue to the densest bone within 2 mm: at half, a shell
    thinner than the blur would seem too thick. Bones that touch are worn
    down until they come apart; from what is left, a watershed grows back along the densest paths.
    """
    settings = settings or SegmentationSettings()
    ct = in_lps_order(ct)
    found = find_knee(ct, side)
    scene, metal_mm3 = _scene(ct, found, settings)
    masks = {name: _bone(scene, value, settings) for name, value in BONE_LABELS.items() if (scene.owner == value).any()}
    for name in ("femur", "tibia"):
        if name not in masks:
            raise ValueError(f"there is no knee in this CT: its {name} has no clear boundary")
    values = np.zeros(scene.hard.shape, np.uint8)
    for name, mask in masks.items():
        values[mask & (values == 0)] = BONE_LABELS[name]
    bones = {name: _facts(scene, values == BONE_LABELS[name], BONE_LABELS[name]) for name in masks}
    missing = tuple(name for name in BONE_LABELS if name not in masks)
    return BoneSegmentation(
        labels=LabelVolume(values, scene.lps_from_index),
        structures={name: BONE_LABELS[name] for name in masks},
        confidence={name: _confidence(name, facts) for name, facts in bones.items()},
        bones=bones,
        facts=SegmentationFacts(found.knees, found.wear_mm, found.joint_mm, metal_mm3, missing),
    )


def _scene(ct: CtVolume, found: FoundKnee, settings: SegmentationSettings) -> tuple[_Scene, float]:
    """The part of the CT around the knee at full resolution, and the metal in it (mm3)."""
    box = _knee_box(found, _MARGIN_MM, settings.reach_mm)
    low = [edge.start * factor for edge, factor in zip(box, found.factors, strict=True)]
    part = tuple(slice(start, edge.stop * factor) for start, edge, factor in zip(low, box, found.factors, strict=True))
    spacing = ct.spacing_mm
    raw = ct.values[part]
    values = ndimage.gaussian_filter(raw.astype(np.float32), settings.smoothing_mm / spacing)
    level = boundary_hu(values, spacing)
    hard = values > level
    loose = values > SOFT_HU + _LOOSE_FRACTION * (level - SOFT_HU)
    coarse_mm = np.asarray(np.linalg.norm(found.lps_from_index[:3, :3], axis=0))
    nearest = everywhere_nearest(found.regions[box], coarse_mm, _MARGIN_MM / 2)
    disputed = contested(nearest, coarse_mm, _CONTESTED_MM)
    owner, parted, markers = (
        refined(grid, found.factors, hard.shape) for grid in (nearest, disputed, found.markers[box])
    )
    owner = _parted(values, owner, parted > 0, markers)
    owner[~loose | (owner == OTHER)] = 0
    metal = float(np.count_nonzero(raw > METAL_HU) * np.prod(spacing))
    offset = (low[0], low[1], low[2])
    return _Scene(values, hard, owner, parted > 0, shifted_index(ct.lps_from_index, offset)), metal


def _knee_box(found: FoundKnee, margin_mm: float, reach_mm: float) -> tuple[slice, slice, slice]:
    """Box of the search grid that holds the four bones and a margin, cut at a distance above and below the joint."""
    spacing = np.linalg.norm(found.lps_from_index[:3, :3], axis=0)
    mine = (found.regions > 0) & (found.regions != OTHER)
    heights = found.lps_from_index[2, 2] * np.arange(mine.shape[2])
    middle = found.lps_from_index[2, :2] @ ((np.array(mine.shape[:2]) - 1) / 2) + found.lps_from_index[2, 3]
    near = np.abs(heights + middle - found.joint_mm) <= reach_mm
    return widened(box_of(mine & near), int(np.ceil(margin_mm / spacing.min())), mine.shape)


def _parted(values: Float32, owner: Labels, disputed: Mask, markers: Labels) -> Labels:
    """The owner of each voxel, in disputed places by a watershed that floods the densest voxels first."""
    import SimpleITK  # noqa: PLC0415 - a cached run must not load it

    out = owner.copy()
    if not disputed.any():
        return out
    box = widened(box_of(disputed), 3, disputed.shape)
    seeds = np.where(disputed[box], markers[box], owner[box])
    level = SimpleITK.GetImageFromArray(-np.clip(values[box], 0, 1500))
    basins: Any = SimpleITK.MorphologicalWatershedFromMarkers(level, SimpleITK.GetImageFromArray(seeds), False, False)
    flooded = SimpleITK.GetArrayFromImage(basins)
    if flooded.shape != seeds.shape:
        raise ValueError(f"the watershed returned {flooded.shape} voxels for {seeds.shape}")
    out[box] = np.where(disputed[box], flooded, out[box])
    return out


def _bone(scene: _Scene, value: int, settings: SegmentationSettings) -> Mask:
    """(I, J, K) one bone: its hard voxels in one piece, with its inside."""
    mine, spacing = scene.owner == value, scene.spacing_mm()
    box = widened(box_of(mine), 4, mine.shape)
    core = worn(filled(mine[box], settings.closing_mm, spacing), _SURELY_INSIDE_MM, spacing)
    out = np.zeros(mine.shape, dtype=bool)
    out[box] = largest_piece(filled((mine & scene.hard)[box] | core, settings.closing_mm, spacing))
    return out


def _facts(scene: _Scene, mask: Mask, value: int) -> BoneFacts:
    box = widened(box_of(mask), 4, mask.shape)
    spacing, part = scene.spacing_mm(), mask[box]
    voxels = int(np.count_nonzero(mask))
    shell = np.count_nonzero(filled((scene.owner[box] == value) & scene.hard[box] & part, 0.0, spacing) & part)
    return BoneFacts(
        voxels=voxels,
        volume_mm3=voxels * float(np.prod(spacing)),
        cut_mm2=float(border_areas_mm2(mask, spacing).sum()),
        edge_fraction=_edge_fraction(scene.values[box], part, spacing),
        shell_fraction=shell / voxels,
        parted_voxels=int(np.count_nonzero(scene.parted & mask)),
    )


def _edge_fraction(values: Float32, mask: Mask, spacing_mm: Float) -> float:
    """Share of the surface voxels that see a fall of _EDGE_HU within 2 mm."""
    surface = mask & ~ndimage.binary_erosion(mask, border_value=1)
    size = [2 * max(round(2.0 / step), 1) + 1 for step in spacing_mm]
    fall = ndimage.maximum_filter(values, size=size) - ndimage.minimum_filter(values, size=size)
    return float(np.mean(fall[surface] >= _EDGE_HU)) if surface.any() else 0.0


def _confidence(name: str, facts: BoneFacts) -> float:
    low, high = PLAUSIBLE_MM3[name]
    size = min(1.0, facts.volume_mm3 / low, high / facts.volume_mm3)
    return facts.edge_fraction * facts.shell_fraction * size
