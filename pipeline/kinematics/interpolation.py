"""Poses between the entries of the table, and the motion that every pose stands for; vectorised, numpy only.

Between entries x, y, z and the rotation are cubic in flexion (not-a-knot spline over each unbroken run of usable
entries of one varus value) and linear in varus; the formula of :mod:`pipeline.kinematics.joint_coordinates` then
makes the motion, so a pose between entries is rigid as well. Nothing is extrapolated, and nothing is bridged over an
entry that is not usable.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.kinematics.spline import interval_polynomials
from pipeline.kinematics.table import Grid, LutTable, PoseTable, Status

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
#: Three floats, or three arrays of one shape: the arithmetic of :func:`placement` is the same.
Triple = tuple[Any, Any, Any]

#: What to do with an attitude the table does not cover: refuse it, go to the nearest covered one, answer NaN.
Outside = Literal["raise", "clamp", "nan"]

#: The found coordinates, in the order of every last axis of length 4 here.
FOUND = ("lateral_mm", "anterior_mm", "proximal_mm", "internal_rotation_deg")


@dataclass(frozen=True, eq=False)
class PoseCurves:
    """The table made ready for look-up.

    Attributes
    ----------
    grid : Grid
    polynomials : (F, V, 4, 4) float64
        Axes: flexion interval, varus value, power of t = flexion - flexion[i] in degrees (3, 2, 1, 0), found
        coordinate. The constant term of entry (i, j) is the entry itself, also in the last row; the rest is NaN
        where the interval above the entry is not covered.
    """

    grid: Grid
    polynomials: Float


def usable_entries(poses: PoseTable) -> Bool:
    """(F, V) whether an entry may be shown."""
    return poses.status <= Status.SMOOTHED


def found_coordinates(poses: PoseTable) -> Float:
    """(F, V, 4) x, y, z in mm and rotation in degrees; NaN where the entry is not usable."""
    found = np.stack([getattr(poses, name) for name in FOUND], axis=-1)
    return np.where(usable_entries(poses)[..., None], found, np.nan)


def motion_map(scan_from_reference: Float, scan_from_moving: Float) -> Float:
    """(16, 13) matrix that makes a motion in scan space, row by row, of :func:`placement` and a final 1.

    ``scan_from_reference . M . inverse(scan_from_moving)`` is linear in the entries of M (their Kronecker product),
    and M's last row is 0 0 0 1: one product in place of two and an inversion.
    """
    moving_from_scan = np.linalg.inv(scan_from_moving)
    moving_from_scan[3] = [0.0, 0.0, 0.0, 1.0]
    return np.kron(scan_from_reference, moving_from_scan.T)[:, [*range(12), 15]]


def placement(cosines: Triple, sines: Triple, shift: Triple) -> tuple[Any, ...]:
    """First three rows of ``reference_from_moving``, twelve numbers, row by row.

    Parameters
    ----------
    cosines, sines : three numbers
        Of flexion, varus and rotation.
    shift : three numbers
        d = (lateral, anterior, proximal), mm, in the attitude frame.

    Notes
    -----
    ``Rx(-flexion) . Ry(varus) . (Rz(rotation) | d)`` multiplied out.
    """
    (cf, cv, cr), (sf, sv, sr), (x, y, z) = cosines, sines, shift
    a, b = -sf * sv, -cf * sv
    return (
        *(cv * cr, -cv * sr, sv, cv * x + sv * z),
        *(a * cr + cf * sr, cf * cr - a * sr, sf * cv, a * x + cf * y + sf * cv * z),
        *(b * cr - sf * sr, -b * sr - sf * cr, cf * cv, b * x - sf * y + cf * cv * z),
    )


def motions(to_scan: Float, flexion_deg: Float, varus_deg: Float, found: Float) -> Float:
    """Motions of the moving body, scan space, of whole arrays of poses.

    Parameters
    ----------
    to_scan : (16, 13) float64
        From :func:`motion_map`.
    flexion_deg, varus_deg : (...) float64
    found : (..., 4) float64
        x, y, z (mm) and rotation (deg).

    Returns
    -------
    (..., 4, 4) float64
        ``moved_from_scan``; all NaN for a pose with a NaN.
    """
    angles = np.radians(np.stack(np.broadcast_arrays(flexion_deg, varus_deg, found[..., 3])))
    cosines, sines = np.cos(angles), np.sin(angles)
    rows = placement(
        (cosines[0], cosines[1], cosines[2]),
        (sines[0], sines[1], sines[2]),
        (found[..., 0], found[..., 1], found[..., 2]),
    )
    terms = np.stack([*rows, np.ones_like(rows[0])], axis=-1)
    # einsum, not BLAS: the same bits at any number of threads
    flat: Float = np.einsum("kr,...r->...k", to_scan, terms)
    return flat.reshape(*terms.shape[:-1], 4, 4)


def moved_from_scan_table(table: LutTable) -> Float:
    """(F, V, 4, 4) motion of every entry, scan space; NaN where the entry is not usable."""
    to_scan = motion_map(table.scan_from_reference, table.scan_from_moving)
    flexion, varus = np.meshgrid(table.grid.flexion_deg, table.grid.varus_deg, indexing="ij")
    return motions(to_scan, flexion, varus, found_coordinates(table.poses))


def usable_runs(usable: Bool) -> list[slice]:
    """Unbroken runs of True in a (N,) array, in order."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], usable, [False]])))
    return [slice(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2], strict=True)]


