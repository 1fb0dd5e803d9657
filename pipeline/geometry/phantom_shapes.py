"""Solids as fields: functions of points that are negative inside, and near the surface about the distance to it.

Points are arrays (3, N) of x (lateral), y (anterior), z (proximal) in millimetres. Fields are arrays (N,).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Bools = NDArray[np.bool_]

#: Angle, from distal to anterior, over which the larger distal radius of a condyle reaches before the trochlea.
_DISTAL_ARC_RAD = np.deg2rad(55.0)


def union(first: Float, second: Float, blend_mm: Float | float) -> Float:
    """Field (N,) of two solids together, the edge where they meet filled with a fillet of size ``blend_mm``.

    Quadratic polynomial smooth minimum (Quilez): deviates only where the two fields differ by less than the blend.
    """
    overlap = np.maximum(blend_mm - np.abs(first - second), 0.0)
    return np.asarray(np.minimum(first, second) - overlap * overlap / (4 * blend_mm))


def intersection(first: Float, second: Float, blend_mm: Float | float) -> Float:
    """Field (N,) of what two solids share, the edge where they meet rounded; see :func:`union`."""
    return -union(-first, -second, blend_mm)


def ellipsoid(points: Float, centre: tuple[float, float, float], semi_axes: tuple[float, float, float]) -> Float:
    """Field (N,) of an ellipsoid with its axes along x, y, z; millimetres along its shortest axis."""
    axes = np.asarray(semi_axes)[:, None]
    scaled = (points - np.asarray(centre)[:, None]) / axes
    return np.asarray((np.sqrt(np.einsum("in,in->n", scaled, scaled)) - 1.0) * axes.min())


def ellipse(first: Float, second: Float, semi_first: Float | float, semi_second: Float | float) -> Float:
    """Field (N,) of an elliptical column of centred coordinates; its semi-axes may change along the column."""
    return np.asarray((np.hypot(first / semi_first, second / semi_second) - 1.0) * np.minimum(semi_first, semi_second))


def ramp(values: Float, start: float, end: float) -> Float:
    """0 up to ``start``, 1 from ``end``, smooth (C1) between; ``start`` may be the larger one."""
    t = np.clip((values - start) / (end - start), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


@dataclass(frozen=True)
class Condyles:
    """The two femoral condyles with their cartilage, about the flexion axis x.

    Attributes
    ----------
    middle_mm : float
        Distance of each mid-plane from x = 0.
    medial_radius_mm, lateral_radius_mm : float
        Posterior radius in the mid-plane.
    excess_mm : float
        The distal radius is larger by this.
    half_width_mm, crown_mm : float
        Semi-axes of the elliptical coronal profile, along the axis and towards it.
    """

    middle_mm: float
    medial_radius_mm: float
    lateral_radius_mm: float
    excess_mm: float
    half_width_mm: float
    crown_mm: float


def reach_mm(shape: Condyles, radius_mm: float, varus_rad: float) -> float:
    """How far a condyle reaches from its centre along the push: the support function of its coronal profile.

    Holds for every flexion from full extension on, where the lowest point lies on the posterior arc.
    """
    along, across = np.sin(varus_rad), np.cos(varus_rad)
    rim = np.hypot(shape.half_width_mm * along, shape.crown_mm * across)
    return float((radius_mm - shape.crown_mm) * across + rim)


def condyles_field(points: Float, shape: Condyles) -> Float:
    """Field (N,) of the condyles; each point sees the one on its side of x = 0.

    The sagittal outline is moved inwards by the crown, elliptically across the width. Behind full extension's
    contact the outline is a circle about the axis, so that each condyle is a surface of revolution there.
    """
    across = (np.abs(points[0]) - shape.middle_mm) / shape.half_width_mm
    above_rim = np.maximum(_above_edge_mm(points, shape), 0.0) / shape.crown_mm
    return np.asarray((np.hypot(across, above_rim) - 1.0) * shape.crown_mm)


def depth_below_condyles(points: Float, shape: Condyles) -> Float:
    """Depth (N,) below the articular surface of the condyle on the same side, in planes across the flexion axis.

    Beside the condyle it is measured to the surface at the nearest edge of its width.
    """
    across = np.clip((np.abs(points[0]) - shape.middle_mm) / shape.half_width_mm, -1.0, 1.0)
    return np.asarray(shape.crown_mm * np.sqrt(1.0 - across * across) - _above_edge_mm(points, shape))


def _above_edge_mm(points: Float, shape: Condyles) -> Float:
    """Height (N,) above the level that the articular surface has at the edges of the condyle's width."""
    radius = np.where(points[0] < 0.0, shape.medial_radius_mm, shape.lateral_radius_mm)
    return _distance_to_core(points[1], points[2], shape.excess_mm) - (radius - shape.crown_mm)


def _distance_to_core(y: Float, z: Float, arc_radius_mm: float) -> Float:
    """Distance (N,) to the core of the sagittal outline, which is the core grown by the condyle's radius.

    The core is a circular arc that starts on the flexion axis and turns from distal to anterior about a point
    ``arc_radius_mm`` above the axis. Grown, it has arcs of the radius (posterior), of the radius + ``arc_radius_mm``
    (distal) and of the radius again (towards the trochlea), with continuous tangents.
    """
    end_y, end_z = arc_radius_mm * np.sin(_DISTAL_ARC_RAD), arc_radius_mm * (1.0 - np.cos(_DISTAL_ARC_RAD))
    angle = np.arctan2(y, arc_radius_mm - z)
    to_arc = np.abs(np.hypot(y, z - arc_radius_mm) - arc_radius_mm)
    to_ends = np.minimum(np.hypot(y, z), np.hypot(y - end_y, z - end_z))
    return np.asarray(np.where((angle > 0.0) & (angle < _DISTAL_ARC_RAD), to_arc, to_ends))


@dataclass(frozen=True, eq=False)
class Unevenness:
    """A smooth random field: a sum of plane waves, the same for any voxel grid.

    Attributes
    ----------
    waves_per_mm : (W, 3) float64
    phases : (W,) float64
    amplitude_mm : float
        Of each wave.
    """

    waves_per_mm: Float
    phases: Float
    amplitude_mm: float

    def added_to(self, field: Float, points: Float) -> Float:
        """A solid's field (N,) with the unevenness on its surface; it is left as it is where that is out of reach."""
        near = np.abs(field) < self.amplitude_mm * len(self.phases)
        out = field.copy()
        at = points[:, near]
        for (x, y, z), phase in zip(self.waves_per_mm, self.phases, strict=True):
            out[near] += self.amplitude_mm * np.cos(x * at[0] + y * at[1] + z * at[2] + phase)
        return out


def unevenness(rms_mm: float, seed: int, part: int) -> Unevenness:
    """A random field of the given RMS, wavelengths of 8 to 25 mm in random directions; another for each part."""
    count = 24
    random = np.random.default_rng((seed, part))
    direction = random.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    waves = direction * (2 * np.pi / random.uniform(8.0, 25.0, size=(count, 1)))
    return Unevenness(waves, random.uniform(0.0, 2 * np.pi, size=count), rms_mm * float(np.sqrt(2.0 / count)))
