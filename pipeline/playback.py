"""Replay a finished table: the pose of the moving body at any flexion and varus, from ``lut.h5`` alone.

Needs numpy and h5py. A query in plain numbers takes a few microseconds, so a renderer may ask once a frame; arrays of
attitudes are answered in one call.

Examples
--------
>>> lut = Lut.open("lut.h5")                      # doctest: +SKIP
>>> lut.pose(45.0)                                # doctest: +SKIP
>>> lut.pose(np.linspace(0, 90, 91), varus_deg=2.0).shape  # doctest: +SKIP
(91, 4, 4)
"""

from __future__ import annotations

from bisect import bisect_right
from math import cos, radians, sin
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.files.lut_content import LutFileContent
from pipeline.files.lut_file import decode_lut
from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.interpolation import Outside, look_up, motion_map, motions, placement, pose_curves

Float = NDArray[np.float64]
_Found = tuple[float, float, float, float]


class PoseCoordinates(NamedTuple):
    """The six coordinates of one pose or of an array of poses, clinical signs and units.

    Flexion, varus, internal rotation +; lateral, anterior, proximal translation of the moving body +. Each (...)
    float64.
    """

    flexion_deg: Float
    varus_deg: Float
    internal_rotation_deg: Float
    lateral_mm: Float
    anterior_mm: Float
    proximal_mm: Float


class Bodies(NamedTuple):
    """The contact bodies, scan space (LPS mm), as scanned."""

    reference: TriangleMesh
    moving: TriangleMesh


class Lut:
    """A look-up table of stable poses, ready for look-up.

    Parameters
    ----------
    content : LutFileContent
        As decoded from ``lut.h5``.
    """

    def __init__(self, content: LutFileContent) -> None:
        grid = content.smooth.grid
        self._content = content
        self._curves = pose_curves(grid, content.smooth.poses)
        self._to_scan = motion_map(content.scan_from_reference, content.scan_from_moving)
        # plain lists and floats: for one attitude numpy's overhead would cost more than the arithmetic
        self._flexion: list[float] = grid.flexion_deg.tolist()
        self._varus: list[float] = grid.varus_deg.tolist()
        self._columns = self._curves.polynomials.reshape(*grid.shape, 16).tolist()

    @classmethod
    def open(cls, path: str | Path) -> Lut:
        """Read a table.

        Raises
        ------
        OSError
            When the file cannot be read.
        ValueError
            When it is not a table, is damaged, or is of a newer format; the message names the file.
        """
        file = Path(path)
        try:
            return cls(decode_lut(file.read_bytes()))
        except ValueError as error:
            raise ValueError(f"{file.name}: {error}") from error

    @property
    def joint(self) -> str:
        """Name of the joint, such as ``knee``."""
        return self._content.joint

    @property
    def side(self) -> str:
        """``right`` or ``left``."""
        return self._content.side

    @property
    def software(self) -> str:
        """Name and version of the program that made the table."""
        return self._content.software

    @property
    def flexion_range(self) -> tuple[float, float]:
        """First and last flexion of the grid, degrees."""
        return self._flexion[0], self._flexion[-1]

    @property
    def varus_range(self) -> tuple[float, float]:
        """First and last varus of the grid, degrees."""
        return self._varus[0], self._varus[-1]

    @property
    def bodies(self) -> Bodies:
        """The contact bodies, as scanned; ``pose`` moves the moving one."""
        return Bodies(self._content.reference_body, self._content.moving_body)

    def pose(self, flexion_deg: ArrayLike, varus_deg: ArrayLike = 0.0, outside: Outside = "raise") -> Float:
        """Motion of the moving body from where it was scanned to its stable place.

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
            With ``raise``, for an attitude that is not covered.
        """
        if isinstance(flexion_deg, float | int) and isinstance(varus_deg, float | int):
            flexion, varus = self._within(flexion_deg, varus_deg) if outside == "clamp" else (flexion_deg, varus_deg)
            found = self._quick(flexion, varus)
            if found is not None:
                return self._motion(flexion, varus, found)
        return motions(self._to_scan, *look_up(self._curves, flexion_deg, varus_deg, outside))

    def reference_from_moving(
        self, flexion_deg: ArrayLike, varus_deg: ArrayLike = 0.0, outside: Outside = "raise"
    ) -> Float:
        """(..., 4, 4) the moving body's frame in the reference body's, mm; parameters and errors of :meth:`pose`.

        For column vectors of the kinematic frames, x lateral for both sides: ``femur_from_tibia`` of a knee.
        """
        return motions(motion_map(np.eye(4), np.eye(4)), *look_up(self._curves, flexion_deg, varus_deg, outside))

    def coordinates(
        self, flexion_deg: ArrayLike, varus_deg: ArrayLike = 0.0, outside: Outside = "raise"
    ) -> PoseCoordinates:
        """The six coordinates of the stable pose; parameters and errors of :meth:`pose`.

        With ``clamp`` the flexion and varus returned are those that were used.
        """
        flexion, varus, found = look_up(self._curves, flexion_deg, varus_deg, outside)
        lateral, anterior, proximal, rotation = (found[..., index] for index in range(4))
        return PoseCoordinates(flexion, varus, rotation, lateral, anterior, proximal)

    def _within(self, flexion: float, varus: float) -> tuple[float, float]:
        """The attitude of the grid nearest to an attitude; NaN stays NaN."""
        return (
            min(max(flexion, self._flexion[0]), self._flexion[-1]),
            min(max(varus, self._varus[0]), self._varus[-1]),
        )

    def _quick(self, flexion: float, varus: float) -> _Found | None:
        """x, y, z, rotation of one covered attitude; None for any other, which takes the long way."""
        if not (self._flexion[0] <= flexion <= self._flexion[-1] and self._varus[0] <= varus <= self._varus[-1]):
            return None
        i = bisect_right(self._flexion, flexion) - 1
        j = bisect_right(self._varus, varus) - 1
        along, across = flexion - self._flexion[i], varus - self._varus[j]
        found = _cubic(self._columns[i][j], along)
        if across:
            far = _cubic(self._columns[i][j + 1], along)
            weight = across / (self._varus[j + 1] - self._varus[j])
            rest = 1.0 - weight
            found = (
                rest * found[0] + weight * far[0],
                rest * found[1] + weight * far[1],
                rest * found[2] + weight * far[2],
                rest * found[3] + weight * far[3],
            )
        return found if found[0] == found[0] else None  # NaN: an unusable entry beside it

    def _motion(self, flexion: float, varus: float, found: _Found) -> Float:
        x, y, z, rotation = found
        f, v, r = radians(flexion), radians(varus), radians(rotation)
        rows = placement((cos(f), cos(v), cos(r)), (sin(f), sin(v), sin(r)), (x, y, z))
        flat: Float = self._to_scan @ np.array((*rows, 1.0))
        return flat.reshape(4, 4)


def _cubic(c: list[float], t: float) -> _Found:
    """Four cubics at t; ``c`` holds the four coefficients of t^3, then of t^2, of t, and the constants."""
    if t == 0.0:
        return c[12], c[13], c[14], c[15]
    return (
        ((c[0] * t + c[4]) * t + c[8]) * t + c[12],
        ((c[1] * t + c[5]) * t + c[9]) * t + c[13],
        ((c[2] * t + c[6]) * t + c[10]) * t + c[14],
        ((c[3] * t + c[7]) * t + c[11]) * t + c[15],
    )