def pose_curves(grid: Grid, poses: PoseTable) -> PoseCurves:
    """Make a table ready for look-up.

    Raises
    ------
    ValueError
        When the arrays do not have the shape of the grid, or an axis does not increase.
    """
    found = found_coordinates(poses)
    if found.shape[:2] != grid.shape:
        raise ValueError(f"poses: expected shape {grid.shape} of the grid, got {found.shape[:2]}")
    polynomials = np.full((*grid.shape, 4, 4), np.nan)
    polynomials[:, :, 3] = found
    for column, usable in enumerate(usable_entries(poses).T):
        for run in usable_runs(usable):
            if run.stop - run.start > 1:
                inner = slice(run.start, run.stop - 1)
                polynomials[inner, column] = interval_polynomials(grid.flexion_deg[run], found[run, column])
    return PoseCurves(grid, polynomials)


def found_at(curves: PoseCurves, flexion_deg: Float, varus_deg: Float) -> Float:
    """(..., 4) x, y, z, rotation at attitudes; NaN wherever the table does not cover one.

    ``flexion_deg`` and ``varus_deg`` have one shape.
    """
    i, along = _locate(curves.grid.flexion_deg, flexion_deg)
    j, across = _locate(curves.grid.varus_deg, varus_deg)
    near = _column(curves, i, j, along)
    following = np.minimum(j + 1, len(curves.grid.varus_deg) - 1)
    step = np.where(across == 0.0, 1.0, curves.grid.varus_deg[following] - curves.grid.varus_deg[j])
    weight = (across / step)[..., None]
    return np.where(weight == 0.0, near, (1.0 - weight) * near + weight * _column(curves, i, following, along))


def _locate(axis: Float, value: Float) -> tuple[NDArray[np.intp], Float]:
    """Index of the grid value at or below, and the way on from it; NaN outside the grid."""
    index = np.clip(np.searchsorted(axis, value, side="right") - 1, 0, len(axis) - 1)
    return index, np.where((value >= axis[0]) & (value <= axis[-1]), value - axis[index], np.nan)


def _column(curves: PoseCurves, i: NDArray[np.intp], j: NDArray[np.intp], along: Float) -> Float:
    """(..., 4) curves of varus value j; exactly the entry where ``along`` is 0, usable or not above it."""
    c, t = curves.polynomials[i, j], along[..., None]
    return np.where(t == 0.0, c[..., 3, :], ((c[..., 0, :] * t + c[..., 1, :]) * t + c[..., 2, :]) * t + c[..., 3, :])


