"""Replay a finished ct2lut table in Python: the pose of the moving bone at any flexion and varus, from ``lut.json``.

One file that needs numpy and nothing else: install it or copy it. Research use - not for diagnosis.

The same poses as ``pipeline/playback.py``: cubic in flexion (not-a-knot spline over each unbroken run of usable entries
of one varus value), linear in varus, then the formula of ``docs/lut-format.md``. Nothing is extrapolated, and nothing
is bridged over an entry that is not usable. Degrees and millimetres; scan space is LPS.

Examples
--------
>>> lut = Lut.read("lut.json")                                # doctest: +SKIP
>>> lut.pose(45.0)                                            # doctest: +SKIP
>>> lut.pose(np.linspace(0, 90, 91), varus_deg=2.0).shape     # doctest: +SKIP
(91, 4, 4)
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Coordinates", "Lut", "__version__"]
__version__ = "0.1.0"

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

FORMAT = "ct2lut-json"
MAJOR = "1"
POLICIES = ("raise", "clamp", "nan")

#: Found coordinates, in the order of every last axis of length 4 here.
_FOUND = ("lateral_mm", "anterior_mm", "proximal_mm", "internal_rotation_deg")
#: Values of ``status`` that are usable: ok, smoothed.
_USABLE = (0, 1)
#: How far the axes of a frame may be from unit length and right angles.
_ORTHONORMAL_TOLERANCE = 1e-6
#: How far a check point may be missed; the file holds ten decimals of a metre.
_CHECK_TOLERANCE_M = 1e-6
_MM_PER_M = 1000.0


class Coordinates(NamedTuple):
    """The six coordinates of one pose or of an array of poses; the same signs for a right and for a left joint.

    Flexion, varus, internal rotation +; lateral, anterior, proximal translation of the moving bone +. Each (...)
    float64.
    """

    flexion_deg: Float
    varus_deg: Float
    internal_rotation_deg: Float
    lateral_mm: Float
    anterior_mm: Float
    proximal_mm: Float


class Lut:
    """A look-up table of stable poses, ready for look-up.

    Parameters
    ----------
    data : mapping
        The object of ``lut.json``.

    Raises
    ------
    ValueError
        When a member is missing or is not what ``lut.schema.json`` says, or when the table misses a check pose of its
        own: it is damaged then, or was changed.
    """

    def __init__(self, data: Mapping[str, Any]) -> None:
        _check_kind(data)
        axes, frames = _section(data, "axes"), _section(data, "frames")
        self.joint: str = _text(data, "joint")
        self.side: str = _text(data, "side")
        self.software: str = _text(data, "software")
        self._flexion = _increasing(axes, "flexion_deg")
        self._varus = _increasing(axes, "varus_deg")
        self._found = _found_coordinates(data, (len(self._flexion), len(self._varus)))
        self._polynomials = _column_polynomials(self._flexion, self._found)
        self._scan_from_reference = _frame(frames, "scan_from_reference", self.side)
        self._moving_from_scan = np.linalg.inv(_frame(frames, "scan_from_moving", self.side))
        self._meet_checks(data)

    @classmethod
    def read(cls, path: str | Path) -> Lut:
        """Read ``lut.json``.

        Raises
        ------
        OSError
            When the file cannot be read.
        ValueError
            When it is not such a table; the message names the file.
        """
        file = Path(path)
        try:
            return cls(_parsed(file.read_bytes()))
        except ValueError as error:
            raise ValueError(f"{file.name}: {error}") from error

    @property
    def flexion_range(self) -> tuple[float, float]:
        """First and last flexion of the grid, degrees."""
        return float(self._flexion[0]), float(self._flexion[-1])

    @property
    def varus_range(self) -> tuple[float, float]:
        """First and last varus of the grid, degrees."""
        return float(self._varus[0]), float(self._varus[-1])

    def pose(self, flexion_deg: ArrayLike, varus_deg: ArrayLike = 0.0, outside: str = "raise") -> Float:
        """Motion of the moving bone from where it was scanned to its stable place.

        Parameters
        ----------
        flexion_deg, varus_deg : array_like
            Attitudes in degrees, broadcast against each other.
        outside : "raise", "clamp" or "nan"
            For an attitude that the table does not cover (off the grid, or beside an entry without a stable pose):
            refuse, take the nearest covered one, or answer NaN. Never extrapolated.

        Returns
        -------
        (..., 4, 4) float64
            ``moved_from_scan`` for column vectors of scan space (LPS mm); (4, 4) for plain numbers.

        Raises
        ------
        ValueError
            With ``raise``, for an attitude that is not covered; with ``clamp``, for NaN and for a table with no usable
            entry; for an unknown policy.
        """
        placed = _placement(*self._look_up(flexion_deg, varus_deg, outside))
        moved: Float = self._scan_from_reference @ placed @ self._moving_from_scan
        # 0 times NaN is NaN, but some libraries pass over zeros
        return np.where(np.isnan(placed).any(axis=(-2, -1), keepdims=True), np.nan, moved)

    def coordinates(self, flexion_deg: ArrayLike, varus_deg: ArrayLike = 0.0, outside: str = "raise") -> Coordinates:
        """The six coordinates of the stable pose; parameters and errors of :meth:`pose`.

        With ``clamp`` the flexion and varus returned are those that were used.
        """
        flexion, varus, found = self._look_up(flexion_deg, varus_deg, outside)
        lateral, anterior, proximal, rotation = (found[..., index] for index in range(4))
        return Coordinates(flexion, varus, rotation, lateral, anterior, proximal)

    def _look_up(self, flexion_deg: ArrayLike, varus_deg: ArrayLike, outside: str) -> tuple[Float, Float, Float]:
        """Attitudes as used, and (..., 4) what was found there."""
        if outside not in POLICIES:
            raise ValueError(f"outside: expected 'raise', 'clamp' or 'nan', got {outside!r}")
        flexion, varus = np.broadcast_arrays(np.asarray(flexion_deg, np.float64), np.asarray(varus_deg, np.float64))
        found = self._found_at(flexion, varus)
        missing = np.asarray(np.isnan(found).any(axis=-1))
        if outside == "nan" or not missing.any():
            return flexion, varus, found
        if outside == "raise":
            raise ValueError(self._uncovered(float(flexion[missing][0]), float(varus[missing][0])))
        used = self._nearest_covered(flexion, varus)
        return used[..., 0], used[..., 1], self._found_at(used[..., 0], used[..., 1])

    def _found_at(self, flexion: Float, varus: Float) -> Float:
        """(..., 4) x, y, z, rotation; NaN wherever the table does not cover an attitude."""
        i, along = _locate(self._flexion, flexion)
        j, across = _locate(self._varus, varus)
        near = self._on_column(i, j, along)
        following = np.minimum(j + 1, len(self._varus) - 1)
        step = np.where(across == 0.0, 1.0, self._varus[following] - self._varus[j])
        weight = (across / step)[..., None]
        far = self._on_column(i, following, along)
        return np.where(weight == 0.0, near, (1.0 - weight) * near + weight * far)

    def _on_column(self, i: NDArray[np.intp], j: NDArray[np.intp], along: Float) -> Float:
        """Exactly the entry where ``along`` is 0, usable or not above it."""
        c, t = self._polynomials[i, j], along[..., None]
        curve = ((c[..., 0, :] * t + c[..., 1, :]) * t + c[..., 2, :]) * t + c[..., 3, :]
        return np.where(t == 0.0, c[..., 3, :], curve)

    def _uncovered(self, flexion: float, varus: float) -> str:
        for name, axis, value in (("flexion", self._flexion, flexion), ("varus", self._varus, varus)):
            if not axis[0] <= value <= axis[-1]:
                return f"{name} {value:g} deg is outside the table, which covers {axis[0]:g} to {axis[-1]:g} deg"
        return f"the table has no stable pose at flexion {flexion:g} deg, varus {varus:g} deg"

    def _nearest_covered(self, flexion: Float, varus: Float) -> Float:
        """(..., 2) every attitude moved to the nearest that is covered: least squared degrees, first at the ends."""
        wanted = np.stack([flexion, varus], axis=-1)
        if np.isnan(wanted).any():
            raise ValueError("an attitude that is not a number has no nearest one")
        used = np.clip(wanted, (self._flexion[0], self._varus[0]), (self._flexion[-1], self._varus[-1]))
        missing = np.isnan(self._found_at(used[..., 0], used[..., 1])).any(axis=-1)
        if missing.any():
            boxes = np.array(list(self._covered_boxes())).reshape(-1, 2, 2)
            if not len(boxes):
                raise ValueError("the table has no usable entry")
            used[missing] = [_nearest_in(boxes, one) for one in wanted[missing]]
        return used

    def _covered_boxes(self) -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
        """Lowest and highest (flexion, varus) of every covered piece: cells, their edges, single entries."""
        usable = ~np.isnan(self._found[..., 0])
        flexion, varus = self._flexion.tolist(), self._varus.tolist()
        for up, over in ((1, 1), (1, 0), (0, 1), (0, 0)):
            rows, columns = usable.shape[0] - up, usable.shape[1] - over
            low, high = usable[:rows], usable[up:]
            covered = low[:, :columns] & low[:, over:] & high[:, :columns] & high[:, over:]
            for i, j in np.argwhere(covered).tolist():
                yield (flexion[i], varus[j]), (flexion[i + up], varus[j + over])

    def _meet_checks(self, data: Mapping[str, Any]) -> None:
        """Refuse a table that does not take the points of its own check poses where it says."""
        checks = _member(data, "checks")
        if not isinstance(checks, list) or not checks:
            raise ValueError("checks: expected a list of check poses")
        for check in checks:
            flexion, varus = (float(_numbers(check, name, ())) for name in ("flexion_deg", "varus_deg"))
            before, after = (_numbers(check, name, (3,)) for name in ("point_in_m", "point_out_m"))
            moved = self.pose(flexion, varus, "clamp")
            missed_m = float(np.linalg.norm(moved[:3, :3] @ before + moved[:3, 3] / _MM_PER_M - after))
            if not missed_m <= _CHECK_TOLERANCE_M:
                at = f"flexion {flexion:g} deg, varus {varus:g} deg"
                raise ValueError(f"the check pose at {at} is missed by {1e3 * missed_m:.4g} mm: damaged or changed")


def _parsed(data: bytes) -> Mapping[str, Any]:
    try:
        found = json.loads(data.decode("utf-8-sig"), parse_constant=_no_number)
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"not JSON: {error}") from error
    if not isinstance(found, dict):
        raise ValueError("not a table: expected a JSON object")
    return found


def _no_number(word: str) -> float:
    raise ValueError(f"not JSON: {word} is no number of JSON")


def _check_kind(data: Mapping[str, Any]) -> None:
    if _text(data, "format") != FORMAT:
        raise ValueError(f"not a table: expected format {FORMAT}, got {data['format']}")
    if not re.fullmatch(rf"{MAJOR}\.[0-9]+", _text(data, "version")):
        raise ValueError(f"the table has format version {data['version']}, this player reads version {MAJOR}")


def _member(data: object, name: str) -> Any:
    if not isinstance(data, Mapping) or name not in data:
        raise ValueError(f"{name} is missing")
    return data[name]


def _text(data: object, name: str) -> str:
    text = _member(data, name)
    if not isinstance(text, str):
        raise ValueError(f"{name}: expected a text")
    return text


def _section(data: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    section = _member(data, name)
    if not isinstance(section, Mapping):
        raise ValueError(f"{name}: expected an object")
    return section


def _numbers(data: object, name: str, shape: tuple[int, ...] | None) -> Float:
    """The numbers of a member, NaN for null; a shape of None stands for any number of them in a row."""
    values = _member(data, name)
    try:
        array = np.array(values, dtype=object)
    except ValueError:  # lists of several lengths
        array = np.array(None)
    if array.ndim != 1 if shape is None else array.shape != shape:
        expected = "a list" if shape is None else f"shape {shape}"
        raise ValueError(f"{name}: expected {expected} of numbers, got shape {array.shape}")
    if not all(type(value) in (int, float, type(None)) for value in array.ravel()):
        raise ValueError(f"{name}: expected numbers")
    try:
        return array.astype(np.float64)  # None becomes NaN
    except OverflowError as error:
        raise ValueError(f"{name}: expected numbers within reach of double precision") from error


def _increasing(axes: Mapping[str, Any], name: str) -> Float:
    axis = _numbers(axes, name, None)
    if not len(axis) or not np.isfinite(axis).all() or not np.all(np.diff(axis) > 0.0):
        raise ValueError(f"{name}: expected strictly increasing degrees")
    return axis


def _found_coordinates(data: Mapping[str, Any], shape: tuple[int, int]) -> Float:
    """(F, V, 4) x, y, z in mm and rotation in degrees; NaN where the entry is not usable."""
    status, coordinates = _numbers(data, "status", shape), _section(data, "coordinates")
    usable = np.isin(status, _USABLE)
    found = np.stack([_numbers(coordinates, name, shape) for name in _FOUND], axis=-1)
    if not np.isfinite(found[usable]).all():
        raise ValueError("coordinates: a usable entry has a coordinate that is not a number")
    return np.where(usable[..., None], found, np.nan)


def _frame(frames: Mapping[str, Any], name: str, side: str) -> Float:
    """(4, 4) a rigid frame in scan space; left-handed for a left joint."""
    if side not in ("right", "left"):
        raise ValueError(f"side: expected right or left, got {side}")
    frame = _numbers(frames, name, (4, 4))
    axes = frame[:3, :3]
    straight = np.allclose(axes.T @ axes, np.eye(3), rtol=0.0, atol=_ORTHONORMAL_TOLERANCE)
    if not np.isfinite(frame).all() or not straight or frame[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise ValueError(f"{name}: expected a rigid frame of unit axes at right angles")
    if (np.linalg.det(axes) > 0.0) != (side == "right"):
        raise ValueError(f"{name}: expected a {side}-handed frame for this side")
    return frame


def _column_polynomials(flexion: Float, found: Float) -> Float:
    """(F, V, 4, 4) axes: flexion interval, varus value, power of t = flexion - flexion[i] (3, 2, 1, 0), coordinate.

    The constant term is the entry itself; the rest is NaN where the interval above the entry is not covered.
    """
    polynomials = np.full((*found.shape[:2], 4, 4), np.nan)
    polynomials[:, :, 3] = found
    for column in range(found.shape[1]):
        for start, stop in _runs(~np.isnan(found[:, column, 0])):
            if stop - start > 1:
                cubics = _cubics(flexion[start:stop], found[start:stop, column])
                polynomials[start : stop - 1, column] = cubics
    return polynomials


def _runs(usable: Bool) -> list[list[int]]:
    """Start and stop of the unbroken runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], usable, [False]])))
    runs: list[list[int]] = edges.reshape(-1, 2).tolist()
    return runs


