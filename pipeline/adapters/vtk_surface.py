"""VTK's surface filters on our arrays: iso-surface of a mask, smoothing, decimation.

VTK reads an index out of range as memory, lets NaN through, and reports errors on stderr only. So arrays are checked
before it sees them, and whatever it says becomes an exception. It is imported inside the functions: a run of cached
stages does not pay for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mesh import Float, Int, TriangleMesh, check_arrays, transformed


class VtkError(RuntimeError):
    """VTK reported an error or a warning; its text is the message."""


@contextmanager
def vtk_errors_raised(*, warnings: bool = True) -> Iterator[None]:
    """Within the block what VTK says is collected; at its end, errors (and ``warnings``, if wanted) are raised.

    Raises
    ------
    VtkError
    """
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow  # noqa: PLC0415

    previous, window = vtkOutputWindow.GetInstance(), vtkStringOutputWindow()
    verbosity = vtkLogger.GetCurrentVerbosityCutoff()
    vtkOutputWindow.SetInstance(window)
    # errors go to the log as well as to the window; the exception says it once
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        yield
    finally:
        vtkLogger.SetStderrVerbosity(verbosity)
        vtkOutputWindow.SetInstance(previous)
    said = window.GetOutput().strip()
    if said if warnings else "ERROR:" in said:
        raise VtkError(said)


def label_surface(mask: NDArray[np.bool_], lps_from_index: Float) -> TriangleMesh:
    """The surface half-way between the voxels inside a mask and those outside (flying edges), not smoothed.

    Contoured in index space, where every coordinate is a multiple of one half and exact in single precision.

    Parameters
    ----------
    mask : (I, J, K) bool
        May touch the border of the array: a layer of air is added, so that the surface is closed.
    lps_from_index : (4, 4) float64
        Voxel centres to LPS mm (or to any other frame); may be left-handed.

    Returns
    -------
    TriangleMesh
        Closed, edge- and vertex-manifold, outward; voxels that share only an edge or a corner are parted.

    Raises
    ------
    ValueError
        For a mask that is empty or not 3-D, or a matrix that is not finite and invertible.
    VtkError
    """
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D  # noqa: PLC0415

    if mask.ndim != 3 or not mask.any():
        raise ValueError(f"expected a 3-D mask with at least one voxel, got shape {mask.shape}")
    if not np.isfinite(lps_from_index).all() or np.linalg.det(lps_from_index[:3, :3]) == 0.0:
        raise ValueError("expected a finite, invertible matrix from index to space")
    contour = vtkFlyingEdges3D()
    contour.SetValue(0, 0.5)
    contour.ComputeNormalsOff()
    contour.ComputeGradientsOff()
    contour.ComputeScalarsOff()
    surface = _run(contour, _image(np.pad(mask, 1)))
    return transformed(TriangleMesh(surface.points - 1.0, surface.triangles), lps_from_index)


def smooth_windowed_sinc(mesh: TriangleMesh, iterations: int, pass_band: float) -> TriangleMesh:
    """Low-pass filter of the vertices that keeps volume and connectivity.

    Taubin, Zhang & Golub, "Optimal surface smoothing as filter design" (1996).

    Parameters
    ----------
    mesh : TriangleMesh
    iterations : int
        Degree of the filter's polynomial; more give a sharper cut-off.
    pass_band : float
        0 to 2; smaller is smoother.

    Raises
    ------
    ValueError
        For a mesh that VTK would crash on, or when the filter returned one.
    VtkError
    """
    from vtkmodules.vtkFiltersCore import vtkWindowedSincPolyDataFilter  # noqa: PLC0415

    smoother = vtkWindowedSincPolyDataFilter()
    smoother.SetNumberOfIterations(iterations)
    smoother.SetPassBand(pass_band)
    smoother.BoundarySmoothingOff()
    smoother.FeatureEdgeSmoothingOff()
    smoother.NonManifoldSmoothingOff()
    smoother.NormalizeCoordinatesOff()
    smoothed = _run(smoother, _polydata(mesh))
    if not np.array_equal(smoothed.triangles, mesh.triangles):
        raise VtkError("vtkWindowedSincPolyDataFilter changed the triangles of the mesh")
    return smoothed


def _run(algorithm: Any, data: Any) -> TriangleMesh:
    with vtk_errors_raised():
        algorithm.SetInputData(data)
        algorithm.Update()
    if algorithm.GetErrorCode():
        raise VtkError(f"{algorithm.GetClassName()} failed with error code {algorithm.GetErrorCode()}")
    return _mesh(algorithm.GetOutput())


def _image(mask: NDArray[np.bool_]) -> Any:
    """VTK image of unit spacing at the origin."""
    from vtkmodules.util.numpy_support import numpy_to_vtk  # noqa: PLC0415
    from vtkmodules.vtkCommonDataModel import vtkImageData  # noqa: PLC0415

    image = vtkImageData()
    image.SetDimensions(mask.shape)
    image.GetPointData().SetScalars(numpy_to_vtk(mask.ravel(order="F").astype(np.uint8), deep=True))
    return image


def _polydata(mesh: TriangleMesh) -> Any:
    check_arrays(mesh, "the mesh")
    return polydata(mesh)


def polydata(mesh: TriangleMesh) -> Any:
    """VTK's copy of a mesh, in double precision; unchecked, and VTK reads an index out of range as memory."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray  # noqa: PLC0415
    from vtkmodules.vtkCommonCore import vtkPoints  # noqa: PLC0415
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData  # noqa: PLC0415

    points, cells, data = vtkPoints(), vtkCellArray(), vtkPolyData()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(mesh.points), deep=True))
    offsets = np.arange(0, mesh.triangles.size + 1, 3, dtype=np.int64)
    corners = mesh.triangles.ravel().astype(np.int64)
    cells.SetData(numpy_to_vtkIdTypeArray(offsets, deep=True), numpy_to_vtkIdTypeArray(corners, deep=True))
    data.SetPoints(points)
    data.SetPolys(cells)
    return data


def _mesh(data: Any) -> TriangleMesh:
    """Our copy of VTK's surface."""
    from vtkmodules.util.numpy_support import vtk_to_numpy  # noqa: PLC0415

    if data.GetNumberOfPolys() == 0:
        raise VtkError("the filter returned no triangles")
    points: Float = vtk_to_numpy(data.GetPoints().GetData()).astype(np.float64)
    corners: Int = vtk_to_numpy(data.GetPolys().GetConnectivityArray()).astype(np.int32)
    if len(corners) != 3 * data.GetNumberOfPolys():
        raise VtkError("the filter returned polygons that are not triangles")
    return TriangleMesh(points, corners.reshape(-1, 3))
