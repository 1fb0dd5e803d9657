"""A CT made from a label map: what a scanner might have shown of bones whose shape is known exactly.

Not a CT of a person, and called synthetic wherever it appears. Each voxel is the mean of the tissue in it, seen through
a Gaussian point spread: bone with a cortical shell, cancellous bone and marrow, in a leg of muscle and fat, in air.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from pipeline.geometry.volume import CtVolume, LabelVolume, Mask, box_of
from pipeline.records import Side, Vector

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

AIR_HU, FAT_HU, MUSCLE_HU, CARTILAGE_HU = -1000.0, -100.0, 50.0, 75.0
MARROW_HU, CANCELLOUS_HU, CORTICAL_HU = 50.0, 300.0, 1200.0
TABLE_HU, METAL_HU = 200.0, 3071.0
#: What a CT can hold.
RANGE_HU = (-1024, 3071)

#: Bone is epiphysis this close to the level of the joint, and shaft beyond the second number (mm).
_SHAFT_BEGINS_MM = (35.0, 65.0)
#: Grid on which the leg's outline and the texture of cancellous bone are made.
_COARSE_MM = 3.0
#: How much the leg's outline is rounded off.
_OUTLINE_BLUR_MM = 6.0
#: Noise of neighbouring voxels of a slice hangs together a little: Gaussian, in voxels.
_NOISE_BLUR_VOXELS = 0.5
_TABLE_GAP_MM = 1.0

#: Sane range of the numbers of a :class:`SyntheticCtSpec`.
_RANGES = {
    "spacing_mm": (0.2, 5.0),
    "blur_mm": (0.0, 3.0),
    "noise_hu": (0.0, 500.0),
    "shell_mm": (0.0, 5.0),
    "shaft_shell_mm": (0.0, 10.0),
    "texture_hu": (0.0, 200.0),
    "muscle_mm": (3.0, 60.0),
    "fat_mm": (0.0, 40.0),
    "air_mm": (2.0, 100.0),
    "table_mm": (0.0, 40.0),
    "metal_mm": (-5000.0, 5000.0),
    "metal_radius_mm": (0.0, 20.0),
}


@dataclass(frozen=True)
class SyntheticCtSpec:
    """How the scan is made.

    Attributes
    ----------
    spacing_mm : (i, j, k)
        Voxel size of the CT.
    blur_mm : float
        Standard deviation of the point spread, on top of the mean over each voxel.
    noise_hu : float
        Standard deviation of the noise.
    shell_mm, shaft_shell_mm : float
        Thickness of the cortical shell near the joint and along the shaft.
    texture_hu : float
        Standard deviation of the slow unevenness of cancellous bone.
    muscle_mm, fat_mm : float
        Layers around the labelled structures.
    air_mm : float
        Air beside the leg.
    table_mm : float
        Thickness of the patient table behind the leg; 0 for none.
    other_leg : "right", "left" or None
        Which leg to add beside the given one, as its mirror image.
    metal_mm : (x, y, z) or None
        Centre of a metal ball, LPS mm.
    metal_radius_mm : float
    seed : int
        Of noise and texture.

    Raises
    ------
    ValueError
        When a number is not finite or outside its range.
    """

    spacing_mm: Vector = (0.7, 0.7, 0.7)
    blur_mm: float = 0.5
    noise_hu: float = 15.0
    shell_mm: float = 0.8
    shaft_shell_mm: float = 3.0
    texture_hu: float = 40.0
    muscle_mm: float = 15.0
    fat_mm: float = 8.0
    air_mm: float = 8.0
    table_mm: float = 0.0
    other_leg: Side | None = None
    metal_mm: Vector | None = None
    metal_radius_mm: float = 4.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.other_leg not in ("right", "left", None):
            raise ValueError(f"other_leg: expected right, left or None, got {self.other_leg!r}")
        if self.seed < 0:
            raise ValueError(f"seed: expected 0 or more, got {self.seed}")
        for name in (field.name for field in fields(self) if field.name in _RANGES):
            value, (low, high) = getattr(self, name), _RANGES[name]
            for number in value if isinstance(value, tuple) else (value,):
                if number is not None and not (math.isfinite(number) and low <= number <= high):
                    raise ValueError(f"{name}: expected {low:g} to {high:g}, got {number!r}")


class _Grid(NamedTuple):
    """Voxels of a box: how many, and where their centres lie."""

    shape: tuple[int, int, int]
    lps_from_index: Float

    def spacing_mm(self) -> Float:
        """(3,) voxel size."""
        return np.asarray(np.linalg.norm(self.lps_from_index[:3, :3], axis=0))

    def coordinate(self, axis: int) -> Float32:
        """(I, J, K) one LPS coordinate of every centre, mm."""
        i, j, k = (
            (np.arange(n) * step).astype(np.float32)
            for n, step in zip(self.shape, self.lps_from_index[axis, :3], strict=True)
        )
        return np.asarray(i[:, None, None] + j[:, None] + k + np.float32(self.lps_from_index[axis, 3]))


def synthetic_ct(labels: LabelVolume, bones: Mapping[str, int], spec: SyntheticCtSpec) -> CtVolume:
    """The CT that a label map might have come from.

    Parameters
    ----------
    labels : LabelVolume
        Index axes near +L, +P, +S. Labels that are no bone become cartilage. What the last axis' ends cut stays cut.
    bones : mapping of str to int
        Bone name -> label value. The level of the joint, from which shafts are told, is that between ``femur`` and
        ``tibia``; without them all bone is epiphysis.
    spec : SyntheticCtSpec

    Returns
    -------
    CtVolume
        int16, -1024 to 3071 HU, on a grid parallel to that of the labels and wider by the leg and the air beside it.

    Raises
    ------
    ValueError
        When no voxel has the label of a bone.
    """
    if not any((labels.values == value).any() for value in bones.values()):
        raise ValueError("expected at least one bone in the label map, found none")
    grid = _ct_grid(labels, spec)
    source = _Grid(_shape(labels.values), labels.lps_from_index)
    away_mm = _distance_from_leg(labels, grid)
    values = _above_muscle(labels, bones, spec)
    values = _separable(values, [_cell_weights(source, grid, axis, spec.blur_mm) for axis in range(3)])
    values += _soft_tissue(away_mm, spec)
    if spec.metal_mm is not None:
        _add_metal(values, grid, spec.metal_mm, spec.metal_radius_mm)
    if spec.other_leg is not None:
        values, away_mm, grid = _with_mirror_image(values, away_mm, grid, spec.other_leg)
    if spec.table_mm > 0:
        _add_table(values, away_mm, grid, spec)
    _add_noise(values, spec)
    low, high = RANGE_HU
    return CtVolume(np.clip(np.rint(values), low, high).astype(np.int16), grid.lps_from_index)


def truth_on(labels: LabelVolume, ct: CtVolume) -> LabelVolume:
    """The labels on the grid of a CT that is parallel to theirs: of the nearest voxel centre, 0 outside the label map.

    Raises
    ------
    ValueError
        When the two grids are not parallel.
    """
    index_from_index = np.linalg.inv(labels.lps_from_index) @ ct.lps_from_index
    steps = np.diag(index_from_index)[:3]
    if not np.allclose(index_from_index[:3, :3], np.diag(steps), atol=1e-6):
        raise ValueError("the label map and the CT are not parallel")
    out = np.zeros(ct.values.shape, labels.values.dtype)
    nearest = [
        np.rint(np.arange(n) * step + start).astype(int)
        for n, step, start in zip(ct.values.shape, steps, index_from_index[:3, 3], strict=True)
    ]
    here = [(index >= 0) & (index < n) for index, n in zip(nearest, labels.values.shape, strict=True)]
    out[np.ix_(*here)] = labels.values[np.ix_(*(index[inside] for index, inside in zip(nearest, here, strict=True)))]
    return LabelVolume(out, ct.lps_from_index)


def _ct_grid(labels: LabelVolume, spec: SyntheticCtSpec) -> _Grid:
    """The grid of the CT: as long as the label map along k, wider along i and j by the leg, the air and the table."""
    spacing, old = np.asarray(spec.spacing_mm), labels.spacing_mm
    box = box_of(np.asarray(labels.values) != 0)
    low = np.array([box[0].start, box[1].start, 0]) - 0.5
    high = np.array([box[0].stop, box[1].stop, labels.values.shape[2]]) - 0.5
    around = spec.muscle_mm + spec.fat_mm + spec.air_mm
    low_mm = low * old - [around, around, 0.0]
    high_mm = high * old + [around, around + spec.table_mm, 0.0]
    counts = np.maximum(np.floor((high_mm - low_mm) / spacing + 1e-6).astype(int), 1)
    middle = (low_mm + high_mm) / 2 - (counts - 1) / 2 * spacing
    matrix = labels.lps_from_index.copy()
    matrix[:3, :3] *= spacing / old
    matrix[:3, 3] += labels.lps_from_index[:3, :3] @ (middle / old)
    return _Grid((int(counts[0]), int(counts[1]), int(counts[2])), matrix)


def _above_muscle(labels: LabelVolume, bones: Mapping[str, int], spec: SyntheticCtSpec) -> Float32:
    """(I, J, K) how much denser than muscle each labelled voxel is, HU; 0 where nothing is labelled."""
    values = np.asarray(labels.values)
    out = np.where(values != 0, np.float32(CARTILAGE_HU - MUSCLE_HU), np.float32(0))
    shaft = _shaft_share(labels, bones)
    texture = _texture(labels, spec)
    for name, value in bones.items():
        mask = values == value
        if not mask.any():
            continue
        box = _wider(box_of(mask), mask.shape)
        part = np.zeros_like(shaft[box]) if name == "patella" else shaft[box]
        density = _bone_hu(mask[box], part, labels.spacing_mm, spec) - np.float32(MUSCLE_HU)
        out[box] = np.where(mask[box], density + texture[box] * (1 - part), out[box])
    return out


def _bone_hu(mask: Mask, shaft: Float32, spacing_mm: Float, spec: SyntheticCtSpec) -> Float32:
    """CT numbers in one bone: shell by depth below the surface (each voxel by its share), then cancellous or marrow."""
    voxel = float(np.cbrt(np.prod(spacing_mm)))
    depth = ndimage.distance_transform_edt(mask, sampling=spacing_mm).astype(np.float32)
    thickness = np.float32(spec.shell_mm) + np.float32(spec.shaft_shell_mm - spec.shell_mm) * shaft
    # centres lie half a voxel deeper than the surface between voxels; a voxel spans half a voxel to both sides
    shell = np.clip((thickness - (depth - np.float32(voxel))) / np.float32(voxel), 0, 1)
    inner = np.float32(CANCELLOUS_HU) + np.float32(MARROW_HU - CANCELLOUS_HU) * shaft
    return np.asarray(inner + (np.float32(CORTICAL_HU) - inner) * shell, dtype=np.float32)


def _shaft_share(labels: LabelVolume, bones: Mapping[str, int]) -> Float32:
    """(I, J, K) 0 near the joint, 1 along the shafts."""
    values = np.asarray(labels.values)
    femur, tibia = (values == bones.get(name, 0) for name in ("femur", "tibia"))
    if not {"femur", "tibia"} <= set(bones) or not femur.any() or not tibia.any():
        return np.zeros(values.shape, np.float32)
    height = _Grid(_shape(values), labels.lps_from_index).coordinate(2)
    joint = (height[femur].min() + height[tibia].max()) / 2
    begin, end = _SHAFT_BEGINS_MM
    return np.asarray(
        np.clip((np.abs(height - joint) - np.float32(begin)) / np.float32(end - begin), 0, 1), dtype=np.float32
    )


def _texture(labels: LabelVolume, spec: SyntheticCtSpec) -> Float32:
    """(I, J, K) slow unevenness with the standard deviation asked for, HU."""
    fine = _Grid(_shape(labels.values), labels.lps_from_index)
    coarse = _coarse(fine)
    random = np.random.default_rng([spec.seed, 1]).standard_normal(coarse.shape, dtype=np.float32)
    smooth = ndimage.gaussian_filter(random, 1.0)
    smooth *= np.float32(spec.texture_hu) / max(float(smooth.std()), 1e-6)
    return _separable(smooth, [_linear_weights(coarse, fine, axis) for axis in range(3)])


def _distance_from_leg(labels: LabelVolume, grid: _Grid) -> Float32:
    """(I, J, K) rounded distance of the CT's voxels from the labelled structures, mm."""
    coarse = _coarse(grid)
    index = np.argwhere(np.asarray(labels.values)[::2, ::2, ::2] != 0) * 2
    coarse_from_index = np.linalg.inv(coarse.lps_from_index) @ labels.lps_from_index
    cell = np.rint(index @ coarse_from_index[:3, :3].T + coarse_from_index[:3, 3]).astype(int)
    leg = np.zeros(coarse.shape, dtype=bool)
    leg[tuple(np.clip(cell, 0, np.array(coarse.shape) - 1).T)] = True
    spacing = coarse.spacing_mm()
    away = ndimage.distance_transform_edt(~leg, sampling=spacing).astype(np.float32)
    away = ndimage.gaussian_filter(away, _OUTLINE_BLUR_MM / spacing, mode="nearest")
    return _separable(away, [_linear_weights(coarse, grid, axis) for axis in range(3)])