def _cubics(x: Float, y: Float) -> Float:
    """(N - 1, 4, K) the not-a-knot cubic through N >= 2 samples; two give a line, three a parabola."""
    width = np.diff(x)[:, None]
    chord = np.diff(y, axis=0) / width
    slope = _slopes(width[:, 0], chord)
    bend = (slope[:-1] + slope[1:] - 2.0 * chord) / width
    return np.stack([bend / width, (chord - slope[:-1]) / width - bend, slope[:-1], y[:-1]], axis=1)


def _slopes(width: Float, chord: Float) -> Float:
    """(N, K) slopes: the second derivative is continuous everywhere, the third also next to both ends."""
    size = len(width) + 1
    if size == 2:
        return np.repeat(chord, 2, axis=0)
    matrix, right = np.zeros((size, size)), np.zeros((size, chord.shape[1]))
    inner = np.arange(1, size - 1)
    matrix[inner, inner - 1] = width[1:]
    matrix[inner, inner] = 2.0 * (width[:-1] + width[1:])
    matrix[inner, inner + 1] = width[:-1]
    right[inner] = 3.0 * (width[1:, None] * chord[:-1] + width[:-1, None] * chord[1:])
    matrix[0, :2], right[0] = _end(width, chord)
    matrix[-1, :-3:-1], right[-1] = _end(width[::-1], chord[::-1])
    return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)


