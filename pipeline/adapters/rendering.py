"""Off-screen pictures of surfaces, with PyVista on VTK and Mesa's software renderer.

Three traps are dealt with here. VTK kills the process where no renderer is installed, so a child process tries first.
A screenshot returns the frame before the last change unless the scene is rendered again, so there is one function
that takes pictures. And VTK indexes arrays unchecked, so surfaces are checked before it sees them.
"""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    require_renderer()
    import pyvista  # noqa: PLC0415  - half a second and 600 MB that a cached run must not pay for

    plotter = pyvista.Plotter(off_screen=True, window_size=list(size_px), lighting="light kit")
    try:
        with pyvista.VtkErrorCatcher(raise_errors=True):
            _fill(plotter, surfaces)
            return [_snapshot(plotter, view) for view in views]
    except RuntimeError as error:
        raise EnvironmentFault("E-ENV-11", f"Drawing failed: {error}.", "Run again; if it stays, report it.") from error
    finally:
        plotter.close()


def _check(surface: Surface) -> None:
    points, triangles = surface.mesh.points, surface.mesh.triangles
    if not len(points) or not len(triangles) or not np.isfinite(points).all():
        raise ValueError("a surface to draw needs finite points and at least one triangle")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise ValueError("a surface to draw has a triangle with a vertex index out of range")


def _fill(plotter: Any, surfaces: Sequence[Surface]) -> None:
    plotter.set_background("white")
    plotter.enable_anti_aliasing("msaa")
    plotter.enable_parallel_projection()
    for surface in surfaces:
        _add(plotter, surface)


def _add(plotter: Any, surface: Surface) -> None:
    import pyvista  # noqa: PLC0415

    faces = np.insert(surface.mesh.triangles.astype(np.int64), 0, 3, axis=1)
    poly = pyvista.PolyData(surface.mesh.points, faces.ravel())
    colors = np.broadcast_to(surface.color, surface.mesh.points.shape).astype(np.uint8)
    light = {"ambient": 0.55, "diffuse": 0.5} if surface.plain else {"ambient": 0.12, "diffuse": 0.95}
    plotter.add_mesh(poly, scalars=colors, rgb=True, smooth_shading=True, render=False, **light)


def _snapshot(plotter: Any, view: View) -> Image:
    camera = plotter.camera
    camera.focal_point = tuple(view.focus)
    camera.position = tuple(view.focus + CAMERA_MM * view.toward)
    camera.up = tuple(view.up)
    camera.parallel_scale = view.half_height_mm
    plotter.reset_camera_clipping_range()
    # Without this the screenshot is the frame before the camera moved.
    plotter.render()
    return np.ascontiguousarray(plotter.screenshot(return_img=True), dtype=np.uint8)[..., :3]


def distances_mm(points: Float, mesh: TriangleMesh) -> Float:
    """(N,) signed distance of points (N, 3) to a closed surface, mm; negative inside.

    Raises
    ------
    ValueError
        When the mesh is empty, not finite, or has an index out of range.
    """
    _check(Surface(mesh, np.zeros(3, dtype=np.uint8)))
    import pyvista  # noqa: PLC0415

    if not len(points):
        return np.empty(0)
    faces = np.insert(mesh.triangles.astype(np.int64), 0, 3, axis=1)
    surface = pyvista.PolyData(mesh.points, faces.ravel())
    cloud = pyvista.PolyData(np.asarray(points, dtype=np.float64))
    with pyvista.VtkErrorCatcher(raise_errors=True):
        measured = cloud.compute_implicit_distance(surface)
    return np.asarray(measured["implicit_distance"], dtype=np.float64)


@functools.cache
def require_renderer() -> None:
    """Draw one frame in a child process, once in the life of this process.

    Raises
    ------
    EnvironmentFault
        ``E-ENV-10`` when the child crashes, fails or hangs.
    """
    os.environ["VTK_DEFAULT_OPENGL_WINDOW"] = RENDER_WINDOW
    how = _probe_failure()
    if how:
        raise EnvironmentFault(
            "E-ENV-10",
            f"This machine cannot draw pictures off-screen: the test of the renderer {how}.",
            "Install the software renderer: apt-get install -y --no-install-recommends libegl1 libgl1-mesa-dri",
        )


def _probe_failure() -> str:
    root = str(Path(__file__).resolve().parents[2])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")]).rstrip(":")}
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
