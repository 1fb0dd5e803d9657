"""One leg of a label map that holds both: which pieces are whose, and that they fit one another."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.volume import LabelVolume, box_of, pieces
from pipeline.records import Side

Float = NDArray[np.float64]

#: Bones whose large pieces say how many legs there are.
LONG_BONES = ("femur", "tibia")
#: A piece this large, as a share of the largest of its structure, may be the same bone of the other leg.
COMPARABLE_FRACTION = 0.25
#: Two legs are at least this far apart from left to right, mm.
APART_MM = 40.0
#: Bones of one knee are nearer to each other by this than bones of two legs, mm.
CLEARLY_NEARER_MM = 5.0
#: A fibula less than this to one side of its tibia tells nothing, mm.
BESIDE_MM = 8.0
#: Distances between bones are measured between voxels about this far apart, mm.
_STEP_MM = 2.0


class _Legs(NamedTuple):
    """Voxel centres (N, 3), LPS mm, of the long bones of the declared side, and of those of the other side."""

    mine: dict[str, Float]
    other: dict[str, Float]


def one_leg(volume: LabelVolume, structures: Mapping[str, int], side: Side) -> tuple[LabelVolume, tuple[str, ...]]:
    """Take the leg of one side out of a label map that may hold two.

    Parameters
    ----------
    volume : LabelVolume
        Index axes near +L, +P, +S.
    structures : mapping of str to int
        Structure name -> value; each has voxels.
    side : "right" or "left"
        The patient's; the right leg has the smaller LPS x.

    Returns
    -------
    volume : LabelVolume
        On the same grid; the given one where femur and tibia are one large piece each.
    left_out : tuple of str
        Structures of which something of the other leg was taken away; empty where there is one leg.

    Raises
    ------
    ValueError
        Where there is more than one leg and it cannot be told which pieces belong to the declared one.

    Notes
    -----
    A piece of any structure belongs to the leg whose femur or tibia lies nearest to its centre. Two legs are nearly
    mirror images: a mirrored volume of both shows only where names or bones contradict one another.
    """
    thinned = _thinned(volume)
    bodies = {name: parts for name in LONG_BONES if (parts := _bodies(thinned, structures.get(name)))}
    if max(map(len, bodies.values()), default=0) < 2:
        return volume, ()
    legs = _told_apart(bodies, side)
    values = np.array(volume.values)
    out = LabelVolume(values, volume.lps_from_index)
    left_out = tuple(name for name, number in structures.items() if _take_away(out, number, legs))
    _check_fibula(_thinned(out), structures, side)
    return out, left_out


def _thinned(volume: LabelVolume) -> LabelVolume:
    """Voxels of a volume about _STEP_MM apart, which is enough to see which bone is where."""
    step = np.maximum(np.round(_STEP_MM / volume.spacing_mm), 1).astype(int)
    values = np.asarray(volume.values)[tuple(slice(None, None, int(n)) for n in step)]
    return LabelVolume(values, volume.lps_from_index * [*step, 1.0])


def _bodies(volume: LabelVolume, number: int | None) -> list[Float]:
    """Voxel centres of each large piece of a structure, from the patient's right to the left."""
    mask = np.asarray(volume.values) == number
    if not mask.any():
        return []
    box = box_of(mask)
    found = pieces(mask[box])
    large = sum(size >= COMPARABLE_FRACTION * found.voxels[0] for size in found.voxels)
    points = [_points(found.numbers == rank, box, volume) for rank in range(1, large + 1)]
    return sorted(points, key=lambda one: float(one[:, 0].mean()))


def _points(mask: NDArray[np.bool_], box: tuple[slice, ...], volume: LabelVolume) -> Float:
    """(N, 3) centres, LPS mm, of the voxels of a mask that lies in a box of a volume."""
    return _lps(np.argwhere(mask) + [edge.start for edge in box], volume)


