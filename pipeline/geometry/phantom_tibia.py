"""The tibial side of the phantom: tibia, cartilage, menisci, fibula. Points in the moving frame, right knee, mm.

The seat (menisci and the middle of each plateau) is moulded to the femoral condyles at full extension, with slightly
larger radii. Behind the contact of full extension the condyles are surfaces of revolution about the flexion axis,
and the larger distal radius moves forwards and upwards as the knee flexes: the condyles never leave the mould. Hence
the knee has one seat for every flexion: pushed on by the clearance along z, both condyles touch at their deepest points
and the knee is stable at the other coordinates of the scan.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.phantom_femur import condyles_of, femur_field
from pipeline.geometry.phantom_frames import KneePose, moved, moving_from_attitude, reference_from_moving
from pipeline.geometry.phantom_shapes import (
    Bools,
    Float,
    condyles_field,
    ellipse,
    ellipsoid,
    intersection,
    ramp,
    reach_mm,
    unevenness,
    union,
)
from pipeline.geometry.phantom_spec import PhantomSpec

#: The tibial plateau's middle lies this far in front of the flexion axis, seen along the tibia.
PLATEAU_ANTERIOR_MM = 2.0
#: Depth below the plateau at which the metaphysis has become the shaft.
METAPHYSIS_BOTTOM_MM = 55.0
#: Depth below the seat down to which the rim of the plateau is upright.
_RIM_MM = 5.0
TUBEROSITY_MM = (4.0, 22.0, -30.0)
FIBULAR_HEAD_MM = (35.0, -19.0, -20.0)
_FIBULAR_SHAFT_MM = (29.0, -17.0)
#: Attitudes at which menisci and spines are kept clear of the whole femur.
_SWEPT_FLEXION_DEG = (0.0, 10.0, 20.0, 45.0, 75.0, 105.0, 115.0, 122.0)
#: How far the plateau's surface is raised into the mould, so that the mould carves a contact facet into it.
_FACET_MM = 0.4
#: Semi-axes (x, y) of the free middle of a compartment, where the cartilages meet.
_MENISCUS_HOLE_MM = (6.0, 8.5)
#: Height of the tibial spines above the plateau.
_SPINE_MM = 8.5


@dataclass(frozen=True, eq=False)
class Plateau:
    """One half of the plateau.

    Attributes
    ----------
    centre_mm : (x, y)
        Middle of its outline.
    semi_axes_mm : (x, y)
        Of its outline.
    contact_mm : (3,) float64
        Lowest point of the mould above it.
    concavity_per_mm : float
        Curvature of its surface; negative is convex, as the lateral plateau is from front to back.
    """

    centre_mm: tuple[float, float]
    semi_axes_mm: tuple[float, float]
    contact_mm: Float
    concavity_per_mm: float


@dataclass(frozen=True, eq=False)
class Tibia:
    """What the fields of the tibial side share.

    Attributes
    ----------
    spec : PhantomSpec
    scan, mould : KneePose
        Pose of the scan, and the same at full extension, in which the seat is moulded.
    medial, lateral : Plateau
    """

    spec: PhantomSpec
    scan: KneePose
    mould: KneePose
    medial: Plateau
    lateral: Plateau


def tibia_of(spec: PhantomSpec) -> Tibia:
    """The tibial side that belongs to a spec; the moving frame's origin is level with the seat."""
    medial_reach, lateral_reach = _reaches_mm(spec)
    shift = (0.0, PLATEAU_ANTERIOR_MM, -(medial_reach + lateral_reach) / 2)
    scan = KneePose(spec.flexion_deg, spec.varus_deg, spec.internal_rotation_deg, shift)
    half = spec.half_spacing_mm
    medial_contact = _contact_mm(-half, medial_reach, scan)
    lateral_contact = _contact_mm(half, lateral_reach, scan)
    medial = Plateau((-half + 2.0, -1.0), (half - 6.0, 24.0), medial_contact, 1 / 150)
    lateral = Plateau((half - 2.0, -1.0), (half - 6.0, 22.0), lateral_contact, -1 / 120)
    return Tibia(spec, scan, scan._replace(flexion_deg=0.0), medial, lateral)


