"""The incremental solver on bodies whose stable pose is known: the paper's two objects first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.containment import nested
from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.validation_objects import BallInDish, BarOnPyramids, ball, box, dish
from pipeline.kinematics.certificate import equilibrium_residual
from pipeline.kinematics.contact import AttitudeContact, Bodies, Contacts, Pose
from pipeline.kinematics.descent import drop
from pipeline.kinematics.incremental import IncrementalSettings, StablePose, solve_incremental
from pipeline.kinematics.joint_coordinates import Float, attitude_rotation, rotation_x
from pipeline.kinematics.ligaments import CORD_STIFFNESS, Fibres
from pipeline.kinematics.table import Status
from tests.kinematics.settings import (
    BALL_STARTS,
    BAR_STARTS,
    FINE,
    FINE_BAR,
    LARGE_MM,
    PAPER,
    SMOOTH,
    with_steps,
)
from tests.kinematics.shapes import (
    at_attitude,
    convex,
    ellipsoid,
    falling,
    groove,
    joined,
    shifted,
    turned_down,
)

each_ball_start = pytest.mark.parametrize("start", BALL_STARTS)
each_bar_start = pytest.mark.parametrize("start", BAR_STARTS)
stepping = pytest.mark.parametrize("large", [False, True], ids=["paper steps", "steps as large as the object"])


@pytest.fixture(scope="module")
def bowl() -> AttitudeContact:
    return falling(BallInDish().pair())


@pytest.fixture(scope="module")
def pyramids() -> AttitudeContact:
    return falling(BarOnPyramids().pair())


def check_ball(found: StablePose, within_mm: float) -> None:
    assert found.status is Status.OK
    assert np.hypot(found.pose.x, found.pose.y) < within_mm
    assert found.pose.z == pytest.approx(-6.0, abs=1e-3 + within_mm**2 / 12.0)


def check_bar(found: StablePose, within_mm: float, within_deg: float) -> None:
    assert found.status is Status.OK
    assert abs(found.pose.x) < within_mm
    assert abs(np.degrees(found.pose.theta)) < within_deg
    assert abs(found.pose.y) < BarOnPyramids().neutral_range_mm
    assert found.pose.z == pytest.approx(-5.0, abs=within_mm)


@stepping
@each_ball_start
def test_ball_comes_to_rest_in_the_middle(bowl: AttitudeContact, start: Pose, *, large: bool) -> None:
    settings = with_steps(SMOOTH, LARGE_MM["ball"]) if large else SMOOTH
    check_ball(solve_incremental(bowl, start, settings), 0.1)


@stepping
@each_ball_start
def test_ball_at_a_fifth_of_the_resolution(bowl: AttitudeContact, start: Pose, *, large: bool) -> None:
    settings = with_steps(FINE, LARGE_MM["ball"]) if large else FINE
    check_ball(solve_incremental(bowl, start, settings), 0.02)


def test_ball_with_all_defaults(bowl: AttitudeContact) -> None:
    check_ball(solve_incremental(bowl, Pose(0.1, 0.05, -20.0, 0.0), PAPER), 0.1)


@each_ball_start
def test_ball_by_the_plain_rules(bowl: AttitudeContact, start: Pose) -> None:
    """Without the guard, contacts within the band that balance one another are equilibrium.

    A ball at offset d rests on contacts whose gaps reach the band within sqrt(2 band r R / (R - r)) of its lowest
    point, so that much more offset cannot be told from the middle. With steps as large as the object the plain rules
    promise nothing here: facets give a small torque on a body that can turn freely, and no guard undoes the turn.
    """
    band = SMOOTH.contact_band_mm
    ambiguity = np.sqrt(2.0 * band * 6.0 * 12.0 / 6.0)
    found = solve_incremental(bowl, start, replace(SMOOTH, classic=True))
    assert found.status is Status.OK
    assert np.hypot(found.pose.x, found.pose.y) < 0.1 + ambiguity


@stepping
@each_bar_start
def test_bar_turns_onto_both_pyramids(pyramids: AttitudeContact, start: Pose, *, large: bool) -> None:
    settings = with_steps(PAPER, LARGE_MM["bar"]) if large else PAPER
    check_bar(solve_incremental(pyramids, start, settings), 0.1, 0.2)


@stepping
@each_bar_start
def test_bar_at_a_fifth_of_the_resolution(pyramids: AttitudeContact, start: Pose, *, large: bool) -> None:
    settings = with_steps(FINE_BAR, LARGE_MM["bar"]) if large else FINE_BAR
    check_bar(solve_incremental(pyramids, start, settings), 0.02, 0.05)


@each_bar_start
def test_bar_by_the_plain_rules(pyramids: AttitudeContact, start: Pose) -> None:
    check_bar(solve_incremental(pyramids, start, replace(PAPER, classic=True)), 0.1, 0.2)


@pytest.mark.parametrize("start", BAR_STARTS[:4])
def test_bar_by_the_plain_rules_with_large_steps(pyramids: AttitudeContact, start: Pose) -> None:
    """From the last start a step of 20 mm lifts the bar clear of the pyramids, and no guard takes it back."""
    settings = replace(with_steps(PAPER, LARGE_MM["bar"]), classic=True)
    found = solve_incremental(pyramids, start, settings)
    assert found.status is Status.OK
    assert abs(found.pose.x) < 0.1
    assert abs(np.degrees(found.pose.theta)) < 0.2


@pytest.mark.parametrize("classic", [False, True])
def test_cycle_case_of_the_paper(pyramids: AttitudeContact, *, classic: bool) -> None:
    """From 0.5 mm aside a step of 1 mm leads from one pyramid to the other for ever: only halved steps touch both."""
    for x, side in ((0.5, 1.0), (-0.5, -1.0)):
        landed = drop(pyramids, Pose(x, 0.0, -20.0, 0.1), PAPER.motion)
        assert landed is not None
        touched = pyramids.contacts(landed, PAPER.contact_band_mm).points
        assert np.all(touched[:, 0] * side > 0.0)
    found = solve_incremental(pyramids, Pose(0.5, 0.0, -20.0, 0.1), replace(PAPER, classic=classic))
    assert found.cycles >= 1
    check_bar(found, 0.1, 0.2)


@pytest.mark.parametrize("step_mm", [1.0, 8.0])
def test_two_balls_in_two_dishes(step_mm: float) -> None:
    """Two balls fix the turn as well: nothing but the drop is neutral."""
    hollow, sphere = turned_down(dish(8.0, sectors=16)), turned_down(ball(4.0, sectors=12))
    pair = at_attitude(
        joined(shifted(hollow, -14.0), shifted(hollow, 14.0)), joined(shifted(sphere, -14.0), shifted(sphere, 14.0))
    )
    found = solve_incremental(pair, Pose(1.0, 0.5, -20.0, 0.1), replace(FINE, translation_step_mm=step_mm))
    assert found.status is Status.OK
    np.testing.assert_allclose(found.pose[:3], [0.0, 0.0, -4.0], atol=0.02)
    assert abs(np.degrees(found.pose.theta)) < 0.05


@pytest.mark.parametrize("flexion_deg", [0.0, 30.0, -50.0])
def test_turned_reference_gives_the_turned_answer(flexion_deg: float) -> None:
    """A dish turned with the attitude faces the ball as before: the coordinates of the pose do not change."""
    flexion = float(np.radians(flexion_deg))
    pair = BallInDish().pair()
    c, s = np.cos(-flexion), np.sin(-flexion)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    tilted = replace(pair.reference_body, points=pair.reference_body.points @ turn.T)
    check_ball(solve_incremental(at_attitude(tilted, pair.moving_body, flexion), BALL_STARTS[-1], SMOOTH), 0.1)


@pytest.mark.parametrize("step_mm", [1.0, 8.0])
def test_convex_on_convex_slides_off(step_mm: float) -> None:
    pair = at_attitude(ellipsoid((10, 8, 6)), ellipsoid((9, 12, 5)))
    settings = replace(PAPER, translation_step_mm=step_mm, slide_bound_mm=12.0)
    assert solve_incremental(pair, Pose(1.0, 0.5, -30.0, 0.0), settings).status is Status.SLID_OFF


def test_rolling_off_the_reference_is_sliding_off() -> None:
    """The bound is far away, but there is nothing left to touch."""
    pair = at_attitude(ellipsoid((4, 4, 4)), ellipsoid((4, 4, 4)))
    assert solve_incremental(pair, Pose(1.0, 0.5, -30.0, 0.0), PAPER).status is Status.SLID_OFF


def test_turning_past_the_bound_is_told(pyramids: AttitudeContact) -> None:
    found = solve_incremental(pyramids, BAR_STARTS[0], replace(PAPER, rotation_bound_rad=0.1))
    assert found.status is Status.ROTATION_BOUND


def test_no_contact(pyramids: AttitudeContact) -> None:
    start = Pose(100.0, 0.0, -20.0, 0.0)
    assert solve_incremental(pyramids, start, PAPER) == StablePose(start, Status.NO_CONTACT, 0, 0)


def test_motions_run_out(pyramids: AttitudeContact) -> None:
    assert solve_incremental(pyramids, BAR_STARTS[0], replace(PAPER, max_motions=2)).status is Status.NOT_CONVERGED


def test_start_inside_is_pulled_back_first(pyramids: AttitudeContact) -> None:
    check_bar(solve_incremental(pyramids, Pose(0.5, 0.0, -3.0, 0.1), PAPER), 0.1, 0.2)


def test_body_within_a_body_is_seen_by_nesting_alone() -> None:
    """Surfaces that do not cross say nothing: the drop ends at the far wall, from within."""
    room, cube = box((-30, 30), (-30, 30), (-30, 30)), box((-2, 2), (-2, 2), (-2, 2))
    landed = drop(at_attitude(room, cube), Pose(0.0, 0.0, 0.0, 0.0), PAPER.motion)
    assert landed is not None
    assert landed.z == pytest.approx(28.0, abs=1e-3)
    assert nested(room, cube)


@pytest.mark.parametrize("start", [BAR_STARTS[0], BAR_STARTS[4]])
def test_deterministic_to_the_bit(start: Pose) -> None:
    found = [solve_incremental(falling(BarOnPyramids().pair()), start, PAPER) for _ in range(2)]
    assert found[0] == found[1]


class Recorded(AttitudeContact):
    """Remembers the poses whose contacts were asked for: those the guarded search stood at, in order."""

    def __init__(self, other: AttitudeContact) -> None:
        super().__init__(other.bodies, 0.0, 0.0)
        self.stood: list[Pose] = []

    def contacts(self, pose: Pose, band_mm: float, *, along_only: bool = False) -> Contacts:
        self.stood.append(pose)
        return super().contacts(pose, band_mm, along_only=along_only)


@stepping
def test_guarded_search_never_loses_depth(pyramids: AttitudeContact, *, large: bool) -> None:
    recorded = Recorded(pyramids)
    solve_incremental(recorded, BAR_STARTS[4], with_steps(PAPER, 20.0) if large else PAPER)
    heights = np.array([pose.z for pose in recorded.stood])
    assert len(np.unique(heights)) > 5
    assert np.all(np.diff(heights) >= 0.0)


@each_bar_start
def test_stable_pose_is_certified(pyramids: AttitudeContact, start: Pose) -> None:
    """Equilibrium at the answer; clear of contact there, and intersecting one tolerance farther along delta."""
    found = solve_incremental(pyramids, start, FINE_BAR).pose
    assert equilibrium_residual(pyramids.contacts(found, FINE_BAR.contact_band_mm)) < 1e-6
    assert not pyramids.touches(found)
    assert pyramids.touches(found._replace(z=found.z + FINE_BAR.motion.tolerance_mm))


def pulled(pair: AttitudeContact, fibres: Fibres, angles_rad: tuple[float, float] = (0.0, 0.0)) -> AttitudeContact:
    """The same bodies with fibres between them."""
    return AttitudeContact(pair.bodies, *angles_rad, fibres)


#: Forces on the ball at the end of its springs: from where, and how much per mm, as multiples of the push.
PULLS = [((10.0, 4.0, -12.0), 0.05), ((6.0, 0.0, 5.0), 0.05), ((5.0, -2.0, -6.0), 0.3)]


@pytest.mark.parametrize(("anchor", "stiffness"), PULLS)
@each_ball_start
def test_ball_pulled_aside_rests_where_slope_and_springs_balance(
    bowl: AttitudeContact, start: Pose, anchor: tuple[float, float, float], stiffness: float
) -> None:
    """Springs of no length of their own pull in proportion to the distance; the middle of the ball moves on a sphere of
    radius 6 about (0, 0, -12), and rests where push and springs together point away from that.

    Two springs on either side keep the ball from turning. Away from its middle the dish has facets of a millimetre.
    """
    middle, sides = np.array([0.0, 0.0, -12.0]), np.array([[5.0, 0.0, 0.0], [-5.0, 0.0, 0.0]])
    fibres = Fibres(np.asarray(anchor) + sides, sides, np.zeros(2), np.full(2, 0.5 * stiffness))
    force = np.array([0.0, 0.0, 1.0]) + stiffness * (np.asarray(anchor) - middle)
    rest = middle + 6.0 * force / np.linalg.norm(force)
    loaded = pulled(bowl, fibres)
    found = solve_incremental(loaded, start, FINE)
    assert found.status is Status.OK
    np.testing.assert_allclose(found.pose[:3], rest, atol=0.15)
    assert np.hypot(*rest[:2]) > 0.9
    assert abs(np.degrees(found.pose.theta)) < 0.05
    contacts = loaded.contacts(found.pose, FINE.contact_band_mm)
    assert equilibrium_residual(contacts, loaded.load(found.pose)) < 3e-3
    assert equilibrium_residual(contacts) > 0.15


SLOPE = float(np.radians(20.0))
#: Down the groove that climbs by SLOPE, pushed along z.
DOWNHILL = rotation_x(SLOPE) @ [0.0, 1.0, 0.0]
#: Which way the tip's arm points when its fibre has turned it towards the anchor.
TOWARDS = -0.5 * np.pi
TIP_STARTS = [Pose(0.7, 3.0, -10.0, TOWARDS + 0.4), Pose(-1.0, -3.0, -10.0, TOWARDS - 0.5), Pose(0, 15, -10, TOWARDS)]
each_tip_start = pytest.mark.parametrize("start", TIP_STARTS)


def slide(angles_rad: tuple[float, float] = (0.0, 0.0)) -> AttitudeContact:
    """A tip in a V-shaped groove: held sideways, sliding for ever along y, free to turn."""
    trough, turn = groove(40.0), attitude_rotation(*angles_rad) @ rotation_x(SLOPE)
    tip = convex([(0.0, 0.0, 0.0), (-3.0, -4.0, -20.0), (4.0, -4.0, -20.0), (0.5, 4.0, -20.0)])
    return at_attitude(TriangleMesh(trough.points @ turn.T, trough.triangles), tip, *angles_rad)


def strap(slack_part: float, stiffness: float | None = None) -> Fibres:
    """A fibre from the tip's arm to the middle plane of the groove that balances the push at the origin.

    Stretched from a part of its length there; from its whole length where a stiffness is given.
    """
    arm, anchor = np.array([2.0, 0.0, -8.0]), np.array([0.0, -15.0, 5.0])
    way = anchor - [0.0, -2.0, -8.0]
    length = float(np.linalg.norm(way))
    tension = -DOWNHILL[2] * length / float(way @ DOWNHILL)
    slack = slack_part * length if stiffness is None else length - tension / stiffness
    return Fibres(anchor[None], arm[None], np.array([slack]), np.array([tension / (length - slack)]))


@pytest.mark.parametrize("slack_part", [0.5, 0.9, 0.98])
@each_tip_start
def test_a_fibre_holds_the_tip_on_its_slide(start: Pose, slack_part: float) -> None:
    loaded = pulled(slide(), strap(slack_part))
    found = solve_incremental(loaded, start, FINE_BAR)
    assert found.status is Status.OK
    np.testing.assert_allclose(found.pose[:3], np.zeros(3), atol=0.02)
    assert np.degrees(found.pose.theta - TOWARDS) == pytest.approx(0.0, abs=0.2)
    contacts = loaded.contacts(found.pose, FINE_BAR.contact_band_mm)
    assert equilibrium_residual(contacts, loaded.load(found.pose)) < 5e-3
    assert equilibrium_residual(contacts) == pytest.approx(np.sin(SLOPE), abs=1e-6)


@each_tip_start
def test_a_cord_ends_the_slide(start: Pose) -> None:
    found = solve_incremental(pulled(slide(), strap(0.0, CORD_STIFFNESS)), start, PAPER)
    assert found.status is Status.OK
    np.testing.assert_allclose(found.pose[:3], np.zeros(3), atol=0.02)


def test_without_the_fibre_it_slides_off() -> None:
    assert solve_incremental(slide(), TIP_STARTS[0], replace(PAPER, slide_bound_mm=12.0)).status is Status.SLID_OFF


def test_the_strap_turns_with_the_reference() -> None:
    """Reference and attachment turned with the attitude: the same stable pose."""
    angles, fibres = (0.7, -0.2), strap(0.9)
    turned = fibres._replace(on_reference=fibres.on_reference @ attitude_rotation(*angles).T)
    found = solve_incremental(pulled(slide(angles), turned, angles), TIP_STARTS[0], FINE_BAR)
    np.testing.assert_allclose(found.pose[:3], np.zeros(3), atol=0.02)


@each_bar_start
def test_slack_fibres_change_nothing(pyramids: AttitudeContact, start: Pose) -> None:
    slack = Fibres(np.zeros((2, 3)), np.ones((2, 3)), np.array([200.0, 300.0]), np.array([5.0, 1.0]))
    assert solve_incremental(pulled(pyramids, slack), start, PAPER) == solve_incremental(pyramids, start, PAPER)


class _Counted:
    """Bodies that count how often they are asked whether they intersect."""

    def __init__(self, bodies: Bodies) -> None:
        self.bodies, self.asked = bodies, 0

    def __getattr__(self, name: str) -> object:
        return getattr(self.bodies, name)

    def intersect(self, rotation: Float, shift: Float) -> bool:
        self.asked += 1
        return self.bodies.intersect(rotation, shift)


def quick_and_whole(
    contact: AttitudeContact, start: Pose, settings: IncrementalSettings, monkeypatch: pytest.MonkeyPatch
) -> tuple[tuple[StablePose, int], tuple[StablePose, int]]:
    """The same search with early rejection and without, each with the number of collision tests."""
    out = []
    for early in (True, False):
        counted = _Counted(contact.bodies)
        with monkeypatch.context() as patch:
            patch.setattr(contact, "bodies", counted)
            out.append((solve_incremental(contact, start, replace(settings, early_rejection=early)), counted.asked))
    return out[0], out[1]


def test_early_rejection_saves_tests_and_changes_nothing(
    pyramids: AttitudeContact, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = [quick_and_whole(pyramids, start, PAPER, monkeypatch) for start in BAR_STARTS]
    assert all(quick == whole for (quick, _), (whole, _) in both)
    assert sum(asked for (_, asked), _ in both) < 0.9 * sum(asked for _, (_, asked) in both)


@each_tip_start
def test_early_rejection_changes_nothing_where_fibres_pull(start: Pose, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = pulled(slide(), strap(0.5))
    (quick, _), (whole, _) = quick_and_whole(loaded, start, PAPER, monkeypatch)
    assert quick == whole


def test_early_rejection_leaves_the_plain_rules_alone(
    pyramids: AttitudeContact, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = replace(PAPER, classic=True)
    (quick, asked), (whole, asked_whole) = quick_and_whole(pyramids, BAR_STARTS[0], settings, monkeypatch)
    assert (quick, asked) == (whole, asked_whole)