def _all_points(volume: LabelVolume, number: int | None) -> Float:
    """(N, 3) centres, LPS mm, of the voxels of a structure; none where it is not there."""
    return _lps(np.argwhere(np.asarray(volume.values) == number), volume)


def _lps(index: NDArray[Any], volume: LabelVolume) -> Float:
    return np.asarray(index @ volume.lps_from_index[:3, :3].T + volume.lps_from_index[:3, 3])


def _told_apart(bodies: Mapping[str, list[Float]], side: Side) -> _Legs:
    """The long bones of either leg; a bone that is there once must be that of the declared side."""
    for name, parts in bodies.items():
        if len(parts) > 2:
            raise ValueError(f"the {name} is in {len(parts)} large pieces")
        apart = float(parts[-1][:, 0].mean() - parts[0][:, 0].mean())
        if len(parts) == 2 and apart < APART_MM:
            raise ValueError(
                f"the two large pieces of the {name} lie {apart:.0f} mm apart from left to right, "
                f"expected at least {APART_MM:.0f} mm"
            )
    ours, theirs = (0, -1) if side == "right" else (-1, 0)
    mine = {name: parts[ours] for name, parts in bodies.items()}
    other = {name: parts[theirs] for name, parts in bodies.items() if len(parts) == 2}
    _check_one_knee(mine, other, side)
    return _Legs(mine, other)


def _check_one_knee(mine: Mapping[str, Float], other: Mapping[str, Float], side: Side) -> None:
    """Raise when the femur is nearer to the other leg's tibia, or the tibia to the other leg's femur, or nearly so."""
    if len(mine) < len(LONG_BONES):
        return
    own = _gap(mine["femur"], mine["tibia"])
    across = min(_gap(mine[name], other[second]) for name, second in product(mine, other) if name != second)
    if across < own + CLEARLY_NEARER_MM:
        raise ValueError(
            f"femur and tibia of the {side} leg are {own:.0f} mm apart, and {across:.0f} mm across to the other leg"
        )


def _gap(one: Float, other: Float) -> float:
    """Smallest distance between two sets of points, mm."""
    from scipy.spatial import KDTree  # noqa: PLC0415 - half a second that a run of cached stages need not pay

    return float(np.min(KDTree(one).query(other)[0]))


def _take_away(volume: LabelVolume, number: int, legs: _Legs) -> bool:
    """Set the pieces of a structure that belong to the other leg to 0, in place; whether there were any."""
    from scipy import ndimage  # noqa: PLC0415 - half a second that a run of cached stages need not pay
    from scipy.spatial import KDTree  # noqa: PLC0415 - as above

    values = np.asarray(volume.values)
    box = box_of(values == number)
    found = pieces(values[box] == number)
    ranks = np.arange(1, len(found.voxels) + 1)
    centres = np.array(ndimage.center_of_mass(found.numbers > 0, found.numbers, ranks))
    at = _lps(centres + [edge.start for edge in box], volume)
    mine, other = (KDTree(np.vstack(list(leg.values()))).query(at)[0] for leg in legs)
    away = np.concatenate([[False], other < mine])
    values[box][away[found.numbers]] = 0
    return bool(away.any())


def _check_fibula(volume: LabelVolume, structures: Mapping[str, int], side: Side) -> None:
    """Raise when the fibula that is left lies on the inner side of its tibia."""
    fibula, tibia = (_all_points(volume, structures.get(name)) for name in ("fibula", "tibia"))
    if not (len(fibula) and len(tibia)):
        return
    level = tibia[(tibia[:, 2] >= fibula[:, 2].min()) & (tibia[:, 2] <= fibula[:, 2].max())]
    if not len(level):
        return
    way = float(fibula[:, 0].mean() - level[:, 0].mean())
    inner = way if side == "right" else -way
    if inner >= BESIDE_MM:
        raise ValueError(
            f"the fibula of the {side} leg lies {inner:.0f} mm to the inner side of its tibia, as if left and right "
            "were exchanged"
        )
