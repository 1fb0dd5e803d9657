"""Contacts and reaction rates against closed forms and finite differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.geometry.validation_objects import BallInDish, BarOnPyramids, box
from pipeline.kinematics.contact import STEEPEST_COSINE, AttitudeContact, Contacts, Pose, reaction_rates, reaction_slack
from pipeline.kinematics.descent import MotionSettings, drop
from pipeline.kinematics.incremental import motion_options
from pipeline.kinematics.joint_coordinates import attitude_rotation, rotation_z
from pipeline.kinematics.ligaments import Fibres, fibre_load
from tests.kinematics.shapes import at_attitude, convex, falling, groove

Float = NDArray[np.float64]
Height = Callable[[float, float, float], float]
EXACT = MotionSettings(tolerance_mm=1e-6)


def contacts_of(points: object, normals: object, gaps: object) -> Contacts:
    made = np.asarray(points, dtype=float), np.asarray(normals, dtype=float), np.asarray(gaps, dtype=float)
    return Contacts(*made)


def differences(height: Height, at: tuple[float, float, float], step: float = 1e-5) -> Float:
    slopes = []
    for axis in range(3):
        there, back = np.array(at), np.array(at)
        there[axis] += step
        back[axis] -= step
        slopes.append((height(*there) - height(*back)) / (2.0 * step))
    return np.array(slopes)


def unit(*vector: float) -> Float:
    return np.asarray(np.asarray(vector) / np.linalg.norm(vector))


def eccentric(normal: Float) -> Height:
    """Sphere of radius 5 whose centre is 7 mm off the body's origin, on the plane normal . p = 0."""

    def height(x: float, y: float, turn: float) -> float:
        return float((5.0 - normal[0] * (x + 7.0 * np.cos(turn)) - normal[1] * (y + 7.0 * np.sin(turn))) / normal[2])

    return height


NORMALS = [unit(0.3, -0.2, -1.0), unit(-0.8, 0.5, -0.6), unit(0.0, 0.0, -1.0)]


@pytest.mark.parametrize("normal", NORMALS)
@pytest.mark.parametrize("theta", [0.0, 0.7, -2.0])
def test_rates_of_an_eccentric_sphere_on_a_plane(normal: Float, theta: float) -> None:
    height = eccentric(normal)
    x, y = 1.5, -0.4
    centre = np.array([x + 7.0 * np.cos(theta), y + 7.0 * np.sin(theta), height(x, y, theta)])
    pose = Pose(x, y, height(x, y, theta), theta)
    found = reaction_rates(contacts_of([centre - 5.0 * normal], [normal], [0.0]), pose)[0]
    np.testing.assert_allclose(found, differences(height, (x, y, theta)), atol=1e-7)


@pytest.mark.parametrize("normal", NORMALS)
@pytest.mark.parametrize("theta", [0.3, -1.1])
def test_rates_of_an_ellipsoid_on_a_plane(normal: Float, theta: float) -> None:
    """The support function of the ellipsoid with semi-axes 9, 4, 6 gives its height and its contact point."""
    shape = np.diag([9.0, 4.0, 6.0]) ** 2

    def spread(turn: float) -> Float:
        return np.asarray(rotation_z(turn) @ shape @ rotation_z(turn).T @ normal)

    def height(x: float, y: float, turn: float) -> float:
        return float((np.sqrt(normal @ spread(turn)) - normal[0] * x - normal[1] * y) / normal[2])

    pose = Pose(0.8, 2.0, height(0.8, 2.0, theta), theta)
    lowest = np.asarray(pose[:3]) - spread(theta) / np.sqrt(normal @ spread(theta))
    found = reaction_rates(contacts_of([lowest], [normal], [0.0]), pose)[0]
    np.testing.assert_allclose(found, differences(height, (0.8, 2.0, theta)), atol=1e-6)


