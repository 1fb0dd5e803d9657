"""The flexion axis of the femur: a line through the centres of spheres fitted to the two posterior condyles.

The posterior part of each condyle, which carries the knee from about 20 deg of flexion on, is close to a sphere
(Kurosawa et al. 1985, J Biomech 18:487); its centre is found to a few tenths of a millimetre although the patch is
small. The axis is fitted again with narrower, wider and shifted patches; their spread, and what the residual of the fit
does to the centres, make its uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.directions import angle_deg, unit
from pipeline.geometry.mesh import TriangleMesh, vertex_normals

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

#: How far above the most distal point the condyles reach, and where the notch may be looked for, mm.
EPIPHYSIS_MM = 45.0
NOTCH_FROM_MM = 6.0


@dataclass(frozen=True)
class Patch:
    """Part of a condyle that is fitted: angles from distal (0) over posterior (90 deg), half width of the strip."""

    from_deg: float
    to_deg: float
    half_width_mm: float


BEST_PATCH = Patch(20.0, 110.0, 8.0)
OTHER_PATCHES = (
    Patch(30.0, 110.0, 8.0),
    Patch(20.0, 100.0, 8.0),
    Patch(20.0, 110.0, 6.0),
    Patch(20.0, 110.0, 10.0),
    Patch(10.0, 100.0, 8.0),
    Patch(30.0, 120.0, 8.0),
)


#: How far a fitted centre strays per RMS of the fit. Eight phantoms with 0.15 mm of smooth unevenness (8 to 25 mm
#: wavelength) had their axis off by 0.6 deg in the median, 45 mm between the centres.
CENTRE_PER_UNEVENNESS = 2.5


class Sphere(NamedTuple):
    """Centre (3,), radius and root mean square distance of the fitted points, mm."""

    centre: Float
    radius: float
    rms: float


class CondyleAxis(NamedTuple):
    """Spheres of both posterior condyles and the axis from medial to lateral, with its spread in degrees."""

    medial: Sphere
    lateral: Sphere
    direction: Float
    uncertainty_deg: float


def condyle_axis(femur: TriangleMesh, rough_axes: Float) -> CondyleAxis:
    """Fit both posterior condyles.

    Parameters
    ----------
    femur : TriangleMesh
        At least the distal 45 mm.
    rough_axes : (3, 3) float64
        Rows: lateral, anterior, proximal, unit, to within about 20 deg.

    Raises
    ------
    ValueError
        When no two posterior condyles can be told apart.

    Notes
    -----
    The patches are chosen relative to the axes, so the fit is repeated with axes built on its own result.
    """
    axes = rough_axes
    for _ in range(3):
        medial, lateral = _spheres(femur, axes, BEST_PATCH)
        axes = _axes_on(unit(lateral.centre - medial.centre), axes)
    direction = axes[0]
    others = [_spheres(femur, axes, patch) for patch in OTHER_PATCHES]
    spread = [angle_deg(direction, unit(there.centre - here.centre)) for here, there in others]
    uncertainty = np.hypot(np.sqrt(np.mean(np.square(spread))), _unevenness_deg(medial, lateral))
    return CondyleAxis(medial, lateral, direction, float(uncertainty))


def _unevenness_deg(medial: Sphere, lateral: Sphere) -> float:
    """What the unevenness of the condyles does to the axis; other patches on the same bumps do not show it."""
    apart = float(np.linalg.norm(lateral.centre - medial.centre))
    return float(np.degrees(np.arctan2(CENTRE_PER_UNEVENNESS * np.hypot(medial.rms, lateral.rms), apart)))


def _axes_on(lateral: Float, axes: Float) -> Float:
    """Axes with the given lateral direction and the proximal one as near as can be to the old; handedness kept."""
    handed = np.sign(np.linalg.det(axes))
    anterior = unit(np.cross(axes[2], lateral)) * handed
    return np.stack([lateral, anterior, np.cross(lateral, anterior) * handed])


def _spheres(femur: TriangleMesh, axes: Float, patch: Patch) -> tuple[Sphere, Sphere]:
    local = femur.points @ axes.T
    normals = vertex_normals(femur) @ axes.T
    epiphysis = local[:, 2] < local[:, 2].min() + EPIPHYSIS_MM
    notch = _notch(local[epiphysis & (local[:, 2] > local[:, 2].min() + NOTCH_FROM_MM)])
    tilt = np.degrees(np.arctan2(-normals[:, 1], -normals[:, 2]))
    facing = epiphysis & (tilt > patch.from_deg) & (tilt < patch.to_deg) & (np.abs(normals[:, 0]) < 0.6)
    medial, lateral = (_condyle(local[facing & (sense * (local[:, 0] - notch) > 3.0)], patch) for sense in (-1.0, 1.0))
    return tuple(s._replace(centre=s.centre @ axes) for s in (medial, lateral))  # type: ignore[return-value]


def _notch(local: Float) -> float:
    """Lateral coordinate of the notch: where the posterior outline of the epiphysis is farthest forward."""
    if not len(local):
        raise ValueError("the femur is too short to show its condyles")
    low, high = np.quantile(local[:, 0], [0.01, 0.99])
    edges = np.linspace(low + 0.25 * (high - low), low + 0.75 * (high - low), 27)
    strip = np.digitize(local[:, 0], edges)
    outline = [local[strip == k, 1].min(initial=np.inf) for k in range(1, len(edges))]
    known = np.where(np.isfinite(outline), outline, -np.inf)
    k = int(np.argmax(known))
    return float(0.5 * (edges[k] + edges[k + 1]))


def _condyle(points: Float, patch: Patch) -> Sphere:
    if len(points) < 8:
        raise ValueError("no posterior condyle was found on one side of the femur")
    most_posterior = points[points[:, 1] < points[:, 1].min() + 3.0]
    strip = points[np.abs(points[:, 0] - np.median(most_posterior[:, 0])) < patch.half_width_mm]
    sphere = fit_sphere(strip)
    for _ in range(3):
        arm = strip - sphere.centre
        seen = np.degrees(np.arctan2(-arm[:, 1], -arm[:, 2]))
        sphere = fit_sphere(strip[(seen > patch.from_deg) & (seen < patch.to_deg)])
    return sphere


def fit_sphere(points: Float) -> Sphere:
    """Least-squares sphere of points (N, 3), those beyond 2.5 robust standard deviations left out in turn.

    Raises
    ------
    ValueError
        For fewer than 8 points.
    """
    kept = np.ones(len(points), dtype=np.bool_)
    sphere = _algebraic_sphere(points, kept)
    for _ in range(5):
        distance = np.abs(np.linalg.norm(points - sphere.centre, axis=1) - sphere.radius)
        kept = distance <= 2.5 * max(1.4826 * float(np.median(distance[kept])), 0.1)
        sphere = _algebraic_sphere(points, kept)
    return sphere


def _algebraic_sphere(points: Float, kept: Bool) -> Sphere:
    used = points[kept]
    if len(used) < 8:
        raise ValueError(f"a sphere needs at least 8 points, got {len(used)}")
    middle = used.mean(axis=0)
    p = used - middle
    solution = np.linalg.lstsq(np.column_stack([2.0 * p, np.ones(len(p))]), (p**2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(solution[3] + solution[:3] @ solution[:3]))
    rms = float(np.sqrt(np.mean((np.linalg.norm(p - solution[:3], axis=1) - radius) ** 2)))
    return Sphere(middle + solution[:3], radius, rms)
