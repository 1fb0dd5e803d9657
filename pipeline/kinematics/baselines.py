"""Baselines: how the bones of one person would move on a fixed hinge, and on a published average curve.

Both pass through the pose of the scan and neither asks whether the surfaces meet. How far along delta they then are
from contact is what a motion that ignores the shape of the joint costs: gap or overlap of these very bones.

The average curve is that of P. S. Walker, J. S. Rovick, D. D. Robertson, "The effects of knee brace hinge design and
placement on joint mechanics", Journal of Biomechanics 21 (1988) 965-974, in the coefficients that public models of the
knee use. It is published as the motion of the femur on the tibia (up +, forward +) and is given here as that of the
tibia on the femur, along the axes of the attitude frame. Those models disagree on the frame of the two shifts, so the
angles are the firmer part.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyval

from pipeline.kinematics.contact import Pose
from pipeline.kinematics.smoothing import Probe
from pipeline.kinematics.table import Float

#: Flexion over which Walker's curves are published, degrees.
WALKER_RANGE_DEG = (0.0, 120.0)

_VARUS_DEG = (0.0, 0.0791, -5.733e-4, -7.682e-6, 5.759e-8)
_INTERNAL_ROTATION_DEG = (0.0, 0.3695, -2.958e-3, 7.666e-6)
_FEMUR_FORWARD_MM = (0.0, -0.1283, 4.796e-4)
_FEMUR_UP_MM = (0.0, -0.0683, 8.804e-4, -3.75e-6)


class WalkerMotion(NamedTuple):
    """Walker's average motion of the tibia on the femur since 0 deg of flexion, clinical signs; each (...) float64."""

    varus_deg: Float
    internal_rotation_deg: Float
    anterior_mm: Float
    proximal_mm: Float


@dataclass(frozen=True, eq=False)
class Baseline:
    """A pose at each flexion that owes nothing to contact; arrays (F,), NaN where the curve is not published.

    Attributes
    ----------
    flexion_deg, varus_deg, internal_rotation_deg : float64
    lateral_mm, anterior_mm, proximal_mm : float64
        Signs and frames of the table.
    """

    flexion_deg: Float
    varus_deg: Float
    internal_rotation_deg: Float
    lateral_mm: Float
    anterior_mm: Float
    proximal_mm: Float


def walker_motion(flexion_deg: Float) -> WalkerMotion:
    """Walker's polynomials at flexion (...) in degrees; NaN where they are not published."""
    low, high = WALKER_RANGE_DEG
    within = np.where((flexion_deg >= low) & (flexion_deg <= high), flexion_deg, np.nan)
    return WalkerMotion(
        varus_deg=_polynomial(within, _VARUS_DEG),
        internal_rotation_deg=_polynomial(within, _INTERNAL_ROTATION_DEG),
        anterior_mm=-_polynomial(within, _FEMUR_FORWARD_MM),
        proximal_mm=-_polynomial(within, _FEMUR_UP_MM),
    )


def _polynomial(at: Float, coefficients: tuple[float, ...]) -> Float:
    return np.asarray(polyval(at, coefficients), dtype=np.float64)


def hinge(flexion_deg: Float, scan_attitude: tuple[float, ...]) -> Baseline:
    """A pure rotation about the flexion axis from the pose of the scan: its other five coordinates stay.

    Parameters
    ----------
    flexion_deg : (F,) float64
    scan_attitude : 6 floats
        Flexion, varus, internal rotation (deg), lateral, anterior, proximal (mm) of the scan.
    """
    held = (np.full(len(flexion_deg), value) for value in scan_attitude[1:])
    return Baseline(flexion_deg, *held)


def walker(flexion_deg: Float, scan_attitude: tuple[float, ...]) -> Baseline:
    """Walker's average curve, shifted so that it passes through the pose of the scan.

    A scan that is straighter or more bent than the curves are published for is taken at their nearest end.

    Parameters
    ----------
    flexion_deg : (F,) float64
    scan_attitude : 6 floats
        As for :func:`hinge`.
    """
    here, scan = walker_motion(flexion_deg), walker_motion(np.clip(scan_attitude[0], *WALKER_RANGE_DEG))
    _, varus, rotation, lateral, anterior, proximal = scan_attitude
    return Baseline(
        flexion_deg=flexion_deg,
        varus_deg=varus + here.varus_deg - scan.varus_deg,
        internal_rotation_deg=rotation + here.internal_rotation_deg - scan.internal_rotation_deg,
        lateral_mm=np.full(len(flexion_deg), lateral),
        anterior_mm=anterior + here.anterior_mm - scan.anterior_mm,
        proximal_mm=proximal + here.proximal_mm - scan.proximal_mm,
    )


def probes(baseline: Baseline) -> tuple[Probe, ...]:
    """The poses of a baseline, to ask a solver about; those that are not published are left out."""
    shifts = (baseline.lateral_mm, baseline.anterior_mm, baseline.proximal_mm)
    turns = np.radians(baseline.internal_rotation_deg)
    rows = np.column_stack([baseline.flexion_deg, baseline.varus_deg, *shifts, turns]).tolist()
    return tuple(
        Probe(flexion, varus, Pose(x, y, z, turn)) for flexion, varus, x, y, z, turn in rows if np.isfinite(turn)
    )
