"""The equilibrium certificate: zero at stable poses, the closed form elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.validation_objects import BallInDish, BarOnPyramids
from pipeline.kinematics.certificate import TORQUE_RADIUS_MM, equilibrium_residual
from pipeline.kinematics.contact import Contacts, Pose
from pipeline.kinematics.descent import MotionSettings, drop
from pipeline.kinematics.ligaments import NO_LOAD, Load
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


def sideways(pull: tuple[float, float], turn: float = 0.0, origin: tuple[float, float] = (0.0, 0.0)) -> Load:
    """Fibres that pull with a force in the plane and a torque about the origin."""
    return Load(1.0, -np.array([*pull, turn, 0.0]), origin)


def test_a_slope_balances_the_fibre_that_holds_the_body_on_it() -> None:
    """Along the slope the push pulls with its sine; a fibre that pulls back with the tangent leaves nothing."""
    slope = contacts_of([1.0, 2.0, 3.0], tilted(0.4, np.pi))
    assert equilibrium_residual(slope, sideways((np.tan(0.4), 0.0), 0.0, (1.0, 2.0))) == pytest.approx(0.0, abs=1e-12)
    wrong_way = sideways((-np.tan(0.4), 0.0), 0.0, (1.0, 2.0))
    assert equilibrium_residual(slope, wrong_way) == pytest.approx(2.0 * np.sin(0.4))
    assert equilibrium_residual(slope, NO_LOAD) == equilibrium_residual(slope) == pytest.approx(np.sin(0.4))


@pytest.mark.parametrize(("pull", "left"), [((0.0, 0.6), 0.6), ((0.3, -0.4), 0.5), ((0.0, 0.0), 0.0)])
def test_a_flat_contact_cannot_hold_against_a_pull_aside(pull: tuple[float, float], left: float) -> None:
    flat = contacts_of([4.0, -3.0, 0.0], [0.0, 0.0, -1.0])
    assert equilibrium_residual(flat, sideways(pull, 0.0, (4.0, -3.0))) == pytest.approx(left, abs=1e-12)


def test_torque_of_the_fibres_is_moved_to_where_the_contacts_are() -> None:
    """A pull through the middle of two opposite walls, told about another point, is the same pull."""
    walls = contacts_of([[1, 0, 0], [-1, 0, 0]], [tilted(0.4, np.pi), tilted(0.4)])
    force, origin = np.array([0.1, 0.0]), np.array([7.0, 9.0])
    turn = float(origin[1] * force[0] - origin[0] * force[1])  # (middle - origin) x force
    assert equilibrium_residual(walls, sideways((0.1, 0.0), turn, (7.0, 9.0))) == pytest.approx(0.0, abs=1e-12)
    assert equilibrium_residual(walls, sideways((0.1, 0.0), 0.0, (7.0, 9.0))) > 0.02


def test_fibres_that_press_the_body_on_are_balanced_by_a_flat_contact() -> None:
    flat = contacts_of([4.0, -3.0, 0.0], [0.0, 0.0, -1.0])
    assert equilibrium_residual(flat, Load(1.0, np.array([0.0, 0.0, 0.0, -5.0]), (4.0, -3.0))) == pytest.approx(0.0)
    held_off = Load(1.0, np.array([0.0, 0.0, 0.0, 1.5]), (4.0, -3.0))
    assert equilibrium_residual(flat, held_off) == pytest.approx(0.5)