@pytest.mark.parametrize("normal", NORMALS)
@pytest.mark.parametrize("slack_mm", [2.0, 8.0, 100.0])
def test_rates_and_slack_of_the_merit_with_a_fibre(normal: Float, slack_mm: float) -> None:
    """The same sphere pulled by a fibre from its side: what its merit grows by, not its depth."""
    ends = np.array([[4.0, -6.0, -3.0]]), np.array([[2.0, 3.0, 1.0]])
    fibre = Fibres(*ends, np.array([slack_mm]), np.array([0.05]))
    height = eccentric(normal)

    def merit(x: float, y: float, turn: float) -> float:
        z = height(x, y, turn)
        return z - fibre_load(fibre, (x, y, turn, z)).energy_mm

    at = (1.5, -0.4, 0.7)
    pose = Pose(*at[:2], height(*at), at[2])
    load = fibre_load(fibre, (*at, pose.z))
    point = np.array([at[0] + 7.0 * np.cos(0.7), at[1] + 7.0 * np.sin(0.7), pose.z]) - 5.0 * normal
    touching = contacts_of([point], [normal], [0.02])
    np.testing.assert_allclose(reaction_rates(touching, pose, load)[0], differences(merit, at), atol=1e-7)
    rise = 1e-4 * reaction_slack(touching, load)[0] / reaction_slack(touching)[0]
    farther = fibre_load(fibre, (*at, pose.z + 1e-4)).energy_mm - load.energy_mm
    assert rise == pytest.approx(1e-4 - farther, abs=1e-9)


def test_without_a_taut_fibre_the_merit_is_the_depth() -> None:
    slack = Fibres(np.zeros((1, 3)), np.zeros((1, 3)), np.array([50.0]), np.array([9.0]))
    upright = falling(BarOnPyramids().pair())
    for pair in (upright, AttitudeContact(upright.bodies, 0.3, 0.1, slack)):
        assert pair.merit(Pose(1.0, 2.0, -7.25, 0.3)) == -7.25
        assert pair.load(Pose(1.0, 2.0, -7.25, 0.3)).push == 1.0


@pytest.mark.parametrize(("flexion", "varus"), [(0.4, 0.0), (-1.0, 0.3)])
def test_fibres_turn_with_the_reference(flexion: float, varus: float) -> None:
    """An attachment in the reference's frame is where that frame is at the attitude."""
    fibre = Fibres(np.array([[9.0, -2.0, 4.0]]), np.array([[1.0, 0.5, -3.0]]), np.array([3.0]), np.array([0.2]))
    turned = fibre._replace(on_reference=fibre.on_reference @ attitude_rotation(flexion, varus).T)
    bodies, pose = falling(BarOnPyramids().pair()).bodies, Pose(0.3, -1.0, -6.0, 0.2)
    here = AttitudeContact(bodies, 0.0, 0.0, fibre)
    there = AttitudeContact(bodies, flexion, varus, turned)
    assert here.merit(pose) < pose.z
    assert there.merit(pose) == pytest.approx(here.merit(pose))
    np.testing.assert_allclose(there.load(pose).slope, here.load(pose).slope, atol=1e-12)
    assert AttitudeContact(bodies, flexion, varus, fibre).merit(pose) != pytest.approx(here.merit(pose), abs=0.01)


@pytest.mark.parametrize(("u", "theta"), [(0.4, 0.1), (-0.7, 0.1), (0.9, -0.2), (-0.2, -0.15)])
def test_rates_of_the_bar_are_the_slopes_of_its_closed_form(u: float, theta: float) -> None:
    """One edge on one edge: the mesh's contact predicts how the standing height changes, in size and in sign."""
    bar = BarOnPyramids()

    def height(x: float, y: float, turn: float) -> float:
        return -bar.standing_height_mm(x * np.cos(turn) + y * np.sin(turn), turn)

    pyramids = falling(bar.pair())
    landed = drop(pyramids, Pose(u, 0.5, -20.0, theta), EXACT)
    assert landed is not None
    assert landed.z == pytest.approx(height(u, 0.5, theta), abs=1e-5)
    found = reaction_rates(pyramids.contacts(landed, 0.01), landed)
    assert len(found) == 1
    np.testing.assert_allclose(found[0], differences(height, (u, 0.5, theta)), atol=1e-4)


@pytest.mark.parametrize("theta", [0.1, -0.1])
def test_torque_turns_the_bar_back(theta: float) -> None:
    pyramids = falling(BarOnPyramids().pair())
    landed = drop(pyramids, Pose(0.0, 0.0, -20.0, theta), EXACT)
    assert landed is not None
    options = motion_options(pyramids.contacts(landed, 0.01), landed)
    assert np.sign(options["rotation"][0][2]) == -np.sign(theta)


