"""Where one surface rests on another, as one point: the middle of the part that lies nearest.

Distances are those to the planes of the nearest facets: off by about h^2 / (6 R) for facets of size h on a surface of
radius R, 0.005 mm for 0.7 mm on a condyle, which the width of the band makes harmless.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mesh import Float, TriangleMesh, face_normals, triangle_areas

#: Triangles with a longer edge are cut into parts.
FACET_MM = 2.0
#: Triangles are cut into at most so many parts along an edge.
MOST_PARTS = 32


class Facets(NamedTuple):
    """Small flat parts of a surface: middles (N, 3), outward unit normals (N, 3), areas (N,); mm and mm2."""

    middles: Float
    normals: Float
    areas: Float

    def chosen(self, which: NDArray[np.bool_]) -> Facets:
        """Those that are chosen (N,)."""
        return Facets(self.middles[which], self.normals[which], self.areas[which])


class Middle(NamedTuple):
    """Where a patch lies nearest: the least distance (mm), and area and middle (3,) of what is hardly farther."""

    gap_mm: float
    area_mm2: float
    place: Float


def facets(mesh: TriangleMesh) -> Facets:
    """The triangles of a mesh, long ones cut into parts that are similar to them."""
    corners = mesh.points[mesh.triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.clip(np.ceil(longest / FACET_MM), 1, MOST_PARTS).astype(int)
    normals, areas, out = face_normals(mesh), triangle_areas(mesh), []
    for count in np.unique(parts).tolist():
        these = np.flatnonzero(parts == count)
        middles = np.einsum("wk,tkd->twd", _weights(count), corners[these]).reshape(-1, 3)
        out.append((middles, np.repeat(normals[these], count**2, axis=0), np.repeat(areas[these] / count**2, count**2)))
    return Facets(*(np.concatenate(each) for each in zip(*out, strict=True)))


def _weights(parts: int) -> Float:
    """(parts^2, 3) barycentric weights of the middles of the parts of a triangle, upright ones and turned ones."""
    i, j = (index.ravel() for index in np.meshgrid(np.arange(parts), np.arange(parts), indexing="ij"))
    upright, turned = i + j < parts, i + j < parts - 1
    first = np.concatenate([i[upright] + 1.0 / 3.0, i[turned] + 2.0 / 3.0]) / parts
    second = np.concatenate([j[upright] + 1.0 / 3.0, j[turned] + 2.0 / 3.0]) / parts
    return np.column_stack([first, second, 1.0 - first - second])


class FacetPlanes:
    """A surface made ready to be asked how far points are from it.

    Parameters
    ----------
    surface : Facets
    """

    def __init__(self, surface: Facets) -> None:
        from scipy.spatial import KDTree  # noqa: PLC0415 - slow to import, and runs of cached stages never need it

        self._surface = surface
        self._tree = KDTree(surface.middles, balanced_tree=False)

    def distances(self, points: Float, reach_mm: float) -> Float:
        """(N,) signed distance of points (N, 3), negative inside, mm; infinite without a facet within ``reach_mm``."""
        away, facet = (np.asarray(of_point) for of_point in self._tree.query(points, distance_upper_bound=reach_mm))
        near = np.isfinite(away)
        out = np.full(len(points), np.inf)
        offset = points[near] - self._surface.middles[facet[near]]
        out[near] = np.einsum("ij,ij->i", offset, self._surface.normals[facet[near]])
        return out


def middle_of_contact(patch: Facets, distances_mm: Float, band_mm: float) -> Middle | None:
    """The middle of the area of a patch that is at most ``band_mm`` farther than its nearest facet.

    Parameters
    ----------
    patch : Facets
    distances_mm : (N,) float64
        Of its facets from the other surface; infinite where too far to be known.
    band_mm : float

    Returns
    -------
    Middle or None
        None where no distance is known. A patch that touches in several spots has its middle between them.
    """
    gap = float(distances_mm.min(initial=np.inf))
    if not np.isfinite(gap):
        return None
    near = distances_mm <= gap + band_mm
    area = float(patch.areas[near].sum())
    return Middle(gap, area, patch.areas[near] @ patch.middles[near] / area)
