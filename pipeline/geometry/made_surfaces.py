"""Cartilage and menisci made from bones alone, as masks that a surface can be drawn around.

Menisci are the wedge between condyle and plateau outside the central contact area of each compartment, rigid on the
tibia: a ring along the rim of the plateau, open towards the eminence, as high as the femur of the scan pose leaves room
for, and no higher and wider than menisci are (bounds from anatomical measurements: Fukubayashi & Kurosawa 1980; Erbagci
et al., Surg. Radiol. Anat. 26, 2004; McDermott et al., Knee Surg. Sports Traumatol. Arthrosc. 12, 2004).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cartilage import (
    CELL_MM,
    JointSpace,
    PlateauSurface,
    RadialSurface,
    joint_space,
    plateau_surface,
    radial_surface,
)
from pipeline.geometry.height_field import Raster, eased, highest, surface_samples
from pipeline.geometry.mesh import TriangleMesh, transformed

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Made surfaces reach this far into the bone, so that no gap is left between them (mm).
ROOT_MM = 0.8
#: Name of the one structure that stands for all others between the bones.
FILLER = "joint_space_filler"
#: Menisci are open towards the eminence: no width below the first angle from that direction, all above the second.
OPENING_DEG = (35.0, 60.0)
#: Inner end of a meniscus's outline beside the middle of the knee (mm).
INNER_MM = 5.0
#: In a wide joint space a meniscus still rises this far above where the bones are nearest (mm).
LEAST_WEDGE_MM = 2.0
#: The lateral outline is at most this many times as long as half of its width.
MOST_LATERAL_LENGTH = 2.1
#: Beyond its patch cartilage ends this far under the bone, so that its edge tapers (mm).
TAPER_MM = 1.0


@dataclass(frozen=True)
class MeniscusShape:
    """Bounds of one meniscus, mm.

    Attributes
    ----------
    height_mm : float
        Over the bone of the plateau, at most.
    anterior_width_mm, posterior_width_mm : float
        From the outer edge inwards; the body lies between.
    anterior_inset_mm, posterior_inset_mm : float
        From the edge of the bony plateau to the outer edge.
    """

    height_mm: float
    anterior_width_mm: float
    posterior_width_mm: float
    anterior_inset_mm: float
    posterior_inset_mm: float


@dataclass(frozen=True)
class SurfaceBounds:
    """What made surfaces may be.

    Attributes
    ----------
    thickness_mm : (least, most)
        Of cartilage on one side.
    default_thickness_mm : float
        Where the bones of the scan do not tell.
    extra_mm : float
        Tibial cartilage may be this much thicker than where the bones are nearest, where the femur is farther away.
    clearance_mm : float
        Left between made surfaces at the scan pose.
    medial, lateral : MeniscusShape
    filler_mm : float
        Height of the joint-space filler.
    """

    thickness_mm: tuple[float, float] = (0.8, 3.0)
    default_thickness_mm: float = 2.0
    extra_mm: float = 1.0
    clearance_mm: float = 0.15
    medial: MeniscusShape = field(default_factory=lambda: MeniscusShape(6.5, 8.0, 11.0, 1.0, 3.0))
    lateral: MeniscusShape = field(default_factory=lambda: MeniscusShape(7.5, 9.0, 10.0, 3.0, 2.0))
    filler_mm: float = 8.0


class SurfaceMask(NamedTuple):
    """One made structure: the body it moves with, voxels, and the matrix from their centres to that body's frame."""

    body: Literal["reference", "moving"]
    inside: Mask
    frame_from_index: Float


class MadeSurfaces(NamedTuple):
    """Structure name -> mask, and the space of each compartment (``medial``, ``lateral``)."""

    masks: dict[str, SurfaceMask]
    spaces: dict[str, JointSpace]


@dataclass(frozen=True, eq=False)
class KneeBones:
    """Both bones of a right knee in their kinematic frames, mm, and the pose of the scan."""

    femur: TriangleMesh
    tibia: TriangleMesh
    moving_from_reference: Float


def anatomical_surfaces(bones: KneeBones, bounds: SurfaceBounds, wanted: frozenset[str]) -> MadeSurfaces:
    """Those of femoral and tibial cartilage and menisci that are wanted; the others are part of the bodies given.

    Raises
    ------
    ValueError
        When the bones do not lie in their frames as a knee does, or leave no room for menisci.
    """
    plateau = plateau_surface(bones.tibia)
    over = _femur_over(bones.femur, bones.moving_from_reference, plateau.raster)
    spaces = _spaces(plateau, over, bounds)
    masks = {}
    if "femoral_cartilage" in wanted:
        radial = radial_surface(bones.femur)
        outside = _femoral_outside(radial, spaces)
        covered = _femoral_points(radial, outside)
        over = np.fmin(over, _lowest(covered, bones.moving_from_reference, plateau.raster))
        masks["femoral_cartilage"] = _femoral_mask(radial, outside)
    for name, patch, shape in (
        ("medial", plateau.medial, bounds.medial),
        ("lateral", plateau.lateral, bounds.lateral),
    ):
        part = _compartment(plateau.raster, patch, spaces[name], shape)
        if f"{name}_tibial_cartilage" in wanted:
            masks[f"{name}_tibial_cartilage"] = _standing(plateau, _tibial_top(plateau, part, over, bounds))
        if f"{name}_meniscus" in wanted:
            height = max(shape.height_mm, spaces[name].between_mm + LEAST_WEDGE_MM)
            roof = np.fmin(over - bounds.clearance_mm, plateau.height_mm + height)
            masks[f"{name}_meniscus"] = _standing(plateau, np.where(_under_meniscus(part), roof, np.nan))
    return MadeSurfaces(masks, spaces)


