"""Voxels inside a closed mesh, on grids that lie any way round."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.adapters.mesh_mask import mesh_to_mask
from pipeline.geometry.mesh import TriangleMesh, volume_mm3
from pipeline.geometry.validation_objects import ball, box
from pipeline.kinematics.joint_coordinates import rotation_x, rotation_z

Float = NDArray[np.float64]
RADIUS_MM = 10.0


def grid(*, turned: bool, flipped: bool) -> tuple[tuple[int, int, int], Float]:
    """A grid of 0.5 x 0.6 x 0.8 mm about the origin."""
    shape = (60, 50, 40)
    spacing = np.diag([0.5, 0.6, 0.8])
    if flipped:
        spacing[0] *= -1.0
    turn = rotation_x(0.4) @ rotation_z(0.7) if turned else np.eye(3)
    matrix: Float = np.eye(4)
    matrix[:3, :3] = turn @ spacing
    matrix[:3, 3] = -matrix[:3, :3] @ (0.5 * np.array(shape) + 0.2)
    return shape, matrix


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("flipped", [False, True])
def test_a_ball_has_the_voxels_whose_centres_lie_in_it(turned: bool, flipped: bool) -> None:  # noqa: FBT001 - a case
    mesh = ball(RADIUS_MM, sectors=48)
    shape, matrix = grid(turned=turned, flipped=flipped)
    mask = mesh_to_mask(mesh, shape, matrix)
    centres = np.moveaxis(np.indices(shape), 0, -1) @ matrix[:3, :3].T + matrix[:3, 3]
    distance = np.linalg.norm(centres, axis=-1)
    assert mask[distance < RADIUS_MM - 0.1].all()  # facets lie up to 0.05 mm inside the ball
    assert not mask[distance > RADIUS_MM + 0.01].any()
    voxel = abs(np.linalg.det(matrix[:3, :3]))
    assert np.count_nonzero(mask) * voxel == pytest.approx(volume_mm3(mesh), rel=0.01)


def test_a_box_has_exactly_its_voxels() -> None:
    lps_from_index = np.diag([1.0, 1.0, 2.0, 1.0])
    lps_from_index[:3, 3] = [-4.0, -3.0, 1.0]
    mask = mesh_to_mask(box((-1.4, 2.3), (-0.6, 0.7), (2.5, 8.9)), (9, 8, 7), lps_from_index)
    expected = np.zeros((9, 8, 7), dtype=bool)
    expected[3:7, 3:4, 1:4] = True
    np.testing.assert_array_equal(mask, expected)


def test_an_index_out_of_range_is_refused() -> None:
    mesh = ball(RADIUS_MM)
    wrong = TriangleMesh(mesh.points, mesh.triangles + len(mesh.points))
    with pytest.raises(ValueError, match="the mesh"):
        mesh_to_mask(wrong, (4, 4, 4), np.eye(4))
