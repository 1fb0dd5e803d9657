"""What is reported of one cell: proof on both sides, certificate, compartments."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.kinematics.cell import Certificate, Claim, Proof, ProofSettings, certificate, failed_cell, prove
from pipeline.kinematics.contact import AttitudeContact, Pose
from pipeline.kinematics.table import Status
from tests.kinematics.shapes import at_attitude, convex

#: A flat ceiling at z = 0 and a cube of 10 mm whose upper face is at z = 0 in its own frame: all of z is known.
CEILING = convex([(x, y, z) for x in (-50, 50) for y in (-50, 50) for z in (0, 20)])
CUBE = convex([(x, y, z) for x in (-5, 5) for y in (-5, 5) for z in (-10, 0)])

NEEDLE = convex([(0, 0, 0), (-1, -1, -10), (1, -1, -10), (0, 1, -10)])


@pytest.fixture(scope="module")
def contact() -> AttitudeContact:
    return at_attitude(CEILING, CUBE)


@pytest.mark.parametrize(
    ("z", "before", "after"),
    [
        (-1e-4, 0.0, 2e-4),  # 0.1 um clear
        (-8e-4, 0.0, 1e-3),
        (-6e-3, 0.0, 1e-2),
        (7e-4, 1e-3, 0.0),  # 0.7 um inside
        (4e-3, 5e-3, 0.0),
    ],
)
def test_the_proof_brackets_contact_by_the_nearest_steps(
    contact: AttitudeContact, z: float, before: float, after: float
) -> None:
    proof = proven(contact, Pose(0.3, 0.2, z, 0.1))
    assert (proof.gap_before_mm, proof.gap_after_mm) == (before, after)


def proven(contact: AttitudeContact, pose: Pose, touching: tuple[float, float] = (np.inf, np.inf)) -> Proof:
    claim = Claim((0.0, 0.0), pose, Certificate(0.0, 0, *touching))
    return prove(contact.bodies, claim, ProofSettings().ladder_mm)


def certified(contact: AttitudeContact, pose: Pose, eminence_mm: float = 0.0) -> Certificate:
    return certificate(contact.contacts(pose, ProofSettings().contact_band_mm), pose, eminence_mm)


def test_a_pose_beyond_the_ladder_is_not_proven(contact: AttitudeContact) -> None:
    apart, inside = (proven(contact, Pose(0.0, 0.0, z, 0.0)) for z in (-0.03, 0.03))
    assert apart.gap_before_mm == 0.0
    assert np.isnan(apart.gap_after_mm)
    assert np.isnan(inside.gap_before_mm)


def test_a_cube_on_a_flat_ceiling_is_in_equilibrium_with_both_compartments_at_the_gap(contact: AttitudeContact) -> None:
    balance = certified(contact, Pose(0.3, 0.2, -1e-4, 0.1))
    assert balance.residual == pytest.approx(0.0, abs=1e-9)
    assert balance.contact_count >= 3
    assert (balance.medial_gap_mm, balance.lateral_gap_mm) == pytest.approx((1e-4, 1e-4), abs=1e-6)


def test_a_compartment_is_told_by_the_moving_frame(contact: AttitudeContact) -> None:
    """Half a turn brings the medial side to where x is positive; a wide strip between them leaves neither."""
    turned = certified(contact, Pose(0.0, 0.0, -1e-4, np.pi))
    assert np.isfinite([turned.medial_gap_mm, turned.lateral_gap_mm]).all()
    apart = certified(contact, Pose(0.0, 0.0, -1e-4, 0.0), eminence_mm=6.0)
    assert np.isinf([apart.medial_gap_mm, apart.lateral_gap_mm]).all()


def test_compartments_that_do_not_touch_are_measured_and_the_others_are_not(contact: AttitudeContact) -> None:
    measured = proven(contact, Pose(0.0, 0.0, -0.4, 0.0))
    assert (measured.medial_gap_mm, measured.lateral_gap_mm) == pytest.approx((0.4, 0.4), abs=1e-6)
    known = proven(contact, Pose(0.0, 0.0, -0.4, 0.0), touching=(0.01, 0.02))
    assert (known.medial_gap_mm, known.lateral_gap_mm) == (0.01, 0.02)


@pytest.mark.parametrize("slope_deg", [10.0, 40.0])
def test_one_wall_balances_the_cosine_of_its_slope_and_leaves_its_sine(slope_deg: float) -> None:
    """A needle against a plane that leans: one contact, its normal at the slope to delta."""
    contact = at_attitude(CEILING, NEEDLE, flexion_rad=float(np.radians(slope_deg)))
    balance = certified(contact, Pose(0.0, 0.0, -1e-3, 0.0))
    assert balance.contact_count == 1
    assert balance.residual == pytest.approx(np.sin(np.radians(slope_deg)), abs=1e-6)


def test_a_failed_cell_shows_nothing_but_why() -> None:
    cell = failed_cell(Status.SLID_OFF, 12)
    assert (cell.status, cell.motions, cell.certificate.contact_count) == (Status.SLID_OFF, 12, 0)
    balance, proof = cell.certificate, cell.proof
    assert np.isnan([*cell.pose, balance.residual, balance.medial_gap_mm, balance.lateral_gap_mm, *proof]).all()