def _spaces(plateau: PlateauSurface, over_bone: Float, bounds: SurfaceBounds) -> dict[str, JointSpace]:
    limits = (*bounds.thickness_mm, bounds.default_thickness_mm)
    return {
        "medial": joint_space(plateau, plateau.medial, over_bone, limits),
        "lateral": joint_space(plateau, plateau.lateral, over_bone, limits),
    }


def joint_space_filler(bones: KneeBones, bounds: SurfaceBounds) -> MadeSurfaces:
    """Everything between the bones of the scan pose that is lower than the bound, rigid on the tibia.

    Raises
    ------
    ValueError
        When the bones do not lie in their frames as a knee does, or nothing is between them.
    """
    plateau = plateau_surface(bones.tibia)
    over = _femur_over(bones.femur, bones.moving_from_reference, plateau.raster)
    near = (over - plateau.height_mm < bounds.filler_mm) & (np.fmax(plateau.medial, plateau.lateral) > 0.5)
    filler = _standing(plateau, np.where(near, over - bounds.clearance_mm, np.nan))
    return MadeSurfaces({FILLER: filler}, _spaces(plateau, over, bounds))


def _femur_over(femur: TriangleMesh, moving_from_reference: Float, raster: Raster) -> Float:
    """(N, M) height of the femur over the cells of the plateau at the scan pose, mm; NaN where it is not over them."""
    placed = transformed(femur, moving_from_reference)
    points = surface_samples(placed, CELL_MM / 1.5)
    return _lowest(points, np.eye(4), raster)


def _lowest(points: Float, to_moving: Float, raster: Raster) -> Float:
    """(N, M) least height of points over each cell."""
    placed = points @ to_moving[:3, :3].T + to_moving[:3, 3]
    return -highest((placed[:, 0], placed[:, 1]), -placed[:, 2], raster)


def _femoral_outside(radial: RadialSurface, spaces: dict[str, JointSpace]) -> Float:
    """(N, M) radius of the cartilage's surface; under the bone's where there is none."""
    lateral = eased(radial.raster.axes()[0], -8.0, 8.0)[:, None]
    wanted = spaces["medial"].femoral_mm * (1.0 - lateral) + spaces["lateral"].femoral_mm * lateral
    return np.asarray(radial.radius_mm + ((wanted + TAPER_MM) * radial.patch - TAPER_MM) / radial.facing)


def _femoral_points(radial: RadialSurface, outside: Float) -> Float:
    """(N, 3) points of the cartilage's surface, four to a cell, reference frame."""
    from scipy import ndimage  # noqa: PLC0415 - half a second that a run of cached stages need not pay

    n, m = radial.raster.shape
    u, v = np.meshgrid(np.arange(0.0, n - 1, 0.5), np.arange(0.0, m - 1, 0.5), indexing="ij")
    radius = ndimage.map_coordinates(outside, [u, v], order=1)
    on = ndimage.map_coordinates(radial.patch, [u, v], order=1) > 0.5
    x = radial.raster.first[0] + radial.raster.step[0] * u
    angle = np.radians(radial.raster.first[1] + radial.raster.step[1] * v)
    points = np.stack([x, -radius * np.sin(angle), -radius * np.cos(angle)], axis=-1)
    return np.asarray(points[on & np.isfinite(radius)])


def _femoral_mask(radial: RadialSurface, outside: Float) -> SurfaceMask:
    """Voxels between the bone, a little under its surface, and the surface of the cartilage."""
    from scipy import ndimage  # noqa: PLC0415 - half a second that a run of cached stages need not pay

    across = radial.raster.axes()[0][radial.patch.any(axis=1)]
    reach = float(np.nanmax(np.where(radial.patch > 0.0, outside, 0.0)))
    low, high = np.array([across[0], -reach, -reach]), np.array([across[-1], reach, reach])
    origin = low - 2.0 * CELL_MM
    x, y, z = (origin[k] + CELL_MM * np.arange(int((high[k] - origin[k]) / CELL_MM) + 3) for k in range(3))
    radius = np.hypot(y[:, None], z[None, :])
    angle = np.degrees(np.arctan2(-y[:, None], -z[None, :]))
    u = np.broadcast_to(((x - radial.raster.first[0]) / radial.raster.step[0])[:, None, None], (len(x), *radius.shape))
    v = np.broadcast_to((angle - radial.raster.first[1]) / radial.raster.step[1], u.shape)
    bone, surface = (
        ndimage.map_coordinates(np.nan_to_num(one), [u, v], order=1, cval=0.0)
        for one in (radial.radius_mm, np.where(radial.patch > 0.0, outside, 0.0))
    )
    inside = (radius > bone - ROOT_MM) & (radius < surface)
    return SurfaceMask("reference", inside, _from_index(origin))


