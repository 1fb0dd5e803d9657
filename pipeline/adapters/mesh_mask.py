"""From a closed mesh to the voxels whose centres lie inside it: :mod:`pipeline.adapters.mask_surface` backwards."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.adapters.vtk_surface import polydata, vtk_errors_raised
from pipeline.geometry.mesh import TriangleMesh, check_arrays, transformed

Float = NDArray[np.float64]


def mesh_to_mask(mesh: TriangleMesh, shape: tuple[int, int, int], lps_from_index: Float) -> NDArray[np.bool_]:
    """Which voxels of a grid lie inside a closed surface.

    Parameters
    ----------
    mesh : TriangleMesh
        Closed, in the frame that ``lps_from_index`` leads to.
    shape : (I, J, K)
    lps_from_index : (4, 4) float64
        Voxel centres to the mesh's frame.

    Returns
    -------
    (I, J, K) bool

    Raises
    ------
    ValueError
        For a mesh that VTK would crash on.
    VtkError
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy  # noqa: PLC0415
    from vtkmodules.vtkImagingStencil import (  # noqa: PLC0415
        vtkImageStencilToImage,
        vtkPolyDataToImageStencil,
    )

    check_arrays(mesh, "the mesh")
    index_from_lps: Float = np.linalg.inv(lps_from_index).astype(np.float64)
    stencil, image = vtkPolyDataToImageStencil(), vtkImageStencilToImage()
    with vtk_errors_raised():
        stencil.SetInputData(polydata(transformed(mesh, index_from_lps)))
        stencil.SetOutputSpacing(1.0, 1.0, 1.0)
        stencil.SetOutputOrigin(0.0, 0.0, 0.0)
        stencil.SetOutputWholeExtent(*(bound for size in shape for bound in (0, size - 1)))
        image.SetInputConnection(stencil.GetOutputPort())
        image.SetInsideValue(1)
        image.SetOutsideValue(0)
        image.Update()
    inside = vtk_to_numpy(image.GetOutput().GetPointData().GetScalars())
    return np.asarray(inside.reshape(shape, order="F").astype(bool))
