"""The chain from mask to mesh: accuracy, topology, equivariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.adapters import mask_surface
from pipeline.adapters.mask_surface import SurfaceResult, SurfaceSettings, SurfaceTask, mask_to_mesh, meshes_of
from pipeline.geometry.mesh import TriangleMesh, check_closed, face_normals, genus, volume_mm3
from tests.geometry.meshes import ball, centred, grid, turned

Spacing = tuple[float, float, float]
SETTINGS = SurfaceSettings(triangles=6000)


def _torus_mask(spacing: Spacing) -> NDArray[np.bool_]:
    x, y, z = grid((54, 54, 20), spacing)
    return np.asarray((np.hypot(x, y) - 8.5) ** 2 + z**2 < 9.0)


@pytest.mark.parametrize(("spacing", "mean", "spread"), [((0.5, 0.5, 0.5), 0.05, 0.03), ((0.7, 0.7, 2.0), 0.05, 0.15)])
def test_a_ball_of_20_mm(spacing: Spacing, mean: float, spread: float) -> None:
    mask = ball(20.0, spacing)
    result = mask_to_mesh(mask, centred(mask.shape, spacing), SETTINGS)
    check_closed(result.mesh, "ball")
    away = np.linalg.norm(result.mesh.points, axis=1) - 20.0
    assert abs(away.mean()) < mean
    assert away.std() < spread
    assert volume_mm3(result.mesh) == pytest.approx(4.0 / 3.0 * np.pi * 20.0**3, rel=5e-3)
    assert len(result.mesh.triangles) <= 6000
    middle = result.mesh.points[result.mesh.triangles].mean(axis=1)
    cosines = (face_normals(result.mesh) * middle).sum(axis=1) / np.linalg.norm(middle, axis=1)
    assert np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).mean() < 8.0


def test_a_torus_keeps_its_hole() -> None:
    mask = _torus_mask((0.5, 0.5, 0.5))
    result = mask_to_mesh(mask, centred(mask.shape, (0.5, 0.5, 0.5)), replace(SETTINGS, triangles=2000))
    assert genus(result.mesh) == 1
    assert volume_mm3(result.mesh) == pytest.approx(2.0 * np.pi**2 * 8.5 * 9.0, rel=1e-2)


def test_a_mask_at_the_border_is_closed() -> None:
    mask = ball(10.0, (0.5, 0.5, 0.5))[:, :, 20:]
    result = mask_to_mesh(mask, np.diag([0.5, 0.5, 0.5, 1.0]), SETTINGS)
    check_closed(result.mesh, "cut ball")
    assert abs(result.volume_error) < 0.01


@pytest.mark.parametrize("spacing", [(0.5, 0.5, 0.5), (0.36458333, 0.36458333, 0.7)])
def test_a_moved_volume_gives_the_moved_mesh(spacing: Spacing) -> None:
    mask = _torus_mask(spacing)
    settings = replace(SETTINGS, triangles=1500)
    still = mask_to_mesh(mask, np.diag([*spacing, 1.0]), settings).mesh
    for motion in (turned((1, 2, 3), 0.3, (100, -50, 900)), turned((-1, 0.2, 0), 2.0, (0.1, 0.2, 0.3))):
        moved = mask_to_mesh(mask, motion @ np.diag([*spacing, 1.0]), settings).mesh
        assert np.array_equal(moved.triangles, still.triangles)
        expected = still.points @ motion[:3, :3].T + motion[:3, 3]
        assert np.abs(moved.points - expected).max() < 1e-9


def test_a_mirrored_volume_gives_the_exactly_mirrored_mesh() -> None:
    mask = _torus_mask((0.5, 0.5, 0.6))
    matrix = turned((1, 2, 3), 0.3, (100, -50, 900)) @ np.diag([0.5, 0.5, 0.6, 1.0])
    one = mask_to_mesh(mask, matrix, SETTINGS).mesh
    other = mask_to_mesh(mask, np.diag([-1.0, 1.0, 1.0, 1.0]) @ matrix, SETTINGS).mesh
    assert np.array_equal(other.points, one.points * [-1.0, 1.0, 1.0])
    assert volume_mm3(other) == pytest.approx(volume_mm3(one))


def test_air_around_the_mask_changes_nothing() -> None:
    mask = _torus_mask((0.5, 0.5, 0.5))
    padded = np.pad(mask, ((3, 0), (0, 5), (7, 1)))
    matrix = np.diag([0.5, 0.5, 0.5, 1.0])
    one, other = mask_to_mesh(mask, matrix, SETTINGS).mesh, mask_to_mesh(padded, matrix, SETTINGS).mesh
    assert np.array_equal(one.triangles, other.triangles)
    assert np.allclose(one.points, other.points - [1.5, 0.0, 3.5], atol=1e-12)


def test_specks_cavities_and_tunnels_are_mended_and_counted() -> None:
    mask = np.zeros((40, 40, 40), dtype=np.bool_)
    mask[5:35, 5:35, 5:35] = True
    mask[10, 10, 10] = mask[5:35, 20, 20] = False
    mask[1, 1, 1] = True
    result = mask_to_mesh(mask, np.eye(4), SETTINGS)
    assert result.removed_voxels == 1
    assert 29 <= result.filled_voxels <= 31
    assert (result.pieces, genus(result.mesh)) == (1, 0)


def test_another_structure_in_a_tunnel_is_left_there() -> None:
    mask = np.zeros((24, 24, 24), dtype=np.bool_)
    mask[4:20, 4:20, 4:20] = True
    mask[:, 11:13, 12] = False
    result = mask_to_mesh(mask, np.eye(4), SETTINGS, keep_out=~mask)
    assert result.filled_voxels == 0
    assert genus(result.mesh) == 1


def test_a_thin_sheet_is_smoothed_less_to_keep_its_volume() -> None:
    mask = np.zeros((40, 40, 10), dtype=np.bool_)
    mask[5:35, 5:35, 4:6] = True
    strict = replace(SETTINGS, pass_bands=(0.001, 0.5), volume_tolerance=0.03)
    result = mask_to_mesh(mask, np.eye(4), strict)
    assert result.pass_band == 0.5
    assert abs(result.volume_error) <= 0.03


def test_the_best_pass_band_is_kept_where_none_is_good_enough() -> None:
    mask = np.zeros((40, 40, 10), dtype=np.bool_)
    mask[5:35, 5:35, 4:6] = True
    result = mask_to_mesh(mask, np.eye(4), replace(SETTINGS, pass_bands=(0.5, 0.001), volume_tolerance=1e-6))
    assert result.pass_band == 0.5


def test_a_decimation_that_breaks_the_surface_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(mesh: TriangleMesh, triangles: int) -> TriangleMesh:
        return TriangleMesh(mesh.points, mesh.triangles[:triangles])

    monkeypatch.setattr(mask_surface, "decimate_quadric", broken)
    mask = _torus_mask((0.5, 0.5, 0.5))
    result = mask_to_mesh(mask, np.eye(4), replace(SETTINGS, triangles=1200))
    check_closed(result.mesh, "torus")
    assert genus(result.mesh) == 1
    assert abs(len(result.mesh.triangles) - 1200) <= 2


def test_equal_input_gives_equal_bits() -> None:
    mask = _torus_mask((0.5, 0.5, 0.5))
    first, second = (mask_to_mesh(mask, np.eye(4), SETTINGS).mesh for _ in range(2))
    assert first.points.tobytes() == second.points.tobytes()
    assert first.triangles.tobytes() == second.triangles.tobytes()


def test_a_matrix_that_leads_nowhere_is_refused() -> None:
    with pytest.raises(ValueError, match="finite, invertible"):
        mask_to_mesh(ball(3.0, (1.0, 1.0, 1.0)), np.diag([1.0, 0.0, 1.0, 1.0]), SETTINGS)


def _tasks() -> list[SurfaceTask]:
    masks = [_torus_mask((0.5, 0.5, 0.5)), np.zeros((4, 4, 4), dtype=np.bool_), ball(6.0, (0.5, 0.5, 0.5))]
    return [SurfaceTask(mask, np.diag([0.5, 0.5, 0.5, 1.0]), SETTINGS, np.zeros_like(mask)) for mask in masks]


@pytest.mark.parametrize("jobs", [1, 2])
def test_many_masks_give_their_meshes_or_their_defects_in_their_order(jobs: int) -> None:
    finished: list[int] = []
    torus, defect, sphere = meshes_of(_tasks(), jobs, finished.append)
    assert isinstance(torus, SurfaceResult)
    assert isinstance(sphere, SurfaceResult)
    assert isinstance(defect, ValueError)
    assert "at least one voxel" in str(defect)
    assert (genus(torus.mesh), genus(sphere.mesh)) == (1, 0)
    assert sorted(finished) == [0, 1, 2]
    alone = mask_to_mesh(_torus_mask((0.5, 0.5, 0.5)), np.diag([0.5, 0.5, 0.5, 1.0]), SETTINGS)
    assert torus.mesh.points.tobytes() == alone.mesh.points.tobytes()
    assert torus.mesh.triangles.tobytes() == alone.mesh.triangles.tobytes()
