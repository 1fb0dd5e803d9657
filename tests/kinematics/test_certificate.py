"""The equilibrium certificate: zero at stable poses, the closed form elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.validation_objects import BallInDish, BarOnPyramids
from pipeline.kinematics.certificate import TORQUE_RADIUS_MM, equilibrium_residual
from pipeline.kinematics.contact import Contacts, Pose
from pipeline.kinematics.descent import MotionSettings, drop
from tests.kinematics.shapes import falling

EXACT = MotionSettings(tolerance_mm=1e-6)


def contacts_of(points: object, normals: object) -> Contacts:
    at = np.asarray(points, dtype=float).reshape(-1, 3)
    return Contacts(at, np.asarray(normals, dtype=float).reshape(-1, 3), np.zeros(len(at)))


def tilted(angle: float, direction: float = 0.0) -> list[float]:
    return [np.sin(angle) * np.cos(direction), np.sin(angle) * np.sin(direction), -np.cos(angle)]


def test_nothing_touched_balances_nothing() -> None:
    assert equilibrium_residual(contacts_of([], [])) == 1.0


@pytest.mark.parametrize("angle", [0.0, 0.1, 0.8, 1.5])
def test_one_slope_leaves_the_sine_of_its_angle(angle: float) -> None:
    """The best multiplier projects the push on the normal."""
    assert equilibrium_residual(contacts_of([1.0, 2.0, 3.0], tilted(angle, 0.4))) == pytest.approx(np.sin(angle))


@pytest.mark.parametrize("angle", [0.2, 1.0])
def test_two_opposite_slopes_balance(angle: float) -> None:
    both = contacts_of([[1, 0, 0], [-1, 0, 0]], [tilted(angle), tilted(angle, np.pi)])
    assert equilibrium_residual(both) == pytest.approx(0.0, abs=1e-12)


def test_a_couple_is_not_balanced() -> None:
    """Opposite walls pushing past one another: the forces cancel, the torque about delta does not."""
    couple = contacts_of([[30, 20, 0], [-30, -20, 0]], [tilted(0.7, np.pi), tilted(0.7)])
    assert equilibrium_residual(couple) > 0.3
    assert TORQUE_RADIUS_MM == 30.0


def test_a_reaction_cannot_pull() -> None:
    assert equilibrium_residual(contacts_of([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])) == pytest.approx(1.0)


def test_where_contacts_lie_in_space_does_not_matter() -> None:
    random = np.random.default_rng(5)
    points = random.normal(size=(6, 3)) * 10.0
    normals = np.array([tilted(a, d) for a, d in random.uniform(0.1, 3.0, (6, 2)) * [0.4, 2.0]])
    here = equilibrium_residual(contacts_of(points[:3], normals[:3]))
    assert equilibrium_residual(contacts_of(points[:3] + np.array([400.0, -90.0, 7.0]), normals[:3])) == pytest.approx(
        here
    )


def test_ball_in_its_dish() -> None:
    """Zero in the middle; aside, the tilt of the line of centres, d / (R - r), less what the facets blur."""
    bowl = falling(BallInDish().pair())
    residuals = {}
    for offset in (0.0, 0.5, 1.0, 2.0):
        landed = drop(bowl, Pose(offset, 0.0, -20.0, 0.0), EXACT)
        assert landed is not None
        residuals[offset] = equilibrium_residual(bowl.contacts(landed, 2e-4))
    assert residuals[0.0] < 1e-9
    for offset in (0.5, 1.0, 2.0):
        assert residuals[offset] == pytest.approx(offset / 6.0, abs=0.04)


def test_a_wide_band_proves_little_on_surfaces_that_fit_closely() -> None:
    """Known limit: within 0.05 mm of the ball lie contacts all round the middle, 1.5 mm away from it."""
    bowl = falling(BallInDish().pair())
    landed = drop(bowl, Pose(0.5, 0.0, -20.0, 0.0), EXACT)
    assert landed is not None
    assert equilibrium_residual(bowl.contacts(landed, 0.05)) < 1e-6
    assert equilibrium_residual(bowl.contacts(landed, 2e-4)) > 0.04


@pytest.mark.parametrize("start", [Pose(0.0, 0.0, -20, 0.1), Pose(0.5, 0.0, -20, 0.0), Pose(-1.0, 2.0, -20, -0.3)])
def test_bar_that_still_turns_or_slides(start: Pose) -> None:
    pyramids = falling(BarOnPyramids().pair())
    landed = drop(pyramids, start, EXACT)
    assert landed is not None
    assert equilibrium_residual(pyramids.contacts(landed, 2e-3)) > 0.2


@pytest.mark.parametrize("along_mm", [-20.0, 0.0, 7.0])
def test_bar_at_rest_wherever_along_the_pyramids(along_mm: float) -> None:
    pyramids = falling(BarOnPyramids().pair())
    landed = drop(pyramids, Pose(0.0, along_mm, -20.0, 0.0), EXACT)
    assert landed is not None
    assert landed.z == pytest.approx(-5.0, abs=1e-5)
    assert equilibrium_residual(pyramids.contacts(landed, 2e-3)) < 1e-6
