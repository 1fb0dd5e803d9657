"""VTK's filters behind our border: correct, closed, loud."""

from __future__ import annotations

import numpy as np
import pytest
from vtkmodules.vtkCommonCore import vtkOutputWindow
from vtkmodules.vtkFiltersCore import vtkQuadricDecimation

from pipeline.adapters.vtk_surface import (
    VtkError,
    label_surface,
    smooth_windowed_sinc,
    vtk_errors_raised,
)
from pipeline.geometry.mesh import TriangleMesh, check_closed, components, volume_mm3
from tests.geometry.meshes import ball, centred, octahedron

UNIT = np.eye(4)


def test_a_cube_that_fills_the_array_is_closed() -> None:
    mesh = label_surface(np.ones((6, 6, 6), dtype=np.bool_), np.diag([2.0, 3.0, 4.0, 1.0]))
    check_closed(mesh, "cube")
    assert np.allclose(mesh.points.min(axis=0), [-1.0, -1.5, -2.0])
    assert np.allclose(mesh.points.max(axis=0), [11.0, 16.5, 22.0])


@pytest.mark.parametrize("density", [0.05, 0.3, 0.5, 0.7, 0.95])
def test_any_mask_gives_a_manifold_surface(density: float) -> None:
    mask = np.random.default_rng(1).random((16, 16, 16)) < density
    mesh = label_surface(mask, UNIT)
    outer = [piece for piece in components(mesh) if volume_mm3(piece) > 0.0]
    assert outer
    for piece in outer:
        check_closed(piece, "piece")


@pytest.mark.parametrize("second", [(1, 1, 0), (1, 1, 1)])
def test_voxels_that_share_no_face_are_parted(second: tuple[int, int, int]) -> None:
    mask = np.zeros((4, 4, 4), dtype=np.bool_)
    mask[1, 1, 1] = mask[tuple(np.add(1, second))] = True
    mesh = label_surface(mask, UNIT)
    check_closed(mesh, "diagonal")
    assert len(components(mesh)) == 2


@pytest.mark.parametrize("flip", [(1, 1, 1), (-1, 1, 1), (1, -1, 1), (-1, -1, -1)])
def test_normals_are_outward_for_every_handedness(flip: tuple[int, int, int]) -> None:
    mesh = label_surface(ball(5.0, (1.0, 1.0, 1.0)), np.diag([*flip, 1.0]).astype(np.float64))
    check_closed(mesh, "ball")


def test_smoothing_keeps_volume_and_connectivity() -> None:
    mask = ball(10.0, (0.5, 0.5, 0.5))
    rough = label_surface(mask, centred(mask.shape, (0.5, 0.5, 0.5)))
    smooth = smooth_windowed_sinc(rough, 50, 0.01)
    assert np.array_equal(smooth.triangles, rough.triangles)
    assert volume_mm3(smooth) == pytest.approx(volume_mm3(rough), rel=2e-3)
    errors = [np.linalg.norm(mesh.points, axis=1).std() for mesh in (rough, smooth)]
    assert errors[1] < 0.3 * errors[0]


def _octahedron_with(points: float | None = None, corner: int | None = None) -> TriangleMesh:
    mesh = octahedron()
    changed, triangles = mesh.points.copy(), mesh.triangles.copy()
    if points is not None:
        changed[0, 0] = points
    if corner is not None:
        triangles[0, 0] = corner
    return TriangleMesh(changed, triangles)


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (_octahedron_with(points=np.nan), "not finite"),
        (_octahedron_with(points=np.inf), "not finite"),
        (_octahedron_with(corner=1_000_000), "outside"),
        (TriangleMesh(octahedron().points, np.zeros((0, 3), dtype=np.int32)), "no triangles"),
    ],
)
def test_what_would_crash_vtk_never_reaches_it(mesh: TriangleMesh, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        smooth_windowed_sinc(mesh, 10, 0.1)


@pytest.mark.parametrize("shape", [(3, 3), (3, 3, 3)])
def test_an_empty_mask_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="at least one voxel"):
        label_surface(np.zeros(shape, dtype=np.bool_), UNIT)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_matrix_that_leads_nowhere_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match="finite, invertible"):
        label_surface(np.ones((2, 2, 2), dtype=np.bool_), np.diag([1.0, value, 1.0, 1.0]))


def test_vtk_errors_become_exceptions(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(VtkError, match="not optional"), vtk_errors_raised():
        vtkQuadricDecimation().Update()
    assert capfd.readouterr().err == ""


def test_warnings_are_raised_only_where_they_are_wanted() -> None:
    def warn() -> None:
        vtkOutputWindow.GetInstance().DisplayWarningText("Warning: In a.cxx, line 1: slow")

    with pytest.raises(VtkError, match="slow"), vtk_errors_raised():
        warn()
    with vtk_errors_raised(warnings=False):
        warn()
    with pytest.raises(VtkError, match="not optional"), vtk_errors_raised(warnings=False):
        vtkQuadricDecimation().Update()


def test_vtk_reports_where_it_did_before_after_the_block() -> None:
    before = vtkOutputWindow.GetInstance()
    with vtk_errors_raised():
        pass
    assert vtkOutputWindow.GetInstance() is before
