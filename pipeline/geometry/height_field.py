"""Surfaces seen along one direction: how high they lie over a plane, or how far from an axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mesh import TriangleMesh

Float = NDArray[np.float64]

#: A triangle is sampled so that neighbouring samples are at most this share of a cell apart.
SAMPLES_PER_CELL = 1.5
#: Triangles are cut into at most so many parts along an edge.
MOST_PARTS = 64


@dataclass(frozen=True, eq=False)
class Raster:
    """The cells of a field: ``first`` is the centre of cell (0, 0), in the units of the two coordinates."""

    first: tuple[float, float]
    step: tuple[float, float]
    shape: tuple[int, int]

    def axes(self) -> tuple[Float, Float]:
        """(N,) and (M,) centres of the cells along both coordinates."""
        u: Float = self.first[0] + self.step[0] * np.arange(float(self.shape[0]))
        v: Float = self.first[1] + self.step[1] * np.arange(float(self.shape[1]))
        return u, v

    def position(self, u: Float, v: Float) -> Float:
        """(2, ...) fractional indices of places."""
        return np.stack([(u - self.first[0]) / self.step[0], (v - self.first[1]) / self.step[1]])


def surface_samples(mesh: TriangleMesh, spacing_mm: float) -> Float:
    """(N, 3) points spread over every triangle, neighbours of one triangle at most ``spacing_mm`` apart."""
    corners = mesh.points[mesh.triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.clip(np.ceil(longest / spacing_mm), 1, MOST_PARTS).astype(int)
    parts = 2 ** np.ceil(np.log2(parts)).astype(int)  # few different sizes, so few groups
    out = [np.einsum("wk,tkd->twd", _weights(int(n)), corners[parts == n]).reshape(-1, 3) for n in np.unique(parts)]
    return np.concatenate(out)


def _weights(parts: int) -> Float:
    """(W, 3) barycentric weights of the corners of a triangle cut into parts."""
    i, j = np.meshgrid(np.arange(parts + 1), np.arange(parts + 1), indexing="ij")
    inside = i + j <= parts
    first, second = i[inside] / parts, j[inside] / parts
    return np.column_stack([first, second, 1.0 - first - second])


def highest(places: tuple[Float, Float], heights: Float, raster: Raster) -> Float:
    """(N, M) greatest height of the samples in each cell; NaN where there is none.

    Single empty cells between others are no holes of the surface but of its sampling: choose the spacing of samples
    below that of the cells.
    """
    field = np.full(raster.shape, -np.inf)
    index = np.rint(raster.position(*places)).astype(int)
    inside = ((index >= 0) & (index < np.array(raster.shape)[:, None])).all(axis=0)
    np.maximum.at(field, tuple(index[:, inside]), heights[inside])
    return np.where(np.isfinite(field), field, np.nan)


def eased(values: Float, low: float, high: float) -> Float:
    """0 below ``low``, 1 above ``high``, a smooth step between (3 t^2 - 2 t^3)."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def smoothed(field: Float, sigma_cells: float) -> Float:
    """The field blurred by a Gaussian over its known cells; unknown ones stay NaN."""
    from scipy import ndimage  # noqa: PLC0415 - half a second that a run of cached stages need not pay

    known = np.isfinite(field)
    weight = ndimage.gaussian_filter(known.astype(np.float64), sigma_cells)
    blurred = ndimage.gaussian_filter(np.where(known, field, 0.0), sigma_cells)
    return np.where(known, blurred / np.maximum(weight, 1e-9), np.nan)
