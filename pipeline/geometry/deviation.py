"""How far two surfaces of the same thing lie apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.mesh import Float, TriangleMesh

#: Nearest triangles (by their centres) whose exact distance is looked at.
NEIGHBOURS = 16
#: At most about this many vertices of each surface are measured, evenly spread over their order.
SAMPLES = 10_000
#: Share of the original surface that may lie further from the mesh than ``worn_mm``.
WORN_PERCENT = 1.0


@dataclass(frozen=True)
class Deviation:
    """Distance of a smoothed mesh from the surface it was made of, mm.

    Attributes
    ----------
    rms_mm, max_mm : float
        Of the vertices of the mesh from the original surface: what smoothing added.
    worn_mm : float
        Distance from the mesh that WORN_PERCENT of the original surface exceed: thin rims that smoothing took away,
        which the mesh itself cannot show.
    """

    rms_mm: float
    max_mm: float
    worn_mm: float


def deviation(mesh: TriangleMesh, original: TriangleMesh) -> Deviation:
    """How well a mesh stands for the surface it was made of, both in the same frame."""
    added, lost = distances(_sample(mesh), original), distances(_sample(original), mesh)
    worn = float(np.percentile(lost, 100.0 - WORN_PERCENT))
    return Deviation(float(np.sqrt((added**2).mean())), float(added.max()), worn)


def distances(points: Float, mesh: TriangleMesh) -> Float:
    """(N,) distance of points (N, 3) from a surface, mm.

    Exact where the nearest point lies on one of the NEIGHBOURS triangles whose centres are nearest, otherwise a little
    too large: fit for triangles of similar size.
    """
    from scipy.spatial import KDTree  # noqa: PLC0415 - slow to import, and runs of cached stages never need it

    corners = mesh.points[mesh.triangles]
    neighbours = min(NEIGHBOURS, len(corners))
    _, near = KDTree(corners.mean(axis=1)).query(points, k=np.arange(1, neighbours + 1))
    squared = _squared_distances(np.repeat(points, neighbours, axis=0), corners[near.ravel()])
    return np.asarray(np.sqrt(squared.reshape(len(points), neighbours).min(axis=1)))


def _sample(mesh: TriangleMesh) -> Float:
    return mesh.points[:: max(1, len(mesh.points) // SAMPLES)]


def _dot(a: Float, b: Float) -> Float:
    return np.asarray((a * b).sum(axis=-1), dtype=np.float64)


def _squared_distances(points: Float, corners: Float) -> Float:
    """(K,) squared distance of each point (K, 3) from its triangle (K, 3, 3): in the face, else on the nearest edge."""
    sides = [_squared_to_segment(points, corners[:, i], corners[:, (i + 1) % 3]) for i in range(3)]
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal, to_point = np.cross(ab, ac), points - a
    area2 = _dot(normal, normal)
    v, w = _dot(np.cross(to_point, ac), normal), _dot(np.cross(ab, to_point), normal)
    above = (v >= 0.0) & (w >= 0.0) & (v + w <= area2)
    height2 = _dot(to_point, normal) ** 2 / area2
    return np.where(above, height2, np.minimum(np.minimum(sides[0], sides[1]), sides[2]))


def _squared_to_segment(points: Float, start: Float, end: Float) -> Float:
    along = end - start
    t = np.clip(_dot(points - start, along) / _dot(along, along), 0.0, 1.0)
    away = points - start - t[:, None] * along
    return _dot(away, away)