def _soft_tissue(away_mm: Float32, spec: SyntheticCtSpec) -> Float32:
    """CT numbers of muscle, fat and air by distance; the layers pass into one another over a voxel."""
    out = np.full_like(away_mm, MUSCLE_HU)
    width = np.float32(np.cbrt(np.prod(spec.spacing_mm)))
    for edge, step in (
        (spec.muscle_mm, FAT_HU - MUSCLE_HU),
        (spec.muscle_mm + spec.fat_mm, AIR_HU - FAT_HU),
    ):
        out += np.float32(step) * np.clip((away_mm - np.float32(edge)) / width + np.float32(0.5), 0, 1)
    return out


def _with_mirror_image(values: Float32, away_mm: Float32, grid: _Grid, side: Side) -> tuple[Float32, Float32, _Grid]:
    """The volume and its mirror image beside it: a left leg at the end of larger i, a right one before index 0."""
    order = (1, -1) if side == "left" else (-1, 1)
    both, away = (np.concatenate([part[::step] for step in order]) for part in (values, away_mm))
    matrix = grid.lps_from_index.copy()
    if side == "right":
        matrix[:3, 3] -= matrix[:3, 0] * grid.shape[0]
    return both, away, _Grid(_shape(both), matrix)


def _add_table(values: Float32, away_mm: Float32, grid: _Grid, spec: SyntheticCtSpec) -> None:
    """Put a flat slab, square to the grid as in a scanner, behind the leg, in place."""
    behind = np.flatnonzero((away_mm < spec.muscle_mm + spec.fat_mm).any(axis=(0, 2)))
    step = float(grid.spacing_mm()[1])
    middle = behind[-1] * step + _TABLE_GAP_MM + spec.table_mm / 2
    from_middle = np.abs(np.arange(grid.shape[1]) * step - middle)
    share = np.clip((spec.table_mm / 2 - from_middle) / step + 0.5, 0, 1).astype(np.float32)[:, None]
    values += share * (np.float32(TABLE_HU) - values)


