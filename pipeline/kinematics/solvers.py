"""What a sweep needs of a solver, and the incremental solver in that shape; the direct one is in ``direct.solver``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from pipeline.kinematics.cell import Certificate, ProofSettings, certificate
from pipeline.kinematics.contact import AttitudeContact, Bodies, Pose
from pipeline.kinematics.incremental import IncrementalSettings, StablePose, solve_incremental
from pipeline.kinematics.ligaments import NO_FIBRES, Fibres


class Margin(NamedTuple):
    """How far a body at rest may be pushed, the other coordinates held, while its depth keeps falling.

    Attributes
    ----------
    lateral_mm, anterior_mm, rotation_deg : float
        The smaller of both senses; 5 mm and 10 deg at most.
    """

    lateral_mm: float
    anterior_mm: float
    rotation_deg: float


NO_MARGIN = Margin(float("nan"), float("nan"), float("nan"))


class HeldAttitude(Protocol):
    """Two bodies at held flexion and varus."""

    def solve(self, start: Pose, centre: Pose) -> StablePose:
        """The stable pose reached from a start, within bounds about a centre."""
        ...

    def certify(self, pose: Pose) -> Certificate:
        """The certificate of a pose just clear of contact."""
        ...

    def margin(self, pose: Pose) -> Margin:
        """How far the body may be pushed at a stable pose; NaN where the solver cannot tell."""
        ...


class Solver(Protocol):
    """Finds stable poses of one pair of bodies."""

    def at(self, angles_rad: tuple[float, float]) -> HeldAttitude:
        """The bodies at flexion and varus."""
        ...


class ExactAttitude(HeldAttitude, Protocol):
    """One that knows exact depths without a search."""

    def depth(self, pose: Pose) -> Pose | None:
        """The pose brought to contact along delta, just clear of it; None where nothing is met."""
        ...


class ExactSolver(Protocol):
    """Knows exact depths of one pair of bodies."""

    def at(self, angles_rad: tuple[float, float]) -> ExactAttitude:
        """The bodies at flexion and varus."""
        ...


@dataclass(frozen=True, eq=False)
class IncrementalSolver:
    """The paper's solver, on exact collision tests."""

    bodies: Bodies
    settings: IncrementalSettings = field(default_factory=IncrementalSettings)
    proof: ProofSettings = field(default_factory=ProofSettings)
    fibres: Fibres = NO_FIBRES

    def at(self, angles_rad: tuple[float, float]) -> IncrementalAttitude:
        """The bodies at flexion and varus."""
        return IncrementalAttitude(self, AttitudeContact(self.bodies, *angles_rad, self.fibres))


@dataclass(frozen=True, eq=False)
class IncrementalAttitude:
    """One attitude of an incremental solver."""

    solver: IncrementalSolver
    contact: AttitudeContact

    def solve(self, start: Pose, centre: Pose) -> StablePose:
        """The stable pose reached from a start."""
        return solve_incremental(self.contact, start, self.solver.settings, centre)

    def certify(self, pose: Pose) -> Certificate:
        """The certificate of a pose just clear of contact."""
        proof = self.solver.proof
        contacts = self.contact.contacts(pose, proof.contact_band_mm)
        return certificate(contacts, pose, proof.eminence_mm, self.contact.load(pose))

    def margin(self, pose: Pose) -> Margin:  # noqa: ARG002 - the protocol of solvers
        """Not known: it would take hundreds of collision tests."""
        return NO_MARGIN
