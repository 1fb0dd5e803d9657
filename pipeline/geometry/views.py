"""Clinical viewing directions, taken from anatomical frames and never from the scanner's axes.

A picture is what an observer in front of the patient sees: it is never mirrored, so a right and a left knee differ on
it as they do in life, and the words at its edges say what lies where.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Direction = Literal["anterior", "posterior", "lateral", "medial", "proximal", "distal"]

#: Direction -> column of an anatomical frame (x lateral, y anterior, z proximal) and its sign.
_COLUMNS: dict[Direction, tuple[int, int]] = {
    "lateral": (0, 1),
    "medial": (0, -1),
    "anterior": (1, 1),
    "posterior": (1, -1),
    "proximal": (2, 1),
    "distal": (2, -1),
}


@dataclass(frozen=True, eq=False)
class View:
    """A parallel projection.

    Attributes
    ----------
    right, up, toward : (3,) float64
        Unit vectors in scan space: to the right of the picture, upwards, and towards the observer; right-handed.
    focus : (3,) float64
        Point of scan space at the centre of the picture, mm.
    half_height_mm : float
        Half of what the picture shows from bottom to top.
    edges : 4 str
        What lies at the left, right, top and bottom edge, in anatomical words.
    """

    right: Float
    up: Float
    toward: Float
    focus: Float
    half_height_mm: float
    edges: tuple[str, str, str, str]

    def pixels(self, points: Float, size_px: tuple[int, int]) -> Float:
        """Where points (N, 3) of scan space fall on a picture of (width, height) pixels: (N, 2), x right, y down."""
        width, height = size_px
        offset = (points - self.focus) * (height / 2.0 / self.half_height_mm)
        return np.column_stack([width / 2.0 + offset @ self.right, height / 2.0 - offset @ self.up])


def axis(scan_from_frame: Float, direction: Direction) -> Float:
    """(3,) unit vector in scan space of an anatomical direction of a frame (4, 4)."""
    column, sign = _COLUMNS[direction]
    return sign * np.asarray(scan_from_frame, dtype=np.float64)[:3, column]


def view(scan_from_frame: Float, seen_from: Direction, focus: Float, half_height_mm: float) -> View:
    """The view of an observer who stands on one side of an anatomical frame.

    Proximal is up; seen from proximal or distal, anterior is up.

    Parameters
    ----------
    scan_from_frame : (4, 4) float64
        x lateral, y anterior, z proximal; left-handed for a left joint.
    seen_from : str
        Side on which the observer stands.
    focus : (3,) float64
        Centre of the picture, scan space, mm.
    half_height_mm : float

    Raises
    ------
    ValueError
        When ``half_height_mm`` is not positive.
    """
    if not half_height_mm > 0.0:
        raise ValueError(f"expected a positive half height, got {half_height_mm}")
    toward = axis(scan_from_frame, seen_from)
    up = axis(scan_from_frame, "anterior" if seen_from in ("proximal", "distal") else "proximal")
    right = np.cross(up, toward)
    at_left, at_right, at_top, at_bottom = (_name(scan_from_frame, edge) for edge in (-right, right, up, -up))
    edges = (at_left, at_right, at_top, at_bottom)
    return View(right, up, toward, np.asarray(focus, dtype=np.float64), half_height_mm, edges)


def _name(scan_from_frame: Float, direction: Float) -> str:
    return max(_COLUMNS, key=lambda name: float(axis(scan_from_frame, name) @ direction))