def _add_metal(values: Float32, grid: _Grid, centre_mm: Vector, radius_mm: float) -> None:
    """Put a metal ball into the volume, in place."""
    square = sum((grid.coordinate(axis) - np.float32(centre)) ** 2 for axis, centre in enumerate(centre_mm))
    values[np.asarray(square) < radius_mm**2] = METAL_HU


def _add_noise(values: Float32, spec: SyntheticCtSpec) -> None:
    """Add noise in place, slice by slice, alike in every run."""
    random = np.random.default_rng([spec.seed, 2])
    for k in range(values.shape[2] if spec.noise_hu > 0 else 0):
        noise = random.standard_normal(values.shape[:2], dtype=np.float32)
        noise = ndimage.gaussian_filter(noise, _NOISE_BLUR_VOXELS, mode="wrap")
        values[:, :, k] += np.float32(spec.noise_hu / _noise_left()) * noise


def _noise_left() -> float:
    """Standard deviation of unit noise after the blur within a slice."""
    point = np.zeros((15, 15))
    point[7, 7] = 1.0
    return float(np.sqrt((ndimage.gaussian_filter(point, _NOISE_BLUR_VOXELS) ** 2).sum()))


def _coarse(fine: _Grid) -> _Grid:
    """A grid over the same box with voxels of about _COARSE_MM, its outer centres on the outer centres of the box."""
    length = fine.spacing_mm() * (np.array(fine.shape) - 1)
    counts = np.maximum(np.ceil(length / _COARSE_MM).astype(int), 1) + 1
    matrix = fine.lps_from_index.copy()
    matrix[:3, :3] *= np.maximum(np.array(fine.shape) - 1, 1) / (counts - 1)
    return _Grid((int(counts[0]), int(counts[1]), int(counts[2])), matrix)


