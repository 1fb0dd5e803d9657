"""The tibial plateau: centres of its medial and lateral articular surfaces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cross_sections import cross_sections
from pipeline.geometry.directions import angle_deg, orthogonal_part, unit
from pipeline.geometry.mesh import TriangleMesh, face_normals, triangle_areas

Float = NDArray[np.float64]

#: The plateau is looked for above the widest section of the proximal tibia, among triangles that face proximally.
FACING_COSINE = 0.85
#: Half width of the strip left out in the middle, as a share of the width: the eminence.
EMINENCE_SHARE = 0.12
#: Rounds after which the line of the centres stands still to 0.1 deg, from 20 deg away.
SETTLING_ROUNDS = 4


class Plateau(NamedTuple):
    """Area centroids (3,) of both articular surfaces; spread of either (mm) and of their line (deg)."""

    medial: Float
    lateral: Float
    uncertainty_mm: float
    uncertainty_deg: float


def plateau_centres(tibia: TriangleMesh, axes: Float) -> Plateau:
    """Centres of both halves of the plateau.

    Parameters
    ----------
    tibia : TriangleMesh
        At least the proximal 30 mm.
    axes : (3, 3) float64
        Rows: lateral (to within about 30 deg), anterior, proximal, unit.

    Raises
    ------
    ValueError
        When no surface faces proximally on one side.

    Notes
    -----
    The halves are split across the line of their own centres, so the search is repeated from its own answer. They are
    bounded by what faces proximally, so their centroids move with that bound; the spread is the shift between a wide
    and a narrow choice.
    """
    wide = _settled(tibia, axes, FACING_COSINE)
    narrow = _settled(tibia, axes, 0.5 * (1.0 + FACING_COSINE))
    shift = float(np.mean([np.linalg.norm(w - n) for w, n in zip(wide, narrow, strict=True)]))
    turn = angle_deg(unit(wide[1] - wide[0]), unit(narrow[1] - narrow[0]))
    return Plateau(*wide, uncertainty_mm=max(shift, 0.3), uncertainty_deg=max(turn, 0.5))


def _settled(tibia: TriangleMesh, axes: Float, facing_cosine: float) -> tuple[Float, Float]:
    proximal, handed = axes[2], float(np.sign(np.linalg.det(axes)))
    for _ in range(SETTLING_ROUNDS):
        medial, lateral = _centres(tibia, axes, facing_cosine)
        x = orthogonal_part(lateral - medial, proximal)
        axes = np.stack([x, handed * np.cross(proximal, x), proximal])
    return medial, lateral


def _centres(tibia: TriangleMesh, axes: Float, facing_cosine: float) -> tuple[Float, Float]:
    centres = tibia.points[tibia.triangles].mean(axis=1)
    local = centres @ axes.T
    top = (face_normals(tibia) @ axes[2] > facing_cosine) & (local[:, 2] > _widest_height(tibia, axes[2]))
    area = triangle_areas(tibia)
    if not top.any():
        raise ValueError("no surface of the tibia faces proximally")
    low, high = np.quantile(local[top, 0], [0.01, 0.99])
    middle, gap = 0.5 * (low + high), EMINENCE_SHARE * (high - low)
    medial, lateral = (_centroid(centres, area, top & (s * (local[:, 0] - middle) > gap)) for s in (-1.0, 1.0))
    return medial, lateral


def _widest_height(tibia: TriangleMesh, proximal: Float) -> float:
    top = float((tibia.points @ proximal).max())
    sections = cross_sections(tibia, proximal, np.arange(top - 45.0, top - 2.0, 2.0))
    if not len(sections.areas):
        raise ValueError("the tibia is too short for cross-sections")
    return float(sections.heights[np.argmax(sections.areas)])


def _centroid(centres: Float, area: Float, chosen: NDArray[np.bool_]) -> Float:
    if not chosen.any():
        raise ValueError("one side of the tibial plateau was not found")
    out: Float = np.average(centres[chosen], axis=0, weights=area[chosen])
    return out
