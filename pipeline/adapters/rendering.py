"""Off-screen pictures of surfaces, with VTK and Mesa's software renderer.

Three traps are dealt with here. VTK kills the process where no renderer is installed: a child process tries first, but
not on behalf of a worker process, whose end is noticed by the one that waits for it. The pixels are those of the frame
before the last change unless the scene is rendered again, so there is one function that takes pictures. And VTK indexes
arrays unchecked, so surfaces are checked before it sees them.
"""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing import parent_process
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.adapters.system_packages import INSTALL_RENDERER
from pipeline.adapters.vtk_surface import VtkError, polydata, vtk_errors_raised
from pipeline.errors import EnvironmentFault
from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.views import View

Float = NDArray[np.float64]
Image = NDArray[np.uint8]

#: EGL needs no display, and gives the same pixels as OSMesa and Xvfb with Mesa's llvmpipe.
RENDER_WINDOW = "vtkEGLRenderWindow"
#: A first frame takes about a second; a renderer that needs this long is broken.
PROBE_SECONDS = 120.0
#: How far the camera stands away; a parallel projection does not depend on it, only what is clipped does.
CAMERA_MM = 2000.0
#: Samples a pixel, which smooth the edges.
SAMPLES = 8

_PROBE = f"import {__name__} as rendering; rendering.draw_one_frame()"


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh in scan space with its colour.

    Attributes
    ----------
    mesh : TriangleMesh
    color : (3,) or (N, 3) uint8
        RGB of the whole mesh, or of each vertex.
    plain : bool
        Whether colours are shown as they are in a scale, with little shading.
    """

    mesh: TriangleMesh
    color: NDArray[np.uint8]
    plain: bool = False


def snapshots(surfaces: Sequence[Surface], views: Sequence[View], size_px: tuple[int, int]) -> list[Image]:
    """Pictures of one scene from several sides, on white.

    Parameters
    ----------
    surfaces : sequence of Surface
    views : sequence of View
    size_px : (width, height)

    Returns
    -------
    list of (height, width, 3) uint8
        RGB, one for each view.

    Raises
    ------
    ValueError
        When a mesh is empty, not finite, or has an index out of range.
    EnvironmentFault
        ``E-ENV-10`` when this machine cannot draw, ``E-ENV-11`` when VTK reports an error.
    """
    for surface in surfaces:
        _check(surface)
    if parent_process() is None:
        require_renderer()
    try:
        with vtk_errors_raised(warnings=False):
            return _drawn(surfaces, views, size_px)
    except VtkError as error:
        raise EnvironmentFault("E-ENV-11", f"Drawing failed: {error}.", "Run again; if it stays, report it.") from error


def _check(surface: Surface) -> None:
    points, triangles = surface.mesh.points, surface.mesh.triangles
    if not len(points) or not len(triangles) or not np.isfinite(points).all():
        raise ValueError("a surface to draw needs finite points and at least one triangle")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise ValueError("a surface to draw has a triangle with a vertex index out of range")


def _drawn(surfaces: Sequence[Surface], views: Sequence[View], size_px: tuple[int, int]) -> list[Image]:
    window, renderer = _window()
    window.SetSize(*size_px)
    for surface in surfaces:
        renderer.AddActor(_actor(surface))
    try:
        return [_snapshot(window, renderer, view) for view in views]
    finally:
        renderer.RemoveAllViewProps()


@functools.cache
def _window() -> tuple[Any, Any]:
    """The one window of this process, with white background, and its renderer: a new one compiles its shaders again."""
    os.environ["VTK_DEFAULT_OPENGL_WINDOW"] = RENDER_WINDOW
    from vtkmodules import vtkRenderingCore, vtkRenderingOpenGL2  # noqa: F401, PLC0415 - the second registers itself

    window, renderer = vtkRenderingCore.vtkRenderWindow(), vtkRenderingCore.vtkRenderer()
    window.SetOffScreenRendering(1)
    window.SetMultiSamples(SAMPLES)
    window.AddRenderer(renderer)
    renderer.SetBackground(1.0, 1.0, 1.0)
    renderer.GetActiveCamera().ParallelProjectionOn()
    renderer.AutomaticLightCreationOff()
    lights = vtkRenderingCore.vtkLightKit()
    lights.AddLightsToRenderer(renderer)
    lights.Update()
    return window, renderer


def _actor(surface: Surface) -> Any:
    from vtkmodules.util.numpy_support import numpy_to_vtk  # noqa: PLC0415
    from vtkmodules.vtkFiltersCore import vtkPolyDataNormals  # noqa: PLC0415
    from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper  # noqa: PLC0415

    data, normals, mapper, actor = polydata(surface.mesh), vtkPolyDataNormals(), vtkPolyDataMapper(), vtkActor()
    colors = np.broadcast_to(surface.color, surface.mesh.points.shape)
    data.GetPointData().SetScalars(numpy_to_vtk(np.ascontiguousarray(colors, dtype=np.uint8), deep=True))
    normals.SetInputData(data)
    normals.SplittingOff()
    normals.ConsistencyOff()
    mapper.SetInputConnection(normals.GetOutputPort())
    actor.SetMapper(mapper)
    look = actor.GetProperty()
    look.SetInterpolationToPhong()
    look.SetAmbient(0.55 if surface.plain else 0.12)
    look.SetDiffuse(0.5 if surface.plain else 0.95)
    # surfaces are closed: what faces away is hidden, and half of the work
    look.BackfaceCullingOn()
    return actor


def _snapshot(window: Any, renderer: Any, view: View) -> Image:
    from vtkmodules.util.numpy_support import vtk_to_numpy  # noqa: PLC0415
    from vtkmodules.vtkCommonCore import vtkUnsignedCharArray  # noqa: PLC0415

    camera, pixels, (width, height) = renderer.GetActiveCamera(), vtkUnsignedCharArray(), window.GetSize()
    camera.SetFocalPoint(*view.focus)
    camera.SetPosition(*(view.focus + CAMERA_MM * view.toward))
    camera.SetViewUp(*view.up)
    camera.SetParallelScale(view.half_height_mm)
    renderer.ResetCameraClippingRange()
    window.Render()
    # 1: the front buffer, where the samples of a pixel have been put together as on a screen
    window.GetPixelData(0, 0, width - 1, height - 1, 1, pixels, 0)
    return np.ascontiguousarray(vtk_to_numpy(pixels).reshape(height, width, 3)[::-1])


def distances_mm(points: Float, mesh: TriangleMesh) -> Float:
    """(N,) signed distance of points (N, 3) to a closed surface, mm; negative inside.

    Raises
    ------
    ValueError
        When the mesh is empty, not finite, or has an index out of range.
    """
    _check(Surface(mesh, np.zeros(3, dtype=np.uint8)))
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy  # noqa: PLC0415
    from vtkmodules.vtkCommonCore import vtkDoubleArray  # noqa: PLC0415
    from vtkmodules.vtkFiltersCore import vtkImplicitPolyDataDistance  # noqa: PLC0415

    if not len(points):
        return np.empty(0)
    surface, measured = vtkImplicitPolyDataDistance(), vtkDoubleArray()
    with vtk_errors_raised(warnings=False):
        surface.SetInput(polydata(mesh))
        surface.FunctionValue(numpy_to_vtk(np.ascontiguousarray(points, dtype=np.float64), deep=True), measured)
    return np.array(vtk_to_numpy(measured))


@functools.cache
def require_renderer() -> None:
    """Draw one frame in a child process, once in the life of this process.

    Raises
    ------
    EnvironmentFault
        ``E-ENV-10`` when the child crashes, fails or hangs.
    """
    how = _probe_failure()
    if how:
        raise EnvironmentFault(
            "E-ENV-10",
            f"This machine cannot draw pictures off-screen: the test of the renderer {how}.",
            f"Install the software renderer: {INSTALL_RENDERER}",
        )


def _probe_failure() -> str:
    root = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join([root, os.environ.get("PYTHONPATH", "")]).rstrip(":")
    environment = os.environ | {"PYTHONPATH": path, "VTK_DEFAULT_OPENGL_WINDOW": RENDER_WINDOW}
    try:
        done = subprocess.run(  # noqa: S603  - our own interpreter with a constant text
            [sys.executable, "-P", "-c", _PROBE],
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=PROBE_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"did not end within {PROBE_SECONDS:.0f} s"
    return f"ended with code {done.returncode}" if done.returncode else ""


def draw_one_frame() -> None:
    """Draw a small frame with as little of VTK as will do; what the child process runs.

    Raises
    ------
    RuntimeError
        When the frame is blank. A missing renderer ends the process.
    """
    from vtkmodules import vtkCommonCore, vtkFiltersSources, vtkRenderingCore, vtkRenderingOpenGL2  # noqa: PLC0415

    source = vtkFiltersSources.vtkSphereSource()
    mapper, actor = vtkRenderingCore.vtkPolyDataMapper(), vtkRenderingCore.vtkActor()
    mapper.SetInputConnection(source.GetOutputPort())
    actor.SetMapper(mapper)
    renderer, window = vtkRenderingCore.vtkRenderer(), vtkRenderingCore.vtkRenderWindow()
    renderer.AddActor(actor)
    window.SetOffScreenRendering(1)
    window.SetSize(32, 32)
    window.AddRenderer(renderer)
    window.Render()
    center = vtkCommonCore.vtkUnsignedCharArray()
    window.GetPixelData(16, 16, 16, 16, 0, center, 0)
    if not any(center.GetTuple(0)):
        raise RuntimeError(f"{vtkRenderingOpenGL2.__name__} drew a blank frame")
