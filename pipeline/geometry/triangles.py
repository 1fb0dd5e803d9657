"""Feature pairs of triangles, vectorised: where two surfaces are near one another, and in which direction.

Two smooth pieces of triangle surfaces come nearest between a vertex and the inside of a face, or between the insides of
two edges; every other closest point of a *pair of triangles* (vertex to edge, vertex to vertex) is an artefact of
looking at one pair at a time, and points in a direction in which the surfaces do not push. Point and segment formulas
after Ericson, Real-Time Collision Detection (2005), chapter 5.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

#: Squared lengths and areas below this are zero: far below any mesh edge (mm), far above rounding.
TINY = 1e-18
#: Barycentric share and cosine by which rounding may put a point outside a face or turn a face away: a corner above a
#: shared edge belongs to both faces, and the upright walls of a box count where its corner touches.
ROUNDING = 1e-6
#: Sine by which a triangle may come nearer than its edge: two edges that will meet next, when the faces beside them are
#: parallel within about a degree, still count.
NEARLY_PARALLEL = 0.02


class FeaturePairs(NamedTuple):
    """Near features: points on the first and on the second surface (K, 3), mm, and their distance (K,), mm."""

    on_first: Float
    on_second: Float
    distance: Float


class _Candidates(NamedTuple):
    on_first: Float
    on_second: Float
    genuine: NDArray[np.bool_]


def near_features(first: Float, second: Float, band_mm: float) -> FeaturePairs:
    """All vertex-face and edge-edge pairs closer than a band, from K disjoint triangle pairs.

    Parameters
    ----------
    first, second : (K, 3 or 6, 3) float64
        Corners of each triangle, counter-clockwise from outside, mm; then, where the surface is known, the far corners
        of its neighbours, in the order of :func:`with_neighbours`.
    band_mm : float
        Largest distance.

    Returns
    -------
    FeaturePairs
        Only those that face one another: the way from first to second leaves the first triangle's outside and enters
        the second's. Edges react only where no triangle that is given comes nearer than the edge, so a valley or a
        line drawn on a flat face is no edge, provided that neighbours are given.
    """
    normals = _normals(first), _normals(second)
    kept = [_within(c, normals, band_mm) for c in (*_vertex_face(first, second), *_edge_edge(first, second))]
    return FeaturePairs(*(np.concatenate(parts) for parts in zip(*kept, strict=True)))


def with_neighbours(triangles: NDArray[np.int32]) -> NDArray[np.int32]:
    """(M, 6) corners of each triangle, then the far corner of the neighbour across each edge (corner k to k + 1).

    Parameters
    ----------
    triangles : (M, 3) int32
        Across an edge that is not shared by exactly two triangles, the triangle's own far corner stands.
    """
    start, end, far = (np.roll(triangles, -shift, axis=1).ravel() for shift in range(3))
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, group, count = np.unique(np.column_stack([low, high]), axis=0, return_inverse=True, return_counts=True)
    paired = np.flatnonzero(count[group] == 2)
    here, there = paired[np.argsort(group[paired], kind="stable")].reshape(-1, 2).T
    across = far.copy()
    across[here], across[there] = far[there], far[here]
    return np.column_stack([triangles, across.reshape(-1, 3)])


def _dot(a: Float, b: Float) -> Float:
    out: Float = np.einsum("...i,...i->...", a, b)
    return out


def _normals(corners: Float) -> Float:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _within(c: _Candidates, normals: tuple[Float, Float], band_mm: float) -> FeaturePairs:
    away = c.on_second - c.on_first
    distance = np.sqrt(_dot(away, away))
    facing = _not_against(away, normals[0]) & _not_against(-away, normals[1])
    keep = c.genuine & facing & (distance > 0) & (distance <= band_mm)
    return FeaturePairs(c.on_first[keep], c.on_second[keep], distance[keep])


def _not_against(a: Float, b: Float, tolerance: float = ROUNDING) -> NDArray[np.bool_]:
    """Whether vectors (K, 3) make at most a right angle; the tolerance is a cosine."""
    return np.asarray(_dot(a, b) >= -tolerance * np.sqrt(_dot(a, a) * _dot(b, b)))


def _vertex_face(first: Float, second: Float) -> list[_Candidates]:
    out = []
    for corner in range(3):
        foot, inside = _foot_on_face(first[:, corner], second)
        out.append(_Candidates(first[:, corner], foot, inside))
        foot, inside = _foot_on_face(second[:, corner], first)
        out.append(_Candidates(foot, second[:, corner], inside))
    return out


def _foot_on_face(points: Float, corners: Float) -> tuple[Float, NDArray[np.bool_]]:
    """Foot of the perpendicular on each triangle's plane, and whether it lies in the triangle."""
    a = corners[:, 0]
    ab, ac, ap = corners[:, 1] - a, corners[:, 2] - a, points - a
    normal = np.cross(ab, ac)
    area2 = np.maximum(_dot(normal, normal), TINY)
    v = _dot(np.cross(ap, ac), normal) / area2
    w = _dot(np.cross(ab, ap), normal) / area2
    inside = (v >= -ROUNDING) & (w >= -ROUNDING) & (v + w <= 1 + ROUNDING)
    return a + v[:, None] * ab + w[:, None] * ac, inside


def _edge_edge(first: Float, second: Float) -> list[_Candidates]:
    return [_feet_on_edges(_about_edge(first, i), _about_edge(second, j)) for i in range(3) for j in range(3)]


def _about_edge(corners: Float, edge: int) -> Float:
    """(K, 3 or 4, 3) the two ends of an edge, the triangle's third corner, the neighbour's far corner."""
    order = [edge, (edge + 1) % 3, (edge + 2) % 3]
    return corners[:, [*order, 3 + edge] if corners.shape[1] == 6 else order]


def _feet_on_edges(first: Float, second: Float) -> _Candidates:
    """Feet of the common perpendicular of two lines, genuine where inside both edges and where these come nearest."""
    d1, d2 = first[:, 1] - first[:, 0], second[:, 1] - second[:, 0]
    r = first[:, 0] - second[:, 0]
    a, e, b = _dot(d1, d1), _dot(d2, d2), _dot(d1, d2)
    c, f = _dot(d1, r), _dot(d2, r)
    crossing = a * e - b * b
    skew = crossing > 1e-12 * a * e
    crossing = np.where(skew, crossing, 1.0)
    s, t = (b * f - c * e) / crossing, (a * f - b * c) / crossing
    inside = skew & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    on_first, on_second = first[:, 0] + s[:, None] * d1, second[:, 0] + t[:, None] * d2
    away = on_second - on_first
    return _Candidates(on_first, on_second, inside & _behind(first, on_first, away) & _behind(second, on_second, -away))


def _behind(about: Float, foot: Float, away: Float) -> NDArray[np.bool_]:
    """Whether the triangles at an edge fall back from it, seen from the other surface."""
    distant = about[:, 2:].swapaxes(0, 1)
    return np.asarray(np.all([_not_against(away, foot - far, NEARLY_PARALLEL) for far in distant], axis=0))
