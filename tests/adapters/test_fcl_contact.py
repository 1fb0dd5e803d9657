"""FCL behind our checks: what it must refuse, and its two answers against geometry that can be reckoned."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.adapters.fcl_contact import FclBodies
from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.validation_objects import box

Float = NDArray[np.float64]
CUBE = box((-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0))
STILL = np.eye(3)


def with_points(points: Float) -> TriangleMesh:
    return TriangleMesh(points, CUBE.triangles)


def changed(value: float) -> Float:
    points = CUBE.points.copy()
    points[3, 1] = value
    return points


BAD_MESHES = [
    (TriangleMesh(np.empty((0, 3)), np.empty((0, 3), np.int32)), "needs points and triangles, got an empty mesh"),
    (TriangleMesh(CUBE.points, np.empty((0, 3), np.int32)), "needs points and triangles, got an empty mesh"),
    (with_points(changed(np.nan)), "finite numbers"),
    (with_points(changed(-np.inf)), "finite numbers"),
    (TriangleMesh(CUBE.points[:7], CUBE.triangles), "names a point that is not there"),
    (TriangleMesh(CUBE.points, CUBE.triangles - 1), "names a point that is not there"),
]


@pytest.mark.parametrize("as_moving", [False, True])
@pytest.mark.parametrize(("mesh", "problem"), BAD_MESHES)
def test_unusable_meshes_are_refused(mesh: TriangleMesh, problem: str, *, as_moving: bool) -> None:
    with pytest.raises(ValueError, match=problem):
        FclBodies(CUBE, mesh) if as_moving else FclBodies(mesh, CUBE)


BAD_PLACEMENTS = [
    (2.0 * STILL, np.zeros(3)),
    (np.diag([1.0, 1.0, -1.0]), np.zeros(3)),
    (-STILL, np.zeros(3)),
    (STILL + 1e-3, np.zeros(3)),
    (np.full((3, 3), np.nan), np.zeros(3)),
    (STILL, np.array([0.0, np.nan, 0.0])),
    (STILL, np.array([0.0, 0.0, np.inf])),
]


@pytest.mark.parametrize(("rotation", "shift"), BAD_PLACEMENTS)
def test_unusable_placements_are_refused(rotation: Float, shift: Float) -> None:
    bodies = FclBodies(CUBE, CUBE)
    for ask in (bodies.intersect, bodies.crossing_pairs):
        with pytest.raises(ValueError, match=r"a proper rotation .* and a finite shift"):
            ask(rotation, shift)


@pytest.mark.parametrize("gap_mm", [1e-7, 1e-4, 0.5])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_parallel_faces_to_a_ten_millionth_of_a_millimetre(gap_mm: float, seed: int) -> None:
    """Clear by the gap or crossing by it, wherever both stand in space."""
    place = Rotation.random(random_state=np.random.default_rng(seed))
    fixed = TriangleMesh(place.apply(CUBE.points), CUBE.triangles)
    bodies = FclBodies(fixed, CUBE)
    for sign, expected in ((1.0, False), (-1.0, True)):
        shift = place.apply([0.3, -0.2, 2.0 + sign * gap_mm])
        assert bodies.intersect(place.as_matrix(), shift) is expected
        assert (len(bodies.crossing_pairs(place.as_matrix(), shift)) > 0) is expected


def test_random_boxes_against_separating_axes() -> None:
    """Two turned boxes are apart exactly when one of 15 directions separates them."""
    random = np.random.default_rng(11)
    bodies, answers = FclBodies(CUBE, CUBE), []
    for _ in range(300):
        turn = Rotation.random(random_state=random).as_matrix()
        shift = random.normal(size=3)
        shift *= random.uniform(2.0, 3.5) / np.linalg.norm(shift)
        answers.append(bodies.intersect(turn, shift))
        assert answers[-1] is boxes_overlap(turn, shift)
    assert 30 < sum(answers) < 270


def boxes_overlap(turn: Float, shift: Float) -> bool:
    crosses = [np.cross(STILL[i], turn[:, j]) for i in range(3) for j in range(3)]
    moved = CUBE.points @ turn.T + shift
    for axis in (*STILL, *turn.T, *crosses):
        one, other = CUBE.points @ axis, moved @ axis
        if one.max() < other.min() or other.max() < one.min():
            return False
    return True


def test_crossing_pairs_are_sorted_unique_and_name_reference_then_moving() -> None:
    """The tip of a needle through the top of a cube crosses only triangles of that top."""
    needle = TriangleMesh(
        np.array([[0.2, 0.1, 0.5], [0.0, 0.0, 4.0], [0.5, 0.0, 4.0], [0.0, 0.5, 4.0]]),
        np.array([[0, 2, 1], [0, 3, 2], [0, 1, 3], [1, 2, 3]], dtype=np.int32),
    )
    found = FclBodies(CUBE, needle).crossing_pairs(STILL, np.zeros(3))
    assert found.dtype == np.int64
    np.testing.assert_array_equal(found, np.unique(found, axis=0))
    assert np.all(CUBE.points[CUBE.triangles[found[:, 0]]][:, :, 2] == 1.0)
    assert set(found[:, 1].tolist()) == {0, 1, 2}


def test_nothing_crosses_without_contact() -> None:
    assert FclBodies(CUBE, CUBE).crossing_pairs(STILL, np.array([5.0, 0.0, 0.0])).shape == (0, 2)


def test_queries_leave_no_trace() -> None:
    bodies, near, far = FclBodies(CUBE, CUBE), np.array([1.5, 0.0, 0.0]), np.array([9.0, 0.0, 0.0])
    first = bodies.crossing_pairs(STILL, near)
    assert not bodies.intersect(STILL, far)
    np.testing.assert_array_equal(bodies.crossing_pairs(STILL, near), first)
    np.testing.assert_array_equal(FclBodies(CUBE, CUBE).crossing_pairs(STILL, near), first)


@pytest.mark.parametrize("gap_mm", [0.01, 0.7, 4.0])
def test_compartment_gaps_of_a_tilted_plate(gap_mm: float) -> None:
    """Medial is x < 0 of the moving body: the low side of a plate that leans over a slab, exactly reckoned."""
    slab, plate = box((-30, 30), (-30, 30), (0, 5)), box((-20, 20), (-5, 5), (-2, 0))
    split = TriangleMesh(plate.points, plate.triangles)
    turn = Rotation.from_rotvec([0.0, 0.1, 0.0]).as_matrix()
    low = (plate.points @ turn.T)[:, 2].max()
    bodies = FclBodies(slab, split)
    gaps = [bodies.compartment_gap(side, turn, np.array([0.0, 0.0, -low - gap_mm])) for side in ("medial", "lateral")]
    assert min(gaps) == pytest.approx(gap_mm, abs=1e-9)


def test_a_compartment_that_is_not_there_has_no_gap() -> None:
    aside = box((1.0, 2.0), (-1.0, 1.0), (-1.0, 1.0))
    assert np.isnan(FclBodies(CUBE, aside).compartment_gap("medial", STILL, np.array([0.0, 0.0, 9.0])))
