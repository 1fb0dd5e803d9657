"""Which parts of a CT are the femur, tibia, patella and fibula of one knee: threshold, separation and naming.

The search works on a CT averaged to voxels of up to 1.6 mm; :mod:`pipeline.adapters.bone_segmentation` then finds the
boundaries on the CT itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.geometry.volume import CtVolume, Mask, averaged, cavities
from pipeline.records import Side

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Labels = NDArray[np.uint8]
Box = tuple[slice, slice, slice]

#: Values of the bones in a segmentation.
BONE_LABELS = {"femur": 1, "tibia": 2, "patella": 3, "fibula": 4}
#: Marks bone that belongs to none of the four: the other leg, the table.
OTHER = 9

#: CT number of the soft tissue that bone borders on.
SOFT_HU = 50.0
#: Where the boundary lies between soft tissue and the densest bone nearby. A shell thinner than the blur never shows
#: its full density, and half-way to what it shows lies outside it; half-way to what it is lies about here.
BOUNDARY_FRACTION = 0.6
#: Bounds of the CT number of the boundary.
BOUNDARY_HU = (180.0, 700.0)
#: Denser than any bone; its blurred edge is this wide.
METAL_HU = 2200.0
_METAL_EDGE_VOXELS = 2
#: The densest bone is looked for this far away: across the cortical shell.
_NEARBY_MM = 2.0

#: The same in the search: first so that bones are whole, then so that they come apart.
_SEARCH_FRACTIONS = (0.5, 0.6)
#: Voxel size of the search, and how far bones are worn down until they come apart.
_SEARCH_MM = 1.6
_SEARCH_CLOSING_MM = 2.0
_WEAR_MM = (0.0, 1.0, 1.6, 2.4, 3.2, 4.2)
#: A piece smaller than this (mm3) is none of the bones; one never as dense as this is a table or a cast.
_SMALLEST_MM3 = 400.0
_DENSE_HU = 350.0
#: Unnamed pieces from this size on (mm3) are bones of their own; smaller ones are crumbs of a bone worn down.
_OWN_BONE_MM3 = 4000.0
#: Part of a long bone next to the joint in which its size is judged.
_END_MM = 30.0
#: Breadth (left to right) and depth of that part of femur and tibia, mm.
_END_BREADTH_MM = (42.0, 115.0)
_END_DEPTH_MM = (24.0, 100.0)


class Piece(NamedTuple):
    """A piece of bone: its number, voxel centres (N, 3) in LPS mm, and volume."""

    number: int
    points: Float
    volume_mm3: float

    def low(self, axis: int) -> float:
        """Smallest coordinate along an LPS axis, mm."""
        return float(self.points[:, axis].min())

    def high(self, axis: int) -> float:
        """Largest coordinate along an LPS axis, mm."""
        return float(self.points[:, axis].max())

    def span(self, axis: int) -> float:
        """Extent along an LPS axis, mm."""
        return self.high(axis) - self.low(axis)

    def centre(self) -> Float:
        """(3,) LPS mm."""
        return np.asarray(self.points.mean(axis=0))

    def within(self, low: float, high: float) -> Piece:
        """The part between two heights (LPS z, mm)."""
        inside = (self.points[:, 2] >= low) & (self.points[:, 2] <= high)
        return Piece(self.number, self.points[inside], self.volume_mm3 * float(inside.mean()))


class Knee(NamedTuple):
    """The pieces that make one knee; patella and fibula may be out of the picture."""

    femur: Piece
    tibia: Piece
    patella: Piece | None
    fibula: Piece | None

    @property
    def joint_mm(self) -> float:
        """LPS z of the joint line."""
        return (self.femur.low(2) + self.tibia.high(2)) / 2

    @property
    def x_mm(self) -> float:
        """LPS x of the knee."""
        return float(self.femur.within(self.femur.low(2), self.femur.low(2) + _END_MM).centre()[0])


@dataclass(frozen=True, eq=False)
class FoundKnee:
    """One knee on the coarse grid of the search.

    Attributes
    ----------
    regions : (I, J, K) uint8
        Values of BONE_LABELS in the bones (OTHER in other bone), 0 elsewhere.
    markers : (I, J, K) uint8
        The same, worn down until the bones come apart.
    lps_from_index : (4, 4) float64
    factors : (int, int, int)
        Voxels of the CT in one voxel of the search, along each axis.
    joint_mm : float
        LPS z of the joint line.
    wear_mm : float
        How far the bones were worn down.
    knees : int
        Knees in the CT.
    """

    regions: Labels
    markers: Labels
    lps_from_index: Float
    factors: tuple[int, int, int]
    joint_mm: float
    wear_mm: float
    knees: int


def boundary_hu(values: Float32, spacing_mm: Float, fraction: float = BOUNDARY_FRACTION) -> Float32:
    """(I, J, K) CT number a fraction of the way from soft tissue to the densest bone nearby, within BOUNDARY_HU.

    A fixed number low enough for thin shells would put the boundary outside thick ones. Metal is no bone.
    """
    size = _window(_NEARBY_MM, spacing_mm)
    metal = values > METAL_HU
    if metal.any():
        values = np.where(ndimage.binary_dilation(metal, iterations=_METAL_EDGE_VOXELS), np.float32(SOFT_HU), values)
    peak = ndimage.maximum_filter(values, size=size)
    level = np.float32(SOFT_HU) + np.float32(fraction) * (peak - np.float32(SOFT_HU))
    return np.asarray(np.clip(level, BOUNDARY_HU[0], BOUNDARY_HU[1]), dtype=np.float32)


def filled(mask: Mask, closing_mm: float, spacing_mm: Float) -> Mask:
    """A shell of bone with its inside, also where the border of the array cuts it open.

    Parameters
    ----------
    mask : (I, J, K) bool
        One bone.
    closing_mm : float
        Gaps in the shell up to about twice this do not open it.
    spacing_mm : (3,) float64
    """
    closed = _closed(mask, closing_mm, spacing_mm)
    core = _enclosed(closed)
    out = mask | core
    if closing_mm > 0 and core.any():
        # what the closing added to the inside of the shell, and not to the outside
        steps = int(np.ceil(closing_mm / spacing_mm.min())) + 1
        out |= ndimage.binary_dilation(core, iterations=steps, mask=closed & ~mask)
    return np.asarray(out | _enclosed(out))


def _enclosed(mask: Mask) -> Mask:
    """What a mask encloses in space, or in the slices across at least two of the axes; its cuts count as closed.

    One direction would not do: the rim of the tibial plateau encloses its dish in axial slices.
    """
    whole = mask.copy()
    for axis in range(3):
        for end in (0, -1):
            face: list[slice | int] = [slice(None)] * 3
            face[axis] = end
            whole[tuple(face)] |= ndimage.binary_fill_holes(whole[tuple(face)])
    votes = sum(_enclosed_in_slices(whole, axis).astype(np.uint8) for axis in range(3))
    return np.asarray((cavities(whole) | (np.asarray(votes) >= 2) | whole) & ~mask)


def _enclosed_in_slices(mask: Mask, axis: int) -> Mask:
    """What a mask encloses in each slice across an axis."""
    flat = ndimage.generate_binary_structure(3, 1)
    flat[tuple([0, 2] if other == axis else 1 for other in range(3))] = False
    numbers, count = ndimage.label(~mask, flat)
    enclosed = np.ones(count + 1, dtype=bool)
    for other in range(3):
        if other != axis:
            enclosed[np.unique(numbers.take([0, -1], other))] = False
    enclosed[0] = False
    return np.asarray(enclosed[numbers])


def _closed(mask: Mask, closing_mm: float, spacing_mm: Float) -> Mask:
    """Morphological closing by a cube."""
    if closing_mm <= 0:
        return mask
    size = _window(closing_mm, spacing_mm)
    padded = np.pad(mask.view(np.uint8), [(width // 2, width // 2) for width in size])
    closed = ndimage.minimum_filter(ndimage.maximum_filter(padded, size=size), size=size)
    return np.asarray(closed[tuple(slice(width // 2, -(width // 2)) for width in size)] > 0)


def worn(mask: Mask, depth_mm: float, spacing_mm: Float) -> Mask:
    """A mask without what lies less than a depth below its surface (by a cube); the border of the array is inside."""
    return np.asarray(
        ndimage.minimum_filter(mask.view(np.uint8), size=_window(depth_mm, spacing_mm), mode="nearest") > 0
    )


def _window(reach_mm: float, spacing_mm: Float) -> tuple[int, int, int]:
    """Voxels of a cube that reaches about so far to every side, at least one voxel."""
    i, j, k = (2 * max(round(reach_mm / step), 1) + 1 for step in spacing_mm)
    return i, j, k


def largest_piece(mask: Mask) -> Mask:
    """The largest piece, voxels joined by faces.

    Raises
    ------
    ValueError
        When the mask is empty.
    """
    numbers, count = ndimage.label(mask)
    if count == 0:
        raise ValueError("an empty mask has no pieces")
    return np.asarray(numbers == 1 + int(np.argmax(np.bincount(numbers.ravel())[1:])))


def find_knee(ct: CtVolume, side: Side) -> FoundKnee:
    """Find the knee of one side and tell its bones apart, roughly.

    Parameters
    ----------
    ct : CtVolume
        Index axes near +L, +P, +S.
    side : "right" or "left"
        Which of two legs; for a single leg it must be that of the leg.

    Returns
    -------
    FoundKnee

    Raises
    ------
    ValueError
        When there is no bone, no knee, or the leg is that of the other side.
    """
    values, matrix, factors = averaged(ct, _SEARCH_MM)
    spacing = np.asarray(np.linalg.norm(matrix[:3, :3], axis=0))
    best: _Parting | None = None
    for fraction in _SEARCH_FRACTIONS:
        solid = _solid(values, spacing, fraction)
        parting = _part(solid, matrix, side)
        if parting is not None and (best is None or parting.bones() > best.bones()):
            best = parting
        if best is not None and best.bones() == len(BONE_LABELS):
            break
    if best is None:
        raise ValueError(_no_knee(values, solid))
    regions = np.where(best.solid, _nearest(best.markers, spacing), 0).astype(np.uint8)
    return FoundKnee(regions, best.markers, matrix, factors, best.knee.joint_mm, best.wear_mm, best.knees)


class _Parting(NamedTuple):
    """Bones come apart: the bone they were in, their markers, the knee as first seen, wear, and how many knees."""

    solid: Mask
    markers: Labels
    knee: Knee
    wear_mm: float
    knees: int

    def bones(self) -> int:
        return len(set(np.unique(self.markers)) & set(BONE_LABELS.values()))


def _part(solid: Mask, matrix: Float, side: Side) -> _Parting | None:
    """Wear bone down until the bones of one knee come apart; None where there is no knee."""
    spacing = np.asarray(np.linalg.norm(matrix[:3, :3], axis=0))
    depth = ndimage.distance_transform_edt(np.pad(solid, 1, mode="edge"), sampling=spacing)[1:-1, 1:-1, 1:-1]
    out: _Parting | None = None
    markers = np.zeros(solid.shape, np.uint8)
    for wear_mm in _WEAR_MM:
        numbers, _ = ndimage.label(depth > wear_mm)
        knees = knees_of(_pieces(numbers, matrix))
        knee = chosen_knee(knees, side)
        if knee is not None and _names(knee) - set(np.unique(markers)):
            _check_side(knee, side)
            markers = _with_worn(markers, knee, numbers, _OWN_BONE_MM3 / float(np.prod(spacing)))
            out = _Parting(solid, markers, out.knee if out else knee, wear_mm, max(len(knees), out.knees if out else 0))
        if out is not None and out.bones() == len(BONE_LABELS):
            break
    return out


def _names(knee: Knee) -> set[int]:
    return {BONE_LABELS[name] for name, bone in knee._asdict().items() if bone is not None}


def _with_worn(markers: Labels, knee: Knee, numbers: NDArray[np.integer], own_voxels: float) -> Labels:
    """The markers with those of bones more worn down; a slender bone that is worn away by now keeps its earlier one."""
    large = np.bincount(numbers.ravel()) >= own_voxels
    large[0] = False
    out = np.where(large[numbers], OTHER, 0).astype(np.uint8)
    for value in set(BONE_LABELS.values()) - _names(knee):
        out[markers == value] = value
    for name, bone in knee._asdict().items():
        if bone is not None:
            out[numbers == bone.number] = BONE_LABELS[name]
    return out


def _solid(values: Float32, spacing_mm: Float, fraction: float) -> Mask:
    """Bone with what it encloses, each connected piece for itself; not what is too small, or no denser than a table."""
    hard = values > boundary_hu(values, spacing_mm, fraction)
    numbers, _ = ndimage.label(hard)
    sizes = np.bincount(numbers.ravel()) * float(np.prod(spacing_mm))
    solid = np.zeros(hard.shape, dtype=bool)
    for number, box in enumerate(ndimage.find_objects(numbers), start=1):
        if box is None or sizes[number] < _SMALLEST_MM3:
            continue
        around = widened(box, 2, numbers.shape)
        piece = numbers[around] == number
        if np.percentile(values[around][piece], 95) >= _DENSE_HU:
            solid[around] |= filled(piece, _SEARCH_CLOSING_MM, spacing_mm)
    return solid


def _pieces(numbers: NDArray[np.integer], matrix: Float) -> list[Piece]:
    """Pieces of the size of a bone."""
    voxel = float(abs(np.linalg.det(matrix[:3, :3])))
    sizes = np.bincount(numbers.ravel()) * voxel
    out = []
    for number, box in enumerate(ndimage.find_objects(numbers), start=1):
        if box is not None and sizes[number] >= _SMALLEST_MM3:
            index = np.argwhere(numbers[box] == number) + [edge.start for edge in box]
            out.append(Piece(number, index @ matrix[:3, :3].T + matrix[:3, 3], float(sizes[number])))
    return out


def knees_of(bones: Sequence[Piece]) -> tuple[Knee, ...]:
    """Every knee that pieces of bone make: a wide end above a wide end, and the small bones that go with them."""
    ends = [bone for bone in bones if bone.span(2) >= 38.0]
    pairs = [(upper, lower) for upper in ends for lower in ends if _meet_as_in_a_knee(upper, lower)]
    pairs.sort(key=lambda pair: -_end(pair[0], upper=False).volume_mm3 * _end(pair[1], upper=True).volume_mm3)
    knees: list[Knee] = []
    used: set[int] = set()
    for femur, tibia in pairs:
        if not used & {femur.number, tibia.number}:
            rest = [bone for bone in bones if bone.number not in (femur.number, tibia.number)]
            patella = _patella(femur, rest)
            fibula = _fibula(tibia, [bone for bone in rest if patella is None or bone.number != patella.number])
            knees.append(Knee(femur, tibia, patella, fibula))
            used |= {femur.number, tibia.number}
    return tuple(knees)


def chosen_knee(knees: Sequence[Knee], side: Side) -> Knee | None:
    """The knee of a side: of several, the one farthest to that side of the patient; None where there is none."""
    if not knees:
        return None
    return min(knees, key=lambda knee: knee.x_mm if side == "right" else -knee.x_mm)


def _end(bone: Piece, *, upper: bool) -> Piece:
    edge = bone.high(2) if upper else bone.low(2)
    return bone.within(edge - _END_MM, edge) if upper else bone.within(edge, edge + _END_MM)


def _meet_as_in_a_knee(upper: Piece, lower: Piece) -> bool:
    """Whether two bones could be femur and tibia: ends of the right size that face each other, and then taper."""
    if upper.number == lower.number or not -25.0 <= upper.low(2) - lower.high(2) <= 30.0:
        return False
    ends = _end(upper, upper=False), _end(lower, upper=True)
    apart = np.linalg.norm((ends[0].centre() - ends[1].centre())[:2])
    sizes = all(
        _END_BREADTH_MM[0] <= end.span(0) <= _END_BREADTH_MM[1] and _END_DEPTH_MM[0] <= end.span(1) <= _END_DEPTH_MM[1]
        for end in ends
    )
    return bool(apart <= 35.0 and sizes)


def _patella(femur: Piece, bones: Sequence[Piece]) -> Piece | None:
    """The small bone in front of the femur's end."""
    end = _end(femur, upper=False).centre()
    front = [
        bone
        for bone in bones
        if bone.volume_mm3 <= 60_000.0
        and bone.span(2) <= 75.0
        and 15.0 <= end[1] - bone.centre()[1] <= 80.0
        and abs(bone.centre()[0] - end[0]) <= 40.0
        and -45.0 <= bone.centre()[2] - femur.low(2) <= 90.0
    ]
    return max(front, key=lambda bone: bone.volume_mm3, default=None)