def look_up(
    curves: PoseCurves, flexion_deg: ArrayLike, varus_deg: ArrayLike, outside: Outside
) -> tuple[Float, Float, Float]:
    """Attitudes and found coordinates, with a policy for what the table does not cover.

    Parameters
    ----------
    curves : PoseCurves
    flexion_deg, varus_deg : array_like
        Broadcast against each other.
    outside : "raise", "clamp" or "nan"
        ``clamp`` takes the nearest attitude that is covered (least sum of squared degrees), first at the grid's
        ends, then beside entries that are not usable.

    Returns
    -------
    flexion_deg, varus_deg : (...) float64
        As used: changed by ``clamp`` only.
    found : (..., 4) float64

    Raises
    ------
    ValueError
        With ``raise``, for an attitude that is not covered; with ``clamp``, for NaN and for a table with no usable
        entry; for an unknown policy.
    """
    if outside not in ("raise", "clamp", "nan"):
        raise ValueError(f"outside: expected 'raise', 'clamp' or 'nan', got {outside!r}")
    flexion, varus = np.broadcast_arrays(np.asarray(flexion_deg, np.float64), np.asarray(varus_deg, np.float64))
    found = found_at(curves, flexion, varus)
    missing = np.asarray(np.isnan(found).any(axis=-1))
    if outside == "nan" or not missing.any():
        return flexion, varus, found
    if outside == "raise":
        raise ValueError(_uncovered(curves.grid, float(flexion[missing][0]), float(varus[missing][0])))
    used = _nearest_covered(curves, flexion, varus)
    return *used, found_at(curves, *used)


def _uncovered(grid: Grid, flexion_deg: float, varus_deg: float) -> str:
    """Sentence that says why an attitude has no pose."""
    for name, axis, value in (("flexion", grid.flexion_deg, flexion_deg), ("varus", grid.varus_deg, varus_deg)):
        if not axis[0] <= value <= axis[-1]:
            return f"{name} {value:g} deg is outside the table, which covers {axis[0]:g} to {axis[-1]:g} deg"
    return f"the table has no stable pose at flexion {flexion_deg:g} deg, varus {varus_deg:g} deg"


def _nearest_covered(curves: PoseCurves, flexion: Float, varus: Float) -> tuple[Float, Float]:
    """Every attitude moved to the nearest that is covered."""
    if np.isnan(flexion).any() or np.isnan(varus).any():
        raise ValueError("an attitude that is not a number has no nearest one")
    used = np.stack([_clipped(curves.grid.flexion_deg, flexion), _clipped(curves.grid.varus_deg, varus)], axis=-1)
    missing = np.isnan(found_at(curves, used[..., 0], used[..., 1])).any(axis=-1)
    if missing.any():  # the end of the grid is the nearest of all, so only these need a search
        used[missing] = _nearest_in_boxes(curves, np.stack([flexion, varus], axis=-1)[missing])
    return used[..., 0], used[..., 1]


def _clipped(axis: Float, value: Float) -> Float:
    return np.clip(value, axis[0], axis[-1])


def _nearest_in_boxes(curves: PoseCurves, wanted: Float) -> Float:
    """(N, 2) covered attitudes nearest to ``wanted`` (N, 2)."""
    low, high = _covered_boxes(curves)
    if not len(low):
        raise ValueError("the table has no usable entry")
    inside = (np.clip(one, low, high) for one in wanted)
    return np.array([box[np.argmin(np.sum((box - one) ** 2, axis=1))] for one, box in zip(wanted, inside, strict=True)])


def _covered_boxes(curves: PoseCurves) -> tuple[Float, Float]:
    """Lowest and highest (flexion, varus) of every covered piece, (B, 2) each: cells, their edges, single entries."""
    usable = ~np.isnan(curves.polynomials[:, :, 3, 0])
    low, high = [], []
    for up, over in ((1, 1), (1, 0), (0, 1), (0, 0)):
        rows, columns = usable.shape[0] - up, usable.shape[1] - over
        i, j = np.nonzero(usable[:rows, :columns] & usable[up:, :columns] & usable[:rows, over:] & usable[up:, over:])
        low.append(np.stack([curves.grid.flexion_deg[i], curves.grid.varus_deg[j]], axis=-1))
        high.append(np.stack([curves.grid.flexion_deg[i + up], curves.grid.varus_deg[j + over]], axis=-1))
    return np.concatenate(low), np.concatenate(high)