def test_steep_walls_keep_their_reaction_finite() -> None:
    wall = contacts_of([[1.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]], [0.01])
    np.testing.assert_allclose(reaction_rates(wall, Pose(0, 0, 0, 0)), [[1.0 / STEEPEST_COSINE, 0.0, 0.0]])
    assert reaction_slack(wall) == pytest.approx([0.01 / STEEPEST_COSINE])


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 60.0])
def test_slack_is_the_way_along_delta(angle_deg: float) -> None:
    angle = np.radians(angle_deg)
    slope = contacts_of([[0.0, 0.0, 0.0]], [[np.sin(angle), 0.0, -np.cos(angle)]], [0.2])
    assert reaction_slack(slope) == pytest.approx([0.2 / np.cos(angle)])


@pytest.mark.parametrize("band_mm", [0.05, 0.002, 2e-4])
@pytest.mark.parametrize("offset_mm", [0.0, 0.1, 0.5, 1.5])
def test_the_nearest_contact_is_among_them_on_fine_facets(offset_mm: float, band_mm: float) -> None:
    """At exact contact something touches, however much smaller than the band the facets are."""
    bowl = falling(BallInDish().pair())
    landed = drop(bowl, Pose(offset_mm, 0.3 * offset_mm, -20.0, 0.0), EXACT)
    assert landed is not None
    found = bowl.contacts(landed, band_mm)
    assert found.gaps.min() < max(2e-4, 2e-6)
    assert np.all(found.gaps <= band_mm)
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0, atol=1e-9)


@pytest.mark.parametrize("tolerance_mm", [2e-4, 1e-6])
def test_a_corner_in_a_groove_rests_on_both_walls(tolerance_mm: float) -> None:
    """One vertex, two faces: two reactions, even where the gap is below the rounding that removes repetition."""
    corner = convex([(0.0, 0.3, 0.0), (-1.0, -1.0, -5.0), (1.0, -1.2, -5.0), (0.1, 1.5, -5.0)])
    pair = at_attitude(groove(), corner)
    landed = drop(pair, Pose(0.0, 0.0, -20.0, 0.0), MotionSettings(tolerance_mm))
    assert landed is not None
    found = pair.contacts(landed, 0.05)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(sorted(found.normals.tolist()), [[-half, 0, -half], [half, 0, -half]], atol=1e-6)


def test_contacts_do_not_depend_on_the_triangulation() -> None:
    """A box on a slab, its top cut into two or into many triangles: the same four corners carry it."""
    slab = box((-9.0, 9.0), (-9.0, 9.0), (0.0, 3.0))
    steps = np.linspace(-9.0, 9.0, 8)
    lattice = convex([(x, y, z) for x in steps for y in steps for z in (0.0, 3.0)])
    cube = box((-2.0, 2.0), (-2.0, 2.0), (-4.0, 0.0))
    corners = []
    for reference in (slab, lattice):
        pair = at_attitude(reference, cube)
        landed = drop(pair, Pose(0.1, 0.2, -8.0, 0.3), EXACT)
        assert landed is not None
        found = pair.contacts(landed, 0.01)
        np.testing.assert_allclose(found.normals, np.tile([0.0, 0.0, -1.0], (len(found), 1)), atol=1e-6)
        corners.append([found.points.min(axis=0), found.points.max(axis=0)])
    np.testing.assert_allclose(corners[0], corners[1], atol=1e-4)


@pytest.mark.parametrize(("flexion", "varus"), [(0.4, 0.0), (-1.0, 0.3), (2.0, -0.2)])
def test_everything_is_told_in_the_attitude_frame(flexion: float, varus: float) -> None:
    """A reference turned with the attitude is met exactly as before."""
    upright, turn = BarOnPyramids().pair(), attitude_rotation(flexion, varus)
    turned = type(upright.reference_body)(upright.reference_body.points @ turn.T, upright.reference_body.triangles)
    pairs = [falling(upright), at_attitude(turned, upright.moving_body, flexion, varus)]
    start = Pose(0.4, 0.5, -20.0, 0.1)
    here, there = (drop(pair, start, EXACT) for pair in pairs)
    assert here is not None
    assert there is not None
    np.testing.assert_allclose(here, there, atol=2e-6)
    first, second = (pair.contacts(here, 0.01) for pair in pairs)
    np.testing.assert_allclose(first.points, second.points, atol=1e-6)
    np.testing.assert_allclose(first.normals, second.normals, atol=1e-3)
