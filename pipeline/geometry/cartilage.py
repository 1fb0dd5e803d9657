"""Cartilage that a CT does not show: articular patches found on the bones, with a thickness from the joint space.

The femoral patch is what faces away from the flexion axis between trochlea and posterior condyles, held as a radius
about that axis; the tibial patches are what faces proximally on either side of the eminence, held as a height along
delta. Both bones are those of a right knee in their kinematic frames (x lateral, y anterior, z proximal), the femur's
origin on the flexion axis, the tibia's between the plateaus.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.height_field import Raster, eased, highest, smoothed, surface_samples
from pipeline.geometry.mesh import TriangleMesh

Float = NDArray[np.float64]

#: Cells of the fields, mm (along the arc at the radius of a condyle for the angle).
CELL_MM = 0.5
#: Where the femoral patch ends, degrees about the flexion axis from distal: anterior (trochlea) and posterior.
TROCHLEA_DEG, POSTERIOR_DEG = -95.0, 140.0
#: Pieces of a femoral patch smaller than this share of the largest are no cartilage.
LEAST_PIECE = 0.2
#: Fields are blurred by this before slopes are taken (mm).
BLUR_MM = 1.0
#: Bones farther apart than this are not those of a joint at rest (mm).
WIDEST_SPACE_MM = 10.0
#: Half the width of the strip over the eminence that belongs to no compartment (mm).
EMINENCE_MM = 2.5


class RadialSurface(NamedTuple):
    """The femur seen from the flexion axis.

    Attributes
    ----------
    raster : Raster
        Of x (mm) and the angle from distal towards posterior (deg).
    radius_mm : (N, M) float64
        Outermost radius of the bone; NaN where there is none.
    facing : (N, M) float64
        Cosine between its normal and the direction away from the axis.
    patch : (N, M) float64
        1 on the articular surface, 0 off it, smooth between.
    condyle_mm : float
        Radius of the posterior condyles.
    """

    raster: Raster
    radius_mm: Float
    facing: Float
    patch: Float
    condyle_mm: float


class PlateauSurface(NamedTuple):
    """The tibia seen along delta: heights (mm), cosine of the slope, articular patch of each compartment."""

    raster: Raster
    height_mm: Float
    facing: Float
    medial: Float
    lateral: Float


class JointSpace(NamedTuple):
    """One compartment at the scan pose.

    Attributes
    ----------
    between_mm : float
        Least distance of the bones along the plateau's normal; NaN where the femur is not over it.
    femoral_mm, tibial_mm : float
        Thickness of the cartilage that fills it.
    from_scan : bool
        False where the distance is not that of a joint at rest, and the protocol's thickness was used.
    """

    between_mm: float
    femoral_mm: float
    tibial_mm: float
    from_scan: bool


def radial_surface(femur: TriangleMesh) -> RadialSurface:
    """The articular side of a femur in its reference frame.

    Raises
    ------
    ValueError
        When nothing lies where the posterior condyles should.
    """
    points = surface_samples(femur, CELL_MM / 1.5)
    points = points[np.hypot(points[:, 1], points[:, 2]) < 60.0]
    radius, angle = np.hypot(points[:, 1], points[:, 2]), np.degrees(np.arctan2(-points[:, 1], -points[:, 2]))
    behind = (np.abs(angle - 80.0) < 20.0) & (np.abs(points[:, 0]) < 45.0)
    if not behind.any():
        raise ValueError("the femur has no posterior condyles where the flexion axis says")
    step_deg = float(np.degrees(CELL_MM / 20.0))
    low = float(points[:, 0].min())
    width = int(np.ptp(points[:, 0]) / CELL_MM) + 2
    raster = Raster((low, -120.0), (CELL_MM, step_deg), (width, int(290.0 / step_deg)))
    field = highest((points[:, 0], angle), radius, raster)
    blurred = smoothed(field, BLUR_MM / CELL_MM)
    across, along = np.gradient(blurred, CELL_MM, np.radians(step_deg))
    facing = 1.0 / np.sqrt(1.0 + across**2 + (along / blurred) ** 2)
    behind = np.abs(raster.axes()[1] - 80.0) < 20.0
    condyle = float(np.nanmedian(field[:, behind][np.nan_to_num(facing[:, behind]) > 0.8]))
    return RadialSurface(raster, field, facing, _femoral_patch(raster, blurred / condyle, facing), condyle)


def _femoral_patch(raster: Raster, relative: Float, facing: Float) -> Float:
    """Where cartilage covers a femur: faces away from the axis, outside the notch, not on the shaft."""
    angle = raster.axes()[1][None, :]
    ends = eased(angle, TROCHLEA_DEG, TROCHLEA_DEG + 12.0) * eased(-angle, -POSTERIOR_DEG, 12.0 - POSTERIOR_DEG)
    shaft = np.where(angle > 80.0, eased(-relative, -1.3, -1.2), eased(-relative, -1.75, -1.65))
    patch = np.nan_to_num(eased(facing, 0.45, 0.65) * ends * eased(relative, 0.78, 0.88) * shaft)
    return _without_islands(patch)


def _without_islands(patch: Float) -> Float:
    """The patch without pieces below a fifth of its largest one: an epicondyle may face away from the axis too."""
    from scipy import ndimage  # noqa: PLC0415 - half a second that a run of cached stages need not pay

    pieces, count = ndimage.label(patch > 0.0)
    sizes = ndimage.sum_labels(patch, pieces, np.arange(1, count + 1))
    keep = np.concatenate([[False], sizes >= LEAST_PIECE * sizes.max(initial=0.0)])
    return np.where(keep[pieces], patch, 0.0)


def plateau_surface(tibia: TriangleMesh) -> PlateauSurface:
    """The articular side of a tibia in its moving frame.

    Raises
    ------
    ValueError
        When nothing faces proximally where a plateau should be.
    """
    points = surface_samples(tibia, CELL_MM / 1.5)
    points = points[points[:, 2] > -25.0]
    raster = Raster((-50.0, -45.0), (CELL_MM, CELL_MM), (201, 181))
    height = highest((points[:, 0], points[:, 1]), points[:, 2], raster)
    blurred = smoothed(height, BLUR_MM / CELL_MM)
    slopes = np.gradient(blurred, CELL_MM)
    facing = 1.0 / np.sqrt(1.0 + slopes[0] ** 2 + slopes[1] ** 2)
    sides = [_tibial_patch(raster, blurred, facing, side) for side in (-1.0, 1.0)]
    return PlateauSurface(raster, height, facing, sides[0], sides[1])


def _tibial_patch(raster: Raster, height: Float, facing: Float, side: float) -> Float:
    """Where cartilage covers one plateau: faces proximally, near the plateau's own height, off the eminence."""
    x, y = (axis.reshape(shape) for axis, shape in zip(raster.axes(), ((-1, 1), (1, -1)), strict=True))
    flat = (facing > 0.8) & (np.abs(side * x - 20.0) < 10.0) & (np.abs(y) < 15.0)
    if not flat.any():
        raise ValueError("the tibia has no plateau where its frame says")
    over = height - np.median(height[flat])
    patch = eased(facing, 0.5, 0.7) * eased(over, -7.0, -5.0) * eased(-over, -6.0, -4.0)
    patch = patch * eased(side * x, EMINENCE_MM - 1.5, EMINENCE_MM + 1.5) * eased(-np.abs(y), -27.0, -24.0)
    return np.asarray(np.nan_to_num(patch))


def joint_space(
    plateau: PlateauSurface, patch: Float, femur_above_mm: Float, bounds_mm: tuple[float, float, float]
) -> JointSpace:
    """What cartilage one compartment has room for: what holds the bones apart where they lie in the scan.

    Parameters
    ----------
    plateau : PlateauSurface
    patch : (N, M) float64
        Of the compartment.
    femur_above_mm : (N, M) float64
        Height of the femur's bone over the same cells at the scan pose; NaN where it is not over them.
    bounds_mm : (least, most, otherwise)
        Thickness of the femoral side, and of both where the scan does not tell. The tibial side takes the rest.
    """
    apart = ((femur_above_mm - plateau.height_mm) * plateau.facing)[patch > 0.9]
    apart = apart[np.isfinite(apart)]
    between = float(np.percentile(apart, 2.0)) if len(apart) else float("nan")
    least, most, otherwise = bounds_mm
    if not 0.0 < between <= WIDEST_SPACE_MM:
        return JointSpace(between, otherwise, otherwise, from_scan=False)
    femoral = float(np.clip(0.5 * between, least, most))
    return JointSpace(between, femoral, max(between - femoral, least), from_scan=True)