def _end(width: Float, chord: Float) -> tuple[Float, Float]:
    """Weights of the end sample's slope and its neighbour's, and the right-hand side."""
    if len(width) == 2:
        return np.ones(2), 2.0 * chord[0]
    first, second = float(width[0]), float(width[1])
    both = first + second
    near, far = (first + 2.0 * both) * second / both, first * first / both
    return np.array([second, both]), near * chord[0] + far * chord[1]


def _locate(axis: Float, value: Float) -> tuple[NDArray[np.intp], Float]:
    """Index of the grid value at or below, and the way on from it; NaN outside the grid."""
    index = np.clip(np.searchsorted(axis, value, side="right") - 1, 0, len(axis) - 1)
    return index, np.where((value >= axis[0]) & (value <= axis[-1]), value - axis[index], np.nan)


def _nearest_in(boxes: Float, wanted: Float) -> Float:
    """(2,) the attitude nearest to ``wanted`` in any of (B, 2, 2) boxes of lowest and highest corners."""
    inside = np.clip(wanted, boxes[:, 0], boxes[:, 1])
    nearest: Float = inside[np.argmin(np.sum((inside - wanted) ** 2, axis=1))]
    return nearest


def _placement(flexion_deg: Float, varus_deg: Float, found: Float) -> Float:
    """(..., 4, 4) ``Rx(-flexion) Ry(varus) (Rz(rotation) | d)`` multiplied out; d = (x, y, z) in the attitude frame."""
    x, y, z, rotation = (found[..., index] for index in range(4))
    f, v, r = np.radians(flexion_deg), np.radians(varus_deg), np.radians(rotation)
    cf, cv, cr, sf, sv, sr = np.cos(f), np.cos(v), np.cos(r), np.sin(f), np.sin(v), np.sin(r)
    a, b = -sf * sv, -cf * sv
    numbers = (
        *(cv * cr, -cv * sr, sv, cv * x + sv * z),
        *(a * cr + cf * sr, cf * cr - a * sr, sf * cv, a * x + cf * y + sf * cv * z),
        *(b * cr - sf * sr, -b * sr - sf * cr, cf * cv, b * x - sf * y + cf * cv * z),
        *(0.0, 0.0, 0.0, 1.0),
    )
    flat = np.stack(np.broadcast_arrays(*numbers), axis=-1)
    return flat.reshape(*flat.shape[:-1], 4, 4)
