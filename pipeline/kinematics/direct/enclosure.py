"""Whether one body holds the other: a start that no way along delta leads to."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from pipeline.geometry.containment import contains
from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.direct.surfaces import Float

#: Directions in which a body is looked at: along its axes, half-way between two and between three of them.
DIRECTIONS = np.array([way for way in product((-1.0, 0.0, 1.0), repeat=3) if any(way)])


class Hull(NamedTuple):
    """A closed surface and the farthest of its corners in each direction, (26, 3), mm."""

    mesh: TriangleMesh
    corners: Float


def hull(mesh: TriangleMesh) -> Hull:
    """The outermost corners of a mesh."""
    corners = mesh.points[np.unique(mesh.triangles)]
    return Hull(mesh, corners[np.argmax(DIRECTIONS @ corners.T, axis=1)])


def enclosed(reference: Hull, moving: Hull, rotation: Float, shift: Float) -> bool:
    """Whether all the outermost corners of one body lie inside the other.

    Parameters
    ----------
    reference, moving : Hull
        Each in its own frame.
    rotation, shift : (3, 3) and (3,) float64
        Placement of the moving body in the reference's frame, mm.
    """
    placed, taken_back = moving.corners @ rotation.T + shift, (reference.corners - shift) @ rotation
    return _holds(reference, placed) or _holds(moving, taken_back)


def _holds(body: Hull, points: Float) -> bool:
    within = (points > body.corners.min(axis=0)) & (points < body.corners.max(axis=0))
    return bool(within.all() and contains(body.mesh, points).all())
