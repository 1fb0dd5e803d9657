"""The reference seen along delta as a map of heights, and the gaps of points below it (compiled)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.kinematics.compilation import compiled
from pipeline.kinematics.direct.surfaces import FAR_MM, NOTHING_MM, SHARED, Float, HeightMap, Int, Rows, Surface

Index = NDArray[np.int64]


@compiled
def facing_below(surface: Surface, ceiling_mm: float, box: Float) -> Surface:
    """The triangles whose normal opposes z and whose lowest corner lies below a ceiling, and what they span.

    Parameters
    ----------
    surface : Surface
    ceiling_mm : float
    box : (4,) float64
        Written: least x and y, greatest x and y.
    """
    points, triangles, edges = surface.points, surface.triangles, surface.edges
    kept, numbers, count = np.empty_like(triangles), np.empty_like(edges), 0
    box[0], box[1], box[2], box[3] = np.inf, np.inf, -np.inf, -np.inf
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if min(points[a, 2], points[b, 2], points[c, 2]) > ceiling_mm:
            continue
        ux, uy = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
        vx, vy = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1]
        if ux * vy - vx * uy >= 0.0:
            continue
        for k in range(3):
            kept[count, k], numbers[count, k] = triangles[t, k], edges[t, k]
        count += 1
        for axis in range(2):
            box[axis] = min(box[axis], points[a, axis], points[b, axis], points[c, axis])
            box[axis + 2] = max(box[axis + 2], points[a, axis], points[b, axis], points[c, axis])
    return Surface(points, kept[:count], numbers[:count], surface.edge_count)


@compiled
def rasterise(points: Float, triangles: Int, heights: HeightMap) -> None:
    """Lower the nodes of a height map to the triangles above them whose normal opposes z."""
    z, per = heights.z, 1.0 / heights.spacing
    ny, nx = z.shape
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        # in units of the spacing, from node (0, 0)
        ax, ay, az = (points[a, 0] - heights.x0) * per, (points[a, 1] - heights.y0) * per, points[a, 2]
        bx, by = (points[b, 0] - heights.x0) * per, (points[b, 1] - heights.y0) * per
        cx, cy = (points[c, 0] - heights.x0) * per, (points[c, 1] - heights.y0) * per
        det = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        i0, i1 = max(int(np.ceil(min(ax, bx, cx))), 0), min(int(np.floor(max(ax, bx, cx))), nx - 1)
        j0, j1 = max(int(np.ceil(min(ay, by, cy))), 0), min(int(np.floor(max(ay, by, cy))), ny - 1)
        if det >= 0.0 or i0 > i1 or j0 > j1:
            continue
        per_det = 1.0 / det
        vx, vy = (cy - ay) * per_det, (ax - cx) * per_det
        wx, wy = (ay - by) * per_det, (bx - ax) * per_det
        uz, wz = points[b, 2] - az, points[c, 2] - az
        for j in range(j0, j1 + 1):
            for i in range(i0, i1 + 1):
                v = (i - ax) * vx + (j - ay) * vy
                w = (i - ax) * wx + (j - ay) * wy
                if min(v, w, 1.0 - v - w) >= -SHARED:
                    z[j, i] = min(z[j, i], az + v * uz + w * wz)


@compiled
def gaps_at(heights: HeightMap, samples: Float, chosen: Index, pose: Float, found: Rows) -> float:
    """Gap along z of each chosen sample at a pose, and its change per mm of x, of y and per rad of theta.

    Parameters
    ----------
    heights : HeightMap
    samples : (S, 3) float64
    chosen : (K,) int64
        Samples to look at.
    pose : (3,) float64
        x, y (mm) and theta (rad).
    found : Rows
        Written at ``chosen``; gaps are ``NOTHING_MM`` where the reference is not above the sample.

    Returns
    -------
    float
        The least gap.
    """
    ny, nx = heights.z.shape
    c, s, per = np.cos(pose[2]), np.sin(pose[2]), 1.0 / heights.spacing
    gaps, rates, z = found.gaps, found.rates, heights.z
    least = NOTHING_MM
    for k in chosen:
        rx = c * samples[k, 0] - s * samples[k, 1]
        ry = s * samples[k, 0] + c * samples[k, 1]
        u, v = (rx + pose[0] - heights.x0) * per, (ry + pose[1] - heights.y0) * per
        gaps[k] = NOTHING_MM
        if min(u, v, nx - 1 - u, ny - 1 - v) <= 0.0:
            continue
        i, j = int(u), int(v)
        z00, z01, z10, z11 = z[j, i], z[j, i + 1], z[j + 1, i], z[j + 1, i + 1]
        if max(z00, z01, z10, z11) > FAR_MM:
            continue
        u, v = u - i, v - j
        gaps[k] = (z00 * (1.0 - u) + z01 * u) * (1.0 - v) + (z10 * (1.0 - u) + z11 * u) * v - samples[k, 2]
        rates[k, 0] = ((z01 - z00) * (1.0 - v) + (z11 - z10) * v) * per
        rates[k, 1] = ((z10 - z00) * (1.0 - u) + (z11 - z01) * u) * per
        rates[k, 2] = rates[k, 1] * rx - rates[k, 0] * ry
        least = min(least, gaps[k])
    return least