def _fibula(tibia: Piece, bones: Sequence[Piece]) -> Piece | None:
    """The slender bone beside the tibia."""
    beside = []
    for bone in bones:
        level = tibia.within(bone.low(2), bone.high(2))
        if not len(level.points) or bone.high(2) > tibia.high(2) + 5.0:
            continue
        way = bone.centre() - level.centre()
        if 8.0 <= abs(way[0]) <= 60.0 and -15.0 <= way[1] <= 50.0 and bone.volume_mm3 < 0.6 * tibia.volume_mm3:
            beside.append(bone)
    return max(beside, key=lambda bone: bone.volume_mm3, default=None)


def _check_side(knee: Knee, side: Side) -> None:
    """Raise when the fibula lies on the inner side of the tibia: then the leg is not of the side that was declared."""
    if knee.fibula is None:
        return
    level = knee.tibia.within(knee.fibula.low(2), knee.fibula.high(2))
    way = float(knee.fibula.centre()[0] - level.centre()[0])
    lateral = -way if side == "right" else way
    if lateral < 0:
        other = "left" if side == "right" else "right"
        raise ValueError(
            f"the leg is declared as the {side} one, but its fibula lies {-lateral:.0f} mm to the inner side of the "
            f"tibia: this is a {other} leg, or the CT is mirrored"
        )


