"""Plane cuts through label volumes and meshes, for pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.views import View
from pipeline.geometry.volume import CtVolume, LabelVolume

Float = NDArray[np.float64]


def volume_slice(
    volume: LabelVolume | CtVolume, view: View, size_px: tuple[int, int], outside: int = 0
) -> NDArray[np.generic]:
    """Labels or CT numbers on the plane through a view's focus, as that view shows it.

    Each pixel takes the value of the voxel it lies in; nothing is interpolated.

    Parameters
    ----------
    volume : LabelVolume or CtVolume
    view : View
    size_px : (width, height)
    outside : int
        The value beyond the volume.

    Returns
    -------
    (height, width) array of the volume's type
    """
    width, height = size_px
    scale = 2.0 * view.half_height_mm / height
    across = (np.arange(width) + 0.5 - width / 2.0) * scale
    upwards = (height / 2.0 - np.arange(height) - 0.5) * scale
    points = view.focus + across[None, :, None] * view.right + upwards[:, None, None] * view.up
    index_from_lps = np.linalg.inv(volume.lps_from_index)
    index = np.rint(points @ index_from_lps[:3, :3].T + index_from_lps[:3, 3]).astype(np.int64)
    inside = ((index >= 0) & (index < volume.values.shape)).all(axis=-1)
    i, j, k = np.where(inside[..., None], index, 0).transpose(2, 0, 1)
    return np.where(inside, volume.values[i, j, k], outside).astype(volume.values.dtype)


def plane_section(mesh: TriangleMesh, point: Float, normal: Float) -> Float:
    """Segments (K, 2, 3) in which a mesh meets the plane through ``point`` (3,) with ``normal`` (3,)."""
    height = (mesh.points - point) @ normal
    above = height >= 0.0
    count = above[mesh.triangles].sum(axis=1)
    cut = mesh.triangles[(count == 1) | (count == 2)]
    if not len(cut):
        return np.empty((0, 2, 3))
    # The lone vertex is the one on its own side; both of its edges cross the plane.
    side = above[cut]
    lone = np.argmax(side == (side.sum(axis=1) == 1)[:, None], axis=1)
    row = np.arange(len(cut))
    tip = cut[row, lone]
    return np.stack([_crossing(mesh.points, height, tip, cut[row, (lone + k) % 3]) for k in (1, 2)], axis=1)


def _crossing(points: Float, height: Float, a: NDArray[np.int32], b: NDArray[np.int32]) -> Float:
    share = (height[a] / (height[a] - height[b]))[:, None]
    return np.asarray(points[a] + share * (points[b] - points[a]))
