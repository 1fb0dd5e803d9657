"""Where a knee's label map comes to rest, by brute force on height maps: shares no code with the project's solvers.

The femur seen along the push is a height map, the tibial side a cloud of its top points; how far the cloud can be
pushed at an offset (x, y, rotation) is the smallest difference, and the resting place is found by trying all
neighbours and halving the step.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

Float = NDArray[np.float64]

_STEP_MM = 0.7
_FAR_MM = 60.0
_X = np.arange(-40.0, 40.1, _STEP_MM)
_Y = np.arange(-27.0, 27.1, _STEP_MM)
_MOVES = [np.array(move, dtype=np.float64) for move in product((-1, 0, 1), repeat=3) if any(move)]


@dataclass(frozen=True, eq=False)
class Body:
    """Occupancy of a body, smoothed over a voxel, and (4, 4) from its frame to voxel indices."""

    occupancy: NDArray[np.float32]
    index_from_frame: Float


def body_of(mask: NDArray[np.bool_], lps_from_index: Float, lps_from_frame: Float) -> Body:
    """A body from its voxels, in the frame given."""
    occupancy = gaussian_filter(mask.astype(np.float32), 0.8)
    return Body(occupancy, np.linalg.inv(lps_from_index) @ lps_from_frame)


def first_surface(body: Body, frame_from_view: Float, heights: Float) -> Float:
    """Height (X, Y) at which columns, followed along ``heights``, enter the body; NaN where they do not."""
    x, y, z = np.meshgrid(_X, _Y, heights, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel(), np.ones(x.size)])
    transform = body.index_from_frame @ frame_from_view
    inside = map_coordinates(body.occupancy, (transform @ points)[:3], order=1).reshape(x.shape) - 0.5
    enters = (inside[:, :, 1:] > 0) & (inside[:, :, :-1] <= 0)
    first = enters.argmax(axis=2)
    before, after = (np.take_along_axis(inside, (first + k)[:, :, None], axis=2)[:, :, 0] for k in (0, 1))
    share = before / np.where(enters.any(axis=2), before - after, 1.0)
    height = heights[first] + share * (heights[1] - heights[0])
    return np.where(enters.any(axis=2), height, np.nan)


def top_points(body: Body) -> Float:
    """Points (3, N) of the top of the tibial side in its own frame."""
    top = first_surface(body, np.eye(4), np.arange(12.0, -4.0, -_STEP_MM))
    x, y = np.meshgrid(_X, _Y, indexing="ij")
    seen = np.isfinite(top)
    return np.stack([x[seen], y[seen], top[seen]])


def lower_surface(femur: Body, flexion_deg: float, varus_deg: float) -> Float:
    """Height map (X, Y) of the femur's lower surface in the attitude frame."""
    f, v = np.deg2rad([flexion_deg, varus_deg])
    about_x = np.array([[1, 0, 0], [0, np.cos(f), np.sin(f)], [0, -np.sin(f), np.cos(f)]])
    about_y = np.array([[np.cos(v), 0, np.sin(v)], [0, 1, 0], [-np.sin(v), 0, np.cos(v)]])
    frame_from_view = np.eye(4)
    frame_from_view[:3, :3] = about_x @ about_y
    return first_surface(femur, frame_from_view, np.arange(-32.0, -2.0, _STEP_MM))


def travel_mm(surface: Float, points: Float, offset: Float) -> float:
    """How far the points can be pushed at offset (x mm, y mm, rotation deg) before they touch the surface."""
    c, s = np.cos(np.deg2rad(offset[2])), np.sin(np.deg2rad(offset[2]))
    u = (c * points[0] - s * points[1] + offset[0] - _X[0]) / _STEP_MM
    v = (s * points[0] + c * points[1] + offset[1] - _Y[0]) / _STEP_MM
    filled = np.where(np.isfinite(surface), surface, _FAR_MM)
    return float((map_coordinates(filled, [u, v], order=1, cval=_FAR_MM) - points[2]).min())


def resting_offset(surface: Float, points: Float, start: Float) -> Float:
    """Offset (x mm, y mm, rotation deg) where nothing near goes deeper, climbing from ``start``."""
    offset, step = start.copy(), np.array([1.0, 1.0, 2.0])
    best = travel_mm(surface, points, offset)
    while step[0] > 0.2:
        trials = [offset + move * step for move in _MOVES]
        travels = [travel_mm(surface, points, trial) for trial in trials]
        if max(travels) > best + 1e-6:
            best, offset = max(travels), trials[int(np.argmax(travels))]
        else:
            step = step / 2
    return offset