def _linear_weights(coarse: _Grid, fine: _Grid, axis: int) -> Float32:
    """(fine, coarse) weights of linear interpolation between two grids with the same outer centres."""
    place = np.linspace(0.0, coarse.shape[axis] - 1, fine.shape[axis])
    return np.asarray(
        np.maximum(1 - np.abs(place[:, None] - np.arange(coarse.shape[axis])), 0).astype(np.float32), dtype=np.float32
    )


def _cell_weights(source: _Grid, target: _Grid, axis: int, blur_mm: float) -> Float32:
    """(target, source) share of each source voxel in the blurred mean over each target voxel, along one axis.

    The volume goes on beyond its ends along k, so that cut shafts stay cut; along i and j it ends.
    """
    old, new = source.spacing_mm()[axis], target.spacing_mm()[axis]
    start = (np.linalg.inv(source.lps_from_index) @ target.lps_from_index)[axis, 3] * old
    centres = start + np.arange(target.shape[axis]) * new
    edges = (np.arange(source.shape[axis] + 1) - 0.5) * old
    if axis == 2:
        far = 20 * (blur_mm + new) + old
        edges[[0, -1]] += [-far, far]
    reach = edges[None] - centres[:, None]
    below = (_ramp(reach + new / 2, blur_mm) - _ramp(reach - new / 2, blur_mm)) / new
    return np.asarray(np.diff(below, axis=1), dtype=np.float32)


def _ramp(x: Float, blur: float) -> Float:
    """Integral of the Gaussian distribution function: max(x, 0), rounded off by the blur."""
    if blur == 0:
        return np.maximum(x, 0.0)
    return np.asarray(x * special.ndtr(x / blur) + blur * np.exp(-0.5 * (x / blur) ** 2) / math.sqrt(2 * math.pi))


def _separable(values: Float32, weights: list[Float32]) -> Float32:
    """The values after one (new, old) matrix along each axis."""
    return reduce(
        lambda part, step: np.moveaxis(np.tensordot(step[1], part, axes=(1, step[0])), 0, step[0]),
        enumerate(weights),
        values,
    )


def _wider(box: tuple[slice, slice, slice], shape: tuple[int, ...]) -> tuple[slice, slice, slice]:
    """A box and one voxel around it, as far as the array reaches."""
    i, j, k = (slice(max(edge.start - 1, 0), min(edge.stop + 1, n)) for edge, n in zip(box, shape, strict=True))
    return i, j, k


def _shape(values: NDArray[np.generic]) -> tuple[int, int, int]:
    return values.shape[0], values.shape[1], values.shape[2]
