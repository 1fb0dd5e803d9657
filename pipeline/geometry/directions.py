"""Small vector helpers shared by the anatomy code."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def unit(vector: Float) -> Float:
    """The vector (3,) scaled to length 1; ValueError when it has none."""
    length = float(np.linalg.norm(vector))
    if length < 1e-12:
        raise ValueError("a direction cannot be made of a vector without length")
    return vector / length


def orthogonal_part(vector: Float, axis: Float) -> Float:
    """Unit vector (3,) along the part of ``vector`` orthogonal to the unit ``axis``."""
    return unit(vector - (vector @ axis) * axis)


def angle_deg(first: Float, second: Float) -> float:
    """Angle between two unit vectors (3,), 0 to 180 deg."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second)))


def smallest_turn(start: Float, end: Float) -> Float:
    """(3, 3) smallest rotation that takes the unit vector ``start`` to the unit vector ``end``.

    Rodrigues' formula with sin and cos taken from the cross and dot product; ValueError for opposite vectors.
    """
    v, c = np.cross(start, end), float(start @ end)
    if c < -1.0 + 1e-12:
        raise ValueError("the smallest turn between opposite directions is not defined")
    skew = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    turn: Float = np.eye(3) + skew + skew @ skew / (1.0 + c)
    return turn
