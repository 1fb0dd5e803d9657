"""The paper's test objects: closed, as large as promised, and their closed forms against independent reckoning."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.validation_objects import BallInDish, BarOnPyramids, ball, box, dish

BALL, BAR = BallInDish(), BarOnPyramids()
MESHES = {
    **BALL.pair().reference,
    **BALL.pair().moving,
    **BAR.pair().reference,
    **BAR.pair().moving,
    "reference_body": BAR.pair().reference_body,
}
RADIUS, HEIGHT = 12.0 * np.sin(0.9), 12.0 * (1.0 - np.cos(0.9))
CAP = np.pi * HEIGHT**2 * (12.0 - HEIGHT / 3.0)
VOLUMES = {
    "ball": (4.0 / 3.0 * np.pi * 6.0**3, 0.02),
    "dish": (np.pi * (RADIUS + 3.0) ** 2 * (HEIGHT + 3.0) - CAP, 0.02),
    "bar": (20.0 * 60.0 * 8.0, 1e-12),
    "left_pyramid": (24.0 * 24.8 / 2.0 * 16.0 / 3.0, 1e-12),
    "right_pyramid": (24.0 * 24.8 / 2.0 * 16.0 / 3.0, 1e-12),
    "reference_body": (24.0 * 24.8 * 16.0 / 3.0, 1e-12),
}


def volume(mesh: TriangleMesh) -> float:
    a, b, c = np.moveaxis(mesh.points[mesh.triangles], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


@pytest.mark.parametrize("name", MESHES)
def test_closed_and_outward(name: str) -> None:
    mesh = MESHES[name]
    edges = [tuple(edge) for edge in mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()]
    assert len(set(edges)) == len(edges)
    assert {(b, a) for a, b in edges} == set(edges)
    expected, tolerance = VOLUMES[name]
    assert volume(mesh) == pytest.approx(expected, rel=tolerance)


@pytest.mark.parametrize("offset_mm", [0.0, 0.02, 0.05, 0.1])
def test_facets_change_the_height_of_contact_less_than_promised(offset_mm: float) -> None:
    """Exact for the facets: the ball may sink until its support touches the first of the hollow's planes."""
    hollow, corners = dish(12.0), ball(6.0).points
    a, b, c = np.moveaxis(hollow.points[hollow.triangles], 1, 0)
    near = (np.hypot(a[:, 0], a[:, 1]) < 3.0) & (a[:, 2] < 1.0) & (a[:, 2] > -1.0)
    normals = np.cross(b - a, c - a)[near]
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    for direction in np.linspace(0.0, 2.0 * np.pi, 7):
        x, y = offset_mm * np.cos(direction), offset_mm * np.sin(direction)
        plane = np.einsum("ij,ij->i", normals, a[near]) - (normals @ corners.T).min(axis=1)
        height = ((plane - normals[:, 0] * x - normals[:, 1] * y) / normals[:, 2]).max()
        smooth = 12.0 - np.sqrt(6.0**2 - offset_mm**2)
        assert height == pytest.approx(smooth, abs=1e-9 if offset_mm == 0.0 else 1.6e-4)


@pytest.mark.parametrize("turn_deg", [-25.0, -8.0, 0.0, 3.0, 20.0])
@pytest.mark.parametrize("sideways_mm", [-2.0, 0.0, 1.0])
def test_standing_height_against_the_outlines(turn_deg: float, sideways_mm: float) -> None:
    """Lowest height at which both horizontal sections of the pyramids lie beside the strip under the bar."""
    turn = np.radians(turn_deg)
    across = np.array([np.cos(turn), np.sin(turn)])

    def clear(height: float) -> bool:
        inner, reach = 6.0 + 0.8 * height, 12.0 * (1.0 - height / 16.0)
        ends = np.array([[inner, reach], [inner, -reach]])
        return bool((ends @ across).min() >= 10.0 + sideways_mm and (-ends @ across).max() <= -10.0 + sideways_mm)

    low, high = 0.0, 16.0
    while high - low > 1e-9:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if clear(middle) else (middle, high)
    assert BAR.standing_height_mm(sideways_mm, turn) == pytest.approx(high, abs=1e-7)


def test_least_height_is_unturned_in_the_middle() -> None:
    found = minimize_scalar(lambda turn: BAR.standing_height_mm(0.0, turn), bounds=(-0.4, 0.4), method="bounded")
    assert found.x == pytest.approx(0.0, abs=1e-4)
    assert BAR.standing_height_mm(0.0, 0.0) == BAR.rest_height_mm == pytest.approx(5.0)
    assert BAR.standing_height_mm(0.3, 0.0) > 5.0
    assert BAR.neutral_range_mm == pytest.approx(30.0 - 8.25)


@pytest.mark.parametrize("made", [BALL, BAR], ids=["ball", "bar"])
def test_frames_are_right_handed_and_fall_along_z(made: BallInDish | BarOnPyramids) -> None:
    pair = made.pair()
    for frame in (pair.scan_from_reference, pair.scan_from_moving):
        np.testing.assert_allclose(frame[:3, :3] @ frame[:3, :3].T, np.eye(3), atol=1e-15)
        assert np.linalg.det(frame[:3, :3]) == pytest.approx(1.0)
        np.testing.assert_array_equal(frame[:, 2], [0.0, 0.0, -1.0, 0.0])


def test_bodies_in_their_own_frames() -> None:
    np.testing.assert_allclose(BALL.pair().moving_body.points, ball(6.0).points * [1.0, -1.0, -1.0], atol=1e-12)
    bar = BAR.pair().moving_body.points
    np.testing.assert_allclose([bar.min(axis=0), bar.max(axis=0)], [[-10, -30, -8], [10, 30, 0]], atol=1e-12)


def test_box_is_between_its_bounds() -> None:
    made = box((-1.0, 2.0), (3.0, 5.0), (-4.0, -1.0))
    np.testing.assert_array_equal([made.points.min(axis=0), made.points.max(axis=0)], [[-1, 3, -4], [2, 5, -1]])
    assert volume(made) == pytest.approx(18.0)
