"""What is known of one cell of the table: its pose, its proof on both sides, its certificate, its compartments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from pipeline.kinematics.certificate import equilibrium_residual
from pipeline.kinematics.contact import AttitudeContact, Pose
from pipeline.kinematics.table import Status

NAN = float("nan")


@dataclass(frozen=True)
class ProofSettings:
    """How a pose is proven.

    Attributes
    ----------
    contact_band_mm : float
        Features closer than this are contacts of the certificate.
    ladder_mm : tuple of float
        Ways along delta at which the two-sided proof is tried, smallest first.
    """

    contact_band_mm: float = 0.05
    ladder_mm: tuple[float, ...] = (0.0, 2e-4, 1e-3, 5e-3, 1e-2)


class Cell(NamedTuple):
    """One cell; every measure NaN and every count 0 where the status is not usable.

    Attributes
    ----------
    pose : Pose
        The clear side of exact contact.
    gap_before_mm, gap_after_mm : float
        Pulled back along delta by the first the bodies are clear, pushed on by the second they intersect.
    """

    pose: Pose
    status: Status
    motions: int
    residual: float
    contact_count: int
    medial_gap_mm: float
    lateral_gap_mm: float
    gap_before_mm: float
    gap_after_mm: float


def failed_cell(status: Status, motions: int = 0) -> Cell:
    """A cell that has no pose to show."""
    return Cell(Pose(NAN, NAN, NAN, NAN), status, motions, NAN, 0, NAN, NAN, NAN, NAN)


def measured_cell(contact: AttitudeContact, pose: Pose, status: Status, proof: ProofSettings, motions: int = 0) -> Cell:
    """Everything that is reported of a pose at contact."""
    contacts = contact.contacts(pose, proof.contact_band_mm)
    return Cell(
        pose=pose,
        status=status,
        motions=motions,
        residual=equilibrium_residual(contacts),
        contact_count=len(contacts),
        medial_gap_mm=contact.gap("medial", pose),
        lateral_gap_mm=contact.gap("lateral", pose),
        gap_before_mm=_first(proof.ladder_mm, lambda way: not contact.touches(_pushed(pose, -way))),
        gap_after_mm=_first(proof.ladder_mm, lambda way: contact.touches(_pushed(pose, way))),
    )


def _pushed(pose: Pose, way_mm: float) -> Pose:
    return pose._replace(z=pose.z + way_mm)


def _first(ladder_mm: tuple[float, ...], holds: Callable[[float], bool]) -> float:
    return next((way for way in ladder_mm if holds(way)), NAN)
