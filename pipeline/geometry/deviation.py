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
    centres = (corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3.0
    reach = np.sqrt(np.max([_squared_length((corners[:, k] - centres).T) for k in range(3)], axis=0))
    ranks = np.arange(1, min(NEIGHBOURS, len(corners)) + 1)
    away, near = (np.asarray(of_rank).T for of_rank in KDTree(centres, balanced_tree=False).query(points, k=ranks))
    nearest = np.full(len(points), np.inf)
    for distance, triangle in zip(away, near, strict=True):
        # no part of a triangle is nearer than its centre less its reach
        nearer = np.flatnonzero(distance - reach[triangle] < nearest)
        found = np.sqrt(_squared_distances(points[nearer], corners[triangle[nearer]]))
        nearest[nearer] = np.minimum(nearest[nearer], found)
    return nearest


def _sample(mesh: TriangleMesh) -> Float:
    return mesh.points[:: max(1, len(mesh.points) // SAMPLES)]


def _squared_distances(points: Float, corners: Float) -> Float:
    """(K,) squared distance of each point (K, 3) from its triangle (K, 3, 3): in the face, else on the nearest edge."""
    p, a, b, c = points.T, corners[:, 0].T, corners[:, 1].T, corners[:, 2].T
    ab, ac, ap = b - a, c - a, p - a
    on_edges = [_squared_to_segment(ap, ab), _squared_to_segment(ap, ac), _squared_to_segment(p - b, c - b)]
    normal = _cross(ab, ac)
    area2, v, w = _dot(normal, normal), _dot(_cross(ap, ac), normal), _dot(_cross(ab, ap), normal)
    above = (v >= 0.0) & (w >= 0.0) & (v + w <= area2)
    return np.where(above, _dot(ap, normal) ** 2 / area2, np.min(on_edges, axis=0))


def _squared_to_segment(from_start: Float, along: Float) -> Float:
    t = np.clip(_dot(from_start, along) / _dot(along, along), 0.0, 1.0)
    return _squared_length(from_start - t * along)


def _squared_length(vectors: Float) -> Float:
    return _dot(vectors, vectors)


def _dot(a: Float, b: Float) -> Float:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _cross(a: Float, b: Float) -> Float:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
