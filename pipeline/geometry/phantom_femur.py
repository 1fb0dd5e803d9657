"""The femoral side of the phantom: femur, its cartilage, patella. Points in the reference frame, right knee, mm."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.phantom_shapes import (
    Bools,
    Condyles,
    Float,
    condyles_field,
    depth_below_condyles,
    ellipse,
    ellipsoid,
    intersection,
    ramp,
    unevenness,
    union,
)
from pipeline.geometry.phantom_spec import PhantomSpec

#: Height above the flexion axis at which the metaphysis has become the shaft.
METAPHYSIS_TOP_MM = 52.0
#: Above this height nothing but the shaft is near.
_DISTAL_TOP_MM = 48.0
#: The shaft's axis lies this far in front of the flexion axis.
SHAFT_ANTERIOR_MM = 14.0
#: Centre of the patella in front of the trochlea at full extension.
PATELLA_CENTRE_MM = (2.0, 42.0, 12.0)
PATELLA_SEMI_AXES_MM = (21.0, 12.5, 20.0)
#: Space left between the cartilage of trochlea and patella, and the thickness of the patella's, the body's thickest.
_PATELLAR_GAP_MM = 1.0
_PATELLAR_CARTILAGE_MM = 3.0
#: Cartilage also covers the fillet between the condyles and the trochlea, up to this height above them.
_FILLET_MM = 3.0
#: The articular patch: angles about a point (y = z) near the flexion axis, from distal to posterior; front and rear
#: end, and where the notch ends and the trochlea begins. It stays off the condyles' edges by the inset.
_PATCH_MIDDLE_MM = 4.0
_PATCH_END_RAD = (np.deg2rad(-115.0), np.deg2rad(150.0))
_NOTCH_END_RAD = np.deg2rad(-35.0)
_PATCH_INSET_MM = 1.5
#: Axis of the trochlea (y, z), radius of its groove, and what its ridges rise above the groove.
_TROCHLEA_CENTRE_MM = (13.0, 9.0)
_GROOVE_RADIUS_MM = 17.5
_RIDGE_MM = 4.5


def condyles_of(spec: PhantomSpec) -> Condyles:
    """The two condyles with their cartilage."""
    return Condyles(
        middle_mm=spec.half_spacing_mm,
        medial_radius_mm=spec.medial_radius_mm,
        lateral_radius_mm=spec.lateral_radius_mm,
        excess_mm=spec.distal_radius_excess_mm,
        half_width_mm=spec.condyle_width_mm / 2,
        crown_mm=spec.crown_mm,
    )


def femur_field(points: Float, spec: PhantomSpec) -> Float:
    """Field (N,) of the femur together with its cartilage."""
    whole = _metaphysis(points, spec)
    low = points[2] < _DISTAL_TOP_MM
    whole[low] = _with_distal_part(points[:, low], whole[low], spec)
    return unevenness(spec.roughness_mm, spec.seed, 0).added_to(whole, points)


def _with_distal_part(points: Float, metaphysis: Float, spec: PhantomSpec) -> Float:
    trimmed = intersection(condyles_field(points, condyles_of(spec)), _flare(points, spec), 5.0)
    distal = union(trimmed, _trochlea(points, spec), 5.0)
    return union(union(distal, metaphysis, 5.0), _epicondyles(points, spec), 6.0)


def in_femoral_cartilage(points: Float, spec: PhantomSpec) -> Bools:
    """Which points of the femur (N,) are cartilage: near the articular surface, thinning out at the patch's border."""
    depth = np.maximum(depth_below_condyles(points, condyles_of(spec)), -_trochlea(points, spec))
    thickness = spec.cartilage_mm * ramp(_into_patch_mm(points, spec), 0.0, 2.5)
    return np.asarray((depth > -_FILLET_MM) & (depth < thickness) & (thickness > 0.0))


def _into_patch_mm(points: Float, spec: PhantomSpec) -> Float:
    """How far (N,) points lie inside the articular patch, along the surface: both condyles and the trochlea."""
    x, y, z = points
    angle_rad = np.arctan2(-(y - _PATCH_MIDDLE_MM), -(z - _PATCH_MIDDLE_MM))
    along = np.minimum(_PATCH_END_RAD[1] - angle_rad, angle_rad - _PATCH_END_RAD[0]) * spec.lateral_radius_mm
    outer = spec.half_width_mm - _PATCH_INSET_MM - np.abs(x)
    beside_notch = np.abs(x) - (spec.half_spacing_mm - spec.condyle_width_mm / 2 + _PATCH_INSET_MM)
    on_trochlea = (_NOTCH_END_RAD - angle_rad) * spec.lateral_radius_mm
    return np.asarray(np.minimum(np.minimum(along, outer), np.maximum(beside_notch, on_trochlea)))


