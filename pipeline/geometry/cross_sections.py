"""Cross-sections of closed meshes: area and centroid along an axis, and the straight line through a shaft."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mesh import TriangleMesh

Float = NDArray[np.float64]


class Sections(NamedTuple):
    """Cross-sections orthogonal to an axis: heights (K,) along it, areas (K,) mm^2, centroids (K, 3) mm."""

    heights: Float
    areas: Float
    centroids: Float


def cross_sections(mesh: TriangleMesh, axis: Float, heights: Float) -> Sections:
    """Area and centroid of the mesh's section at each height; heights that miss the mesh are left out.

    Parameters
    ----------
    mesh : TriangleMesh
        Closed, outward.
    axis : (3,) float64
        Unit normal of the planes.
    heights : (K,) float64
        ``point @ axis`` of each plane, mm.
    """
    along = mesh.points @ axis
    cuts = [_section(mesh, axis, along - height) for height in heights]
    kept = [(h, *cut) for h, cut in zip(heights, cuts, strict=True) if cut is not None]
    if not kept:
        return Sections(np.empty(0), np.empty(0), np.empty((0, 3)))
    h, area, centroid = zip(*kept, strict=True)
    return Sections(np.array(h), np.array(area), np.array(centroid))


def _section(mesh: TriangleMesh, axis: Float, above: Float) -> tuple[float, Float] | None:
    """Signed sums over the oriented segments in which the triangles meet the plane: no contour has to be followed."""
    positive = above[mesh.triangles] > 0.0
    count = positive.sum(axis=1)
    crossing = (count == 1) | (count == 2)
    if not crossing.any():
        return None
    start, end = _segments(mesh.points, mesh.triangles[crossing], above, count[crossing] == 1)
    origin = start.mean(axis=0)
    a, b = start - origin, end - origin
    weight = np.cross(a, b) @ axis
    total = float(weight.sum())
    if abs(total) < 1e-9:
        return None
    return abs(total) / 2.0, origin + ((a + b) * weight[:, None]).sum(axis=0) / (3.0 * total)


def _segments(
    points: Float, triangles: NDArray[np.int32], above: Float, tip_above: NDArray[np.bool_]
) -> tuple[Float, Float]:
    """End points of each triangle's cut, oriented by the triangle; the tip is the vertex alone on its side."""
    lone = np.where(tip_above, np.argmax(above[triangles] > 0, axis=1), np.argmin(above[triangles] > 0, axis=1))
    row = np.arange(len(triangles))
    tip, second, third = (triangles[row, (lone + k) % 3] for k in range(3))
    p, q = _crossing(points, above, tip, second), _crossing(points, above, tip, third)
    forward = tip_above[:, None]
    return np.where(forward, p, q), np.where(forward, q, p)


def _crossing(points: Float, above: Float, a: NDArray[np.int32], b: NDArray[np.int32]) -> Float:
    share = (above[a] / (above[a] - above[b]))[:, None]
    out: Float = points[a] + share * (points[b] - points[a])
    return out


def volume_centroid(mesh: TriangleMesh) -> Float:
    """(3,) centroid of the enclosed volume."""
    a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
    origin = mesh.points.mean(axis=0)
    volumes = np.einsum("ij,ij->i", a - origin, np.cross(b - origin, c - origin))
    centroid: Float = origin + ((a + b + c - 3 * origin) * volumes[:, None]).sum(axis=0) / (4.0 * volumes.sum())
    return centroid
