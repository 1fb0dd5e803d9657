"""What is known of one cell of the table: its pose, its certificate, its proof on both sides, its compartments.

The certificate is worked out from the features in contact, whoever found the pose. The proof asks the exact collision
test of another library whether the bodies are clear on one side of contact and cross on the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from pipeline.kinematics.certificate import equilibrium_residual
from pipeline.kinematics.contact import AttitudeContact, Bodies, Contacts, Pose
from pipeline.kinematics.ligaments import NO_LOAD, Load
from pipeline.kinematics.table import Status

NAN = float("nan")


@dataclass(frozen=True)
class ProofSettings:
    """How a pose is proven.

    Attributes
    ----------
    contact_band_mm : float
        Features closer than this are contacts of the certificate.
    eminence_mm : float
        Half width of the strip between the compartments: medial is x < -eminence_mm of the moving body's frame.
    ladder_mm : tuple of float
        Ways along delta at which the two-sided proof is tried, smallest first.
    """

    contact_band_mm: float = 0.05
    eminence_mm: float = 0.0
    ladder_mm: tuple[float, ...] = (0.0, 2e-4, 1e-3, 5e-3, 1e-2)


class Certificate(NamedTuple):
    """Balance of a pose, and the compartments it rests on.

    Attributes
    ----------
    residual : float
        What the contacts do not balance of a unit push.
    contact_count : int
        Contacts within the band.
    medial_gap_mm, lateral_gap_mm : float
        Smallest gap of the contacts in each compartment; infinite where none is within the band.
    """

    residual: float
    contact_count: int
    medial_gap_mm: float
    lateral_gap_mm: float


NO_CERTIFICATE = Certificate(NAN, 0, NAN, NAN)


def certificate(contacts: Contacts, pose: Pose, eminence_mm: float, load: Load = NO_LOAD) -> Certificate:
    """The certificate of a pose from its contacts and the load of ligaments (attitude frame)."""
    arm = contacts.points[:, :2] - [pose.x, pose.y]
    across = np.cos(pose.theta) * arm[:, 0] + np.sin(pose.theta) * arm[:, 1]
    return Certificate(
        residual=equilibrium_residual(contacts, load),
        contact_count=len(contacts),
        medial_gap_mm=float(contacts.gaps[across < -eminence_mm].min(initial=np.inf)),
        lateral_gap_mm=float(contacts.gaps[across > eminence_mm].min(initial=np.inf)),
    )


class Claim(NamedTuple):
    """A pose to be proven, at flexion and varus (rad), and what its certificate says of the compartments."""

    angles_rad: tuple[float, float]
    pose: Pose
    certificate: Certificate


class Proof(NamedTuple):
    """What the exact collision test says of a pose.

    Attributes
    ----------
    gap_before_mm, gap_after_mm : float
        Pulled back along delta by the first the bodies are clear, pushed on by the second they intersect.
    medial_gap_mm, lateral_gap_mm : float
        Smallest distance of each compartment.
    """

    gap_before_mm: float
    gap_after_mm: float
    medial_gap_mm: float
    lateral_gap_mm: float


NO_PROOF = Proof(NAN, NAN, NAN, NAN)


def prove(bodies: Bodies, claim: Claim, ladder_mm: tuple[float, ...]) -> Proof:
    """Test a claimed pose on both sides of contact; measure the compartments that are not in contact."""
    contact, pose = AttitudeContact(bodies, *claim.angles_rad), claim.pose
    medial, lateral = claim.certificate.medial_gap_mm, claim.certificate.lateral_gap_mm
    touching = lru_cache(lambda way: contact.touches(_pushed(pose, way)))
    return Proof(
        gap_before_mm=_first(ladder_mm, lambda way: not touching(-way)),
        gap_after_mm=_first(ladder_mm, touching),
        medial_gap_mm=medial if np.isfinite(medial) else contact.gap("medial", pose),
        lateral_gap_mm=lateral if np.isfinite(lateral) else contact.gap("lateral", pose),
    )


class Cell(NamedTuple):
    """One cell; every measure NaN and every count 0 where the status is not usable.

    Attributes
    ----------
    pose : Pose
        The clear side of exact contact.
    """

    pose: Pose
    status: Status
    motions: int
    certificate: Certificate
    proof: Proof


def failed_cell(status: Status, motions: int = 0) -> Cell:
    """A cell that has no pose to show."""
    return Cell(Pose(NAN, NAN, NAN, NAN), status, motions, NO_CERTIFICATE, NO_PROOF)


def _pushed(pose: Pose, way_mm: float) -> Pose:
    return pose._replace(z=pose.z + way_mm)


def _first(ladder_mm: tuple[float, ...], holds: Callable[[float], bool]) -> float:
    return next((way for way in ladder_mm if holds(way)), NAN)