def near_patella(points: Float) -> Bools:
    """Which points (N,) are near enough to the patella to be looked at."""
    reach = np.asarray(PATELLA_SEMI_AXES_MM)[:, None] + np.array([[1.0], [1.0], [8.0]])
    return np.asarray((np.abs(points - np.asarray(PATELLA_CENTRE_MM)[:, None]) < reach).all(axis=0))


def patella_field(points: Float, femur: Float) -> Float:
    """Field (N,) of the patella with its cartilage: an ovoid, its back moulded to the trochlea.

    Parameters
    ----------
    femur : (N,)
        Field of the femur with its cartilage at the same points.
    """
    ovoid = ellipsoid(points, PATELLA_CENTRE_MM, PATELLA_SEMI_AXES_MM)
    apex = ellipsoid(points, (1.0, 44.0, -6.0), (10.0, 6.0, 11.0))
    front = np.hypot(points[0] - 2.0, points[1] - 20.0) - 31.0
    return intersection(intersection(union(ovoid, apex, 5.0), front, 4.0), _PATELLAR_GAP_MM - femur, 1.5)


def in_patellar_cartilage(points: Float, femur: Float) -> Bools:
    """Which points of the patella (N,) are cartilage: its back, except at the apex."""
    return np.asarray((femur < _PATELLAR_GAP_MM + _PATELLAR_CARTILAGE_MM) & (points[2] > 0.0))


def _flare(points: Float, spec: PhantomSpec) -> Float:
    """Field of a roof over the condyles that narrows upwards into the metaphysis."""
    return np.asarray((np.abs(points[0]) - spec.half_width_mm + 0.8 * (points[2] - 8.0)) / np.hypot(1.0, 0.8))


def _trochlea(points: Float, spec: PhantomSpec) -> Float:
    """Field of the patellar surface between the condyles."""
    return intersection(_saddle(points), np.abs(points[0]) - spec.half_spacing_mm, 5.0)


def _saddle(points: Float) -> Float:
    """Field of the grooved pulley the patella runs on, its lateral ridge higher."""
    x, y, z = points
    in_front = ramp(z, -12.0, 10.0) * ramp(y, 5.0, 20.0)
    ridge_mm = _RIDGE_MM * (1.0 + 0.25 * np.tanh(x / 6.0)) * ramp(np.abs(x - 1.0), 0.0, 17.0) * in_front
    from_axis = np.hypot(y - _TROCHLEA_CENTRE_MM[0], z - _TROCHLEA_CENTRE_MM[1])
    return np.asarray(from_axis - _GROOVE_RADIUS_MM - ridge_mm)


def _metaphysis(points: Float, spec: PhantomSpec) -> Float:
    """Field of shaft and metaphysis: an elliptical column that flares downwards, from above the notch up."""
    x, y, z = points
    height = np.clip((METAPHYSIS_TOP_MM - z) / (METAPHYSIS_TOP_MM - 8.0), 0.0, 1.0)
    radius = spec.femoral_shaft_radius_mm
    semi_x = radius + (spec.half_width_mm - 6.0 - radius) * height**1.7
    semi_y = radius + 3.0 * height
    lean = np.tan(np.deg2rad(spec.femoral_valgus_deg))
    column = ellipse(x - lean * z, y - SHAFT_ANTERIOR_MM + 3.0 * height, semi_x, semi_y)
    return intersection(column, 3.0 - z, 4.0)


def _epicondyles(points: Float, spec: PhantomSpec) -> Float:
    """Field of the two epicondyles."""
    medial, lateral = epicondyles_mm(spec)
    return np.minimum(_bump(points, medial), _bump(points, lateral))


def _bump(points: Float, tip_mm: tuple[float, float, float]) -> Float:
    inward = tip_mm[0] - float(np.copysign(6.0, tip_mm[0]))
    return ellipsoid(points, (inward, tip_mm[1], tip_mm[2]), (6.0, 9.0, 9.0))


def epicondyles_mm(spec: PhantomSpec) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Tips of the medial and the lateral epicondyle."""
    return (-spec.half_width_mm - 4.0, 3.0, 4.0), (spec.half_width_mm + 3.0, 3.0, 4.0)