def _reaches_mm(spec: PhantomSpec) -> tuple[float, float]:
    shape, varus_rad = condyles_of(spec), float(np.deg2rad(spec.varus_deg))
    return reach_mm(shape, spec.medial_radius_mm, varus_rad), reach_mm(shape, spec.lateral_radius_mm, varus_rad)


def _contact_mm(middle_mm: float, reach_mm: float, pose: KneePose) -> Float:
    """Point (3,) of the seat below the middle of a condyle, in the moving frame."""
    varus_rad = np.deg2rad(pose.varus_deg)
    below = np.array([middle_mm * np.cos(varus_rad), 0.0, middle_mm * np.sin(varus_rad) - reach_mm])
    return np.asarray(moving_from_attitude(pose) @ (below - np.array(pose.shift_mm)))


def mould_field(points: Float, tibia: Tibia) -> Float:
    """Field (N,) of what is cut out to make the seat: the condyles grown, lifted by the play."""
    spec = tibia.spec
    lift = np.array([[0.0], [0.0], [spec.seat_play_mm]])
    in_reference = moved(reference_from_moving(tibia.mould), points - lift)
    grown = condyles_field(in_reference, condyles_of(spec)) - spec.clearance_mm - spec.seat_play_mm
    return unevenness(spec.roughness_mm, spec.seed, 1).added_to(grown, points)


def in_the_way(points: Float, tibia: Tibia) -> Bools:
    """Which points (N,) some part of the femur other than the moulding condyles would hit while the knee flexes."""
    out = np.zeros(points.shape[1], bool)
    for flexion_deg in _SWEPT_FLEXION_DEG:
        motion = reference_from_moving(tibia.scan._replace(flexion_deg=flexion_deg))
        out |= femur_field(moved(motion, points), tibia.spec) < tibia.spec.clearance_mm
    return out


def plateau_height_mm(points: Float, tibia: Tibia) -> Float:
    """Height z (N,) of the cartilage surface above (x, y), menisci and carving by the mould left aside."""
    x, y = points[0], points[1]
    lateral_share = ramp(x, -8.0, 8.0)
    height = _half_height(x, y, tibia.medial, tibia) * (1.0 - lateral_share)
    height += _half_height(x, y, tibia.lateral, tibia) * lateral_share
    return height + _spines(x, y)


def _half_height(x: Float, y: Float, half: Plateau, tibia: Tibia) -> Float:
    contact = half.contact_mm
    slope = np.tan(np.deg2rad(tibia.spec.posterior_slope_deg))
    across = (x - contact[0]) ** 2 * max(half.concavity_per_mm, 0.0)
    along = (y - contact[1]) ** 2 * half.concavity_per_mm
    return np.asarray(contact[2] + _FACET_MM + slope * (y - contact[1]) + (across + along) / 2)


def _spines(x: Float, y: Float) -> Float:
    """Medial and lateral tibial spine, the medial one further forward."""
    medial = np.exp(-(((x + 5.0) / 3.6) ** 2) - ((y - 1.0) / 8.0) ** 2)
    lateral = 0.85 * np.exp(-(((x - 5.0) / 3.6) ** 2) - ((y + 3.0) / 7.0) ** 2)
    return np.asarray(_SPINE_MM * np.maximum(medial, lateral))


def outline_field(points: Float, half: Plateau, shaft_radius_mm: float) -> Float:
    """Field (N,) of the column below one half of the plateau, which narrows downwards into the shaft."""
    return _column(points, half.centre_mm, half.semi_axes_mm, shaft_radius_mm)


def _column(
    points: Float, centre: tuple[float, float], semi_axes: tuple[float, float], shaft_radius_mm: float
) -> Float:
    share = _flare(points)
    semi_x, semi_y = (shaft_radius_mm + (semi - shaft_radius_mm) * share for semi in semi_axes)
    return ellipse(points[0] - centre[0] * share, points[1] - centre[1] * share, semi_x, semi_y)