def _from_index(origin: Float) -> Float:
    matrix: Float = np.diag([CELL_MM, CELL_MM, CELL_MM, 1.0])
    matrix[:3, 3] = origin
    return matrix


class _Compartment(NamedTuple):
    """One side of the plateau.

    Attributes
    ----------
    patch : (N, M) float64
        Of the bone's articular surface.
    space : JointSpace
    shape : MeniscusShape
    depth_mm : (N, M) float64
        How far inside the outer edge of the meniscus, an ellipse; negative outside.
    inward_deg : (N, M) float64
        Angle between the direction from its centre and the direction to the eminence, 0 to 180.
    behind : (N, M) float64
        0 at the front of the ellipse, 1 at its back.
    """

    patch: Float
    space: JointSpace
    shape: MeniscusShape
    depth_mm: Float
    inward_deg: Float
    behind: Float


def _compartment(raster: Raster, patch: Float, space: JointSpace, shape: MeniscusShape) -> _Compartment:
    """One side of the plateau; the lateral outline is nearly a circle at the back of the longer bone."""
    x, y = np.meshgrid(*raster.axes(), indexing="ij")
    on = patch > 0.5
    side = float(np.sign(x[on].mean()))
    outer = float(np.percentile(side * x[on], 99.5))
    middle, half_width = side * 0.5 * (outer + INNER_MM), 0.5 * (outer - INNER_MM)
    back, front = (float(end) for end in np.percentile(y[on & (np.abs(x - middle) < 5.0)], [0.5, 99.5]))
    back, front = back + shape.posterior_inset_mm, front - shape.anterior_inset_mm
    if side > 0.0:
        front = min(front, back + MOST_LATERAL_LENGTH * half_width)
    half_length = 0.5 * (front - back)
    away, ahead = side * (x - middle) + 1e-6, y - 0.5 * (front + back)  # no cell is the very centre
    reach = np.hypot(away, ahead)
    edge = 1.0 / np.hypot(away / reach / half_width, ahead / reach / half_length)
    behind = 0.5 * (1.0 - np.clip(ahead / half_length, -1.0, 1.0))
    return _Compartment(patch, space, shape, edge - reach, np.degrees(np.arctan2(np.abs(ahead), -away)), behind)


def _tibial_top(plateau: PlateauSurface, part: _Compartment, over: Float, bounds: SurfaceBounds) -> Float:
    """(N, M) height of the tibial cartilage: what the femoral one leaves, within its bounds; NaN off the patch.

    It ends a little outside the meniscus, and goes on up the eminence.
    """
    room = (over - plateau.height_mm) * plateau.facing
    known = np.isfinite(room)
    wanted = np.clip(
        np.where(known, room, part.space.tibial_mm), bounds.thickness_mm[0], part.space.tibial_mm + bounds.extra_mm
    )
    wanted = np.where(known, np.minimum(wanted, np.maximum(room, 0.0)), wanted)
    inside = eased(part.depth_mm, -3.0, -1.0)
    eminence = eased(-part.inward_deg, -80.0, -60.0) * eased(part.depth_mm, -6.0, -4.0)
    patch = part.patch * np.maximum(inside, eminence)
    return np.where(patch > 0.0, plateau.height_mm + ((wanted + TAPER_MM) * patch - TAPER_MM) / plateau.facing, np.nan)


def _under_meniscus(part: _Compartment) -> Mask:
    """(N, M) the cells under a meniscus: within its width of the outer edge, not towards the eminence."""
    shape = part.shape
    width = shape.anterior_width_mm + (shape.posterior_width_mm - shape.anterior_width_mm) * part.behind
    width = width * eased(part.inward_deg, *OPENING_DEG)
    return np.asarray((part.depth_mm > 0.0) & (part.depth_mm < width))


def _standing(plateau: PlateauSurface, roof: Float) -> SurfaceMask:
    """Voxels from a little under the plateau's bone up to a roof (N, M), moving frame; none where it is NaN.

    Raises
    ------
    ValueError
        When there are none at all.
    """
    floor = plateau.height_mm - ROOT_MM
    there = np.isfinite(roof) & np.isfinite(floor) & (roof > floor)
    if not there.any():
        raise ValueError("the bones of the scan leave no room for what should lie between them")
    low, high = floor[there].min() - 2.0 * CELL_MM, roof[there].max() + 2.0 * CELL_MM
    z = np.arange(low, high, CELL_MM)
    inside = (
        there[..., None] & (z > np.where(there, floor, 0.0)[..., None]) & (z < np.where(there, roof, 0.0)[..., None])
    )
    return SurfaceMask("moving", inside, _from_index(np.array([*plateau.raster.first, low])))