def _no_knee(values: Float32, solid: Mask) -> str:
    if not solid.any():
        return f"there is no knee in this CT: nothing in it is as dense as bone (highest mean {values.max():.0f} HU)"
    return (
        "there is no knee in this CT: among its bones there are no two whose broad ends face each other from above and "
        f"below, {_END_BREADTH_MM[0]:.0f} to {_END_BREADTH_MM[1]:.0f} mm broad, as those of femur and tibia do"
    )


def _nearest(markers: Labels, spacing_mm: Float) -> Labels:
    """(I, J, K) the marker nearest to each voxel."""
    index = ndimage.distance_transform_edt(
        markers == 0, sampling=spacing_mm, return_distances=False, return_indices=True
    )
    return np.asarray(markers[tuple(index)])


def widened(box: tuple[slice, ...], margin: int, shape: tuple[int, ...]) -> Box:
    """A box and some voxels around it, as far as the array reaches."""
    i, j, k = (
        slice(max(edge.start - margin, 0), min(edge.stop + margin, n)) for edge, n in zip(box, shape, strict=True)
    )
    return i, j, k


def contested(regions: Labels, spacing_mm: Float, reach_mm: float) -> Mask:
    """(I, J, K) where two different bones are both within reach: there the nearest bone is not surely the right one."""
    size = _window(reach_mm, spacing_mm)
    high = ndimage.maximum_filter(regions, size=size)
    low = ndimage.minimum_filter(np.where(regions > 0, regions, np.uint8(255)), size=size)
    return np.asarray((high > 0) & (low < high))


def everywhere_nearest(regions: Labels, spacing_mm: Float, reach_mm: float) -> Labels:
    """The region nearest to each voxel, 0 where none is within reach."""
    away, index = ndimage.distance_transform_edt(regions == 0, sampling=spacing_mm, return_indices=True)
    return np.where(away <= reach_mm, regions[tuple(index)], 0).astype(np.uint8)


def refined(
    values: NDArray[np.uint8] | Mask, factors: tuple[int, int, int], shape: tuple[int, ...]
) -> NDArray[np.uint8]:
    """Values of a coarse grid on the fine one, each repeated over its block."""
    out = np.asarray(values, dtype=np.uint8)
    for axis, factor in enumerate(factors):
        out = np.repeat(out, factor, axis=axis)
    return out[: shape[0], : shape[1], : shape[2]]