def _flare(points: Float) -> Float:
    """1 at the rim of the plateau, falling to 0 where the metaphysis has become the shaft; (N,)."""
    height = (points[2] + METAPHYSIS_BOTTOM_MM) / (METAPHYSIS_BOTTOM_MM - _RIM_MM)
    return np.asarray(np.clip(height, 0.0, 1.0) ** 1.6)


def tibia_field(points: Float, tibia: Tibia) -> Float:
    """Field (N,) of the tibia with its cartilage, before the mould is cut out."""
    whole = np.hypot(points[0], points[1]) - tibia.spec.tibial_shaft_radius_mm
    high = points[2] > -METAPHYSIS_BOTTOM_MM
    near = points[:, high]
    whole[high] = intersection(_metaphysis(near, tibia), near[2] - plateau_height_mm(near, tibia), 1.5)
    return unevenness(tibia.spec.roughness_mm, tibia.spec.seed, 2).added_to(whole, points)


def _metaphysis(points: Float, tibia: Tibia) -> Float:
    """Field (N,) of the columns below the plateau and of the tuberosity; fillets vanish towards the shaft."""
    radius = tibia.spec.tibial_shaft_radius_mm
    fillet_mm = 1.0 + 9.0 * _flare(points)
    halves = union(outline_field(points, tibia.medial, radius), outline_field(points, tibia.lateral, radius), fillet_mm)
    both = union(halves, _column(points, (0.0, 1.0), (14.0, 17.0), radius), fillet_mm)
    x, y, z = TUBEROSITY_MM
    return union(both, ellipsoid(points, (x, y - 9.0, z), (9.0, 9.0, 16.0)), 3.0 + fillet_mm)


def in_tibial_cartilage(points: Float, half: Plateau, tibia: Tibia) -> Bools:
    """Which points (N,) of the tibia are the cartilage of one half."""
    toward_outside = points[0] * np.sign(half.centre_mm[0])
    patch = np.minimum(-2.0 - outline_field(points, half, tibia.spec.tibial_shaft_radius_mm), toward_outside - 8.5)
    thickness = tibia.spec.cartilage_mm * ramp(patch, 0.0, 2.5)
    return np.asarray(points[2] > plateau_height_mm(points, tibia) - thickness)


def meniscus_field(points: Float, half: Plateau, tibia: Tibia) -> Float:
    """Field (N,) of a meniscus before the mould is cut out: a C on the plateau, open towards the spines."""
    x, y, z = points
    above = z - plateau_height_mm(points, tibia)
    slab = np.maximum(-above, above - tibia.spec.meniscus_height_mm)
    from_contact_y = np.abs(y - half.contact_mm[1])
    hole = ellipse(x - half.contact_mm[0], y - half.contact_mm[1], *_MENISCUS_HOLE_MM)
    outwards = x * np.sign(half.centre_mm[0])
    opening = np.minimum(abs(half.contact_mm[0]) - outwards, _MENISCUS_HOLE_MM[1] - from_contact_y)
    ring = np.maximum(outline_field(points, half, tibia.spec.tibial_shaft_radius_mm) + 1.5, -hole)
    return np.asarray(np.maximum.reduce([slab, ring, opening, 9.0 - outwards]))


def near_fibula(points: Float) -> Bools:
    """Which points (N,) are near enough to the fibula to be looked at."""
    return np.asarray((points[0] > _FIBULAR_SHAFT_MM[0] - 15.0) & (points[2] < FIBULAR_HEAD_MM[2] + 20.0))


def fibula_field(points: Float) -> Float:
    """Field (N,) of the fibula: head and shaft."""
    x, y, z = points
    head = ellipsoid(points, FIBULAR_HEAD_MM, (8.5, 9.5, 12.0))
    low = ramp(z, FIBULAR_HEAD_MM[2], -60.0)
    centre_x = FIBULAR_HEAD_MM[0] + (_FIBULAR_SHAFT_MM[0] - FIBULAR_HEAD_MM[0]) * low
    centre_y = FIBULAR_HEAD_MM[1] + (_FIBULAR_SHAFT_MM[1] - FIBULAR_HEAD_MM[1]) * low
    shaft = np.maximum(np.hypot(x - centre_x, y - centre_y) - 6.0, z - FIBULAR_HEAD_MM[2])
    return union(head, shaft, 5.0)
