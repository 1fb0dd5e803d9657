"""Two meshes made ready for the direct solver: numbered edges, cells, samples; once for a pair of bodies."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.direct.enclosure import Hull, hull
from pipeline.kinematics.direct.height_map import facing_below, rasterise
from pipeline.kinematics.direct.settings import MapSettings
from pipeline.kinematics.direct.surfaces import (
    FAR_MM,
    NOTHING_MM,
    STEEPEST,
    Attitude,
    Bins,
    Bits,
    Body,
    Float,
    HeightMap,
    Int,
    Surface,
)
from pipeline.kinematics.joint_coordinates import attitude_rotation
from pipeline.kinematics.ligaments import NO_FIBRES, Fibres

Index = NDArray[np.int64]

#: Side of the cells that sort the triangles of the moving body, mm: about the length of their edges.
CELL_MM = 1.0
#: Bits of each coordinate in the order by which points and triangles are kept next to their neighbours.
Z_ORDER_BITS = 10
#: So many neighbouring triangles are looked at together.
BLOCK_TRIANGLES = 16
#: A body is sampled at least so often across its narrower side, if it is as wide as this (mm).
SAMPLES_ACROSS, LEAST_WIDTH_MM = 64, 5.0
#: Slopes beyond this do not tilt the cover of a cell: a wall is not the lie of the land.
STEEPEST_COVER = 2.0
#: Below the top of the moving body by more than this, nothing of it is looked at, mm.
SAMPLED_DEPTH_MM = 40.0


@dataclass(frozen=True, eq=False)
class DirectBodies:
    """A pair of bodies as kernels see them, in their kinematic frames.

    Attributes
    ----------
    reference, moving : Surface
    bins : Bins
    samples : (S, 3) float64
    sample_cells : (S,) int32
    reach_mm : float
        How far the samples lie from the moving origin, in (x, y).
    hulls : (Hull, Hull)
        Of reference and moving body.
    settings : MapSettings
    """

    reference: Body
    moving: Surface
    bins: Bins
    samples: Float
    sample_cells: Int
    reach_mm: float
    hulls: tuple[Hull, Hull]
    settings: MapSettings

    def at(self, angles_rad: tuple[float, float], about: Pose, fibres: Fibres = NO_FIBRES) -> Attitude:
        """The pair at flexion and varus, ready for a search about a pose.

        Parameters
        ----------
        angles_rad : (flexion, varus)
        about : Pose
            Middle of the window; its z tells what is too high to be met, infinite for nothing.
        fibres : Fibres
            Attachments on the reference in its own frame.
        """
        ceiling = about.z + self.bins.highest + self.settings.headroom_mm
        turned, span = self._turned(angles_rad, ceiling, fibres)
        middle, half = np.array([about.x, about.y]), self.reach_mm + self.settings.window_mm
        low, high = np.maximum(span[:2], middle - half), np.minimum(span[2:], middle + half)
        if np.any(high <= low):
            return turned
        heights = _empty_map(low, high, self.settings.spacing_mm)
        rasterise(turned.reference.points, turned.reference.triangles, heights)
        return turned._replace(heights=heights)

    def turned(
        self, angles_rad: tuple[float, float], ceiling_mm: float = np.inf, fibres: Fibres = NO_FIBRES
    ) -> Attitude:
        """The pair at flexion and varus without a height map: enough for exact depths and contacts below a ceiling."""
        return self._turned(angles_rad, ceiling_mm, fibres)[0]

    def _turned(self, angles_rad: tuple[float, float], ceiling_mm: float, fibres: Fibres) -> tuple[Attitude, Float]:
        """The pair without a map, and least x, y and greatest x, y of what faces the moving body."""
        rotation, span = attitude_rotation(*angles_rad), np.empty(4)
        spheres = self.reference.spheres.copy()
        spheres[:, :3] = spheres[:, :3] @ rotation
        body = self.reference._replace(points=self.reference.points @ rotation, spheres=spheres)
        reference, spots = facing_below(body, ceiling_mm, span)
        attached = fibres._replace(on_reference=fibres.on_reference @ rotation)
        pair = Attitude(
            reference, spots, self.moving, self.bins, self.samples, self.sample_cells, NO_MAP, ceiling_mm, attached
        )
        return pair, span


NO_MAP = HeightMap(np.full((1, 1), NOTHING_MM), 0.0, 0.0, 1.0)


def prepare(reference: TriangleMesh, moving: TriangleMesh, settings: MapSettings | None = None) -> DirectBodies:
    """Make two meshes, each in its kinematic frame, ready for the direct solver.

    Raises
    ------
    ValueError
        When no triangle of the moving body faces along delta.
    """
    fixed, body = _body(reference), _body(moving)
    bins, chosen = _bins(body), settings or MapSettings()
    moved = Surface(body.points, body.triangles, _owned(body, np.sort(bins.triangles)))
    narrowest = float((bins.facing[:, 3:5].max(axis=0) - bins.facing[:, :2].min(axis=0)).min())
    chosen = replace(chosen, spacing_mm=min(chosen.spacing_mm, max(narrowest, LEAST_WIDTH_MM) / SAMPLES_ACROSS))
    samples = _samples(moved, chosen.spacing_mm)
    reach_mm = float(np.hypot(samples[:, 0], samples[:, 1]).max(initial=0.0))
    hulls = hull(reference), hull(moving)
    return DirectBodies(fixed, moved, bins, samples, _cells_of(bins, samples), reach_mm, hulls, chosen)


def _body(mesh: TriangleMesh) -> Body:
    """The mesh with neighbours next to one another in memory, its edges numbered."""
    points = np.ascontiguousarray(mesh.points, dtype=np.float64)
    order = np.argsort(_z_order(points), kind="stable")
    rank = np.empty(len(order), dtype=np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    triangles = rank[mesh.triangles]
    middle = points[mesh.triangles].mean(axis=1)
    triangles = np.ascontiguousarray(triangles[np.argsort(_z_order(middle), kind="stable")])
    ends = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    keys = ends[:, 0].astype(np.int64) * len(points) + ends[:, 1]
    distinct, number = np.unique(keys, return_inverse=True)
    blocks = np.append(np.arange(0, len(triangles), BLOCK_TRIANGLES), len(triangles)).astype(np.int32)
    spheres = _spheres(points[order][triangles], blocks)
    return Body(points[order], triangles, number.reshape(-1, 3).astype(np.int32), len(distinct), blocks, spheres)


def _owned(body: Body, facing: Index) -> Bits:
    """Corners and edges of the facing triangles, each owned by the first that has it; see :class:`Surface`."""
    owned = np.zeros(len(body.triangles), np.uint8)
    for numbers, first_bit in ((body.triangles, 0), (body.edges, 3)):
        _, place = np.unique(numbers[facing], return_index=True)
        np.bitwise_or.at(owned, facing[place // 3], (1 << (place % 3 + first_bit)).astype(np.uint8))
    return owned


def _z_order(points: Float) -> NDArray[np.uint64]:
    """(N,) place of each point on a Z-order curve (Morton 1966): neighbours in space are mostly neighbours on it."""
    low, high = points.min(axis=0), points.max(axis=0)
    share = (points - low) / max(float((high - low).max()), np.finfo(np.float64).tiny)
    cell = (share * (2**Z_ORDER_BITS - 1)).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(Z_ORDER_BITS):
        for axis in range(3):
            code |= (cell[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code


def _spheres(corners: Float, blocks: Int) -> Float:
    """(B, 4) centre and radius about the (M, 3, 3) corners of each block."""
    low = np.minimum.reduceat(corners.min(axis=1), blocks[:-1])
    high = np.maximum.reduceat(corners.max(axis=1), blocks[:-1])
    centre = 0.5 * (low + high)
    away = np.linalg.norm(corners - np.repeat(centre, np.diff(blocks), axis=0)[:, None], axis=2).max(axis=1)
    return np.column_stack([centre, np.maximum.reduceat(away, blocks[:-1])])


def _bins(moving: Body) -> Bins:
    """The triangles that face along delta, sorted into cells."""
    index, facing = _facing(moving)
    low = facing[:, :2].min(axis=0)
    first, last = (np.floor((facing[:, k : k + 2] - low) / CELL_MM).astype(np.int64) for k in (0, 3))
    order = np.lexsort((first[:, 0], first[:, 1]))
    index, facing, first, last = index[order], facing[order], first[order], last[order]
    columns, rows = (int(n) + 1 for n in last.max(axis=0))
    items, cells = _touched(first, last)
    by_cell = np.argsort(cells[:, 1] * columns + cells[:, 0], kind="stable")
    items, cells = items[by_cell], cells[by_cell]
    flat = cells[:, 1] * columns + cells[:, 0]
    start = np.searchsorted(flat, np.arange(rows * columns + 1)).astype(np.int32)
    cover = _cover(facing[items], low + cells * CELL_MM, flat, rows * columns)
    return Bins(
        x0=float(low[0]),
        y0=float(low[1]),
        size=CELL_MM,
        start=start,
        items=items.astype(np.int32),
        spans=np.ascontiguousarray(facing[items][:, [0, 1, 3, 4, 5]]),
        triangles=index.astype(np.int32),
        facing=np.ascontiguousarray(facing),
        cover=cover.reshape(rows, columns, 4),
        highest=float(facing[:, 5].max()),
    )


def _facing(body: Body) -> tuple[Index, Float]:
    """Which triangles face along z; box (6), then height at (0, 0) and slopes of the plane of each."""
    corners = body.points[body.triangles]
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(u, v)
    index = np.flatnonzero(normal[:, 2] * STEEPEST > np.hypot(normal[:, 0], normal[:, 1]))
    if not len(index):
        raise ValueError("no triangle of the moving body faces along delta")
    corners, normal = corners[index], normal[index]
    slopes = -normal[:, :2] / normal[:, 2:]
    height = corners[:, 0, 2] - np.einsum("ij,ij->i", slopes, corners[:, 0, :2])
    return index, np.column_stack([corners.min(axis=1), corners.max(axis=1), height, slopes])


def _touched(first: Index, last: Index) -> tuple[Index, Index]:
    """Every (item, cell) such that the item's range of cells contains the cell: (K,) items, (K, 2) cells."""
    size = last - first + 1
    count = size[:, 0] * size[:, 1]
    items = np.repeat(np.arange(len(first)), count)
    place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    across = size[items, 0]
    return items, first[items] + np.column_stack([place % across, place // across])


def _cover(facing: Float, corner: Float, cell: Index, cells: int) -> Float:
    """(cells, 4) plane above every triangle within its cell, and the greatest z; see :class:`Bins`."""
    area = (facing[:, 3] - facing[:, 0]) * (facing[:, 4] - facing[:, 1])
    weight = np.maximum(np.bincount(cell, area, cells), 1e-12)
    cover = np.zeros((cells, 4))
    cover[:, [0, 3]] = -NOTHING_MM
    for k in (1, 2):
        lie = np.clip(facing[:, 6 + k], -STEEPEST_COVER, STEEPEST_COVER)
        cover[:, k] = np.bincount(cell, lie * area, cells) / weight
    low, high = np.maximum(corner, facing[:, :2]), np.minimum(corner + CELL_MM, facing[:, 3:5])
    tilt = facing[:, 7:9] - cover[cell, 1:3]
    np.maximum.at(cover[:, 0], cell, facing[:, 6] + np.maximum(tilt * low, tilt * high).sum(axis=1))
    np.maximum.at(cover[:, 3], cell, facing[:, 5])
    return cover


def _cells_of(bins: Bins, samples: Float) -> Int:
    """The cell of each sample."""
    rows, columns = bins.cover.shape[:2]
    place = np.floor((samples[:, :2] - [bins.x0, bins.y0]) / bins.size).astype(np.int32)
    column, row = np.clip(place, 0, [columns - 1, rows - 1]).T
    return np.ascontiguousarray(row * columns + column, dtype=np.int32)


def _samples(moving: Surface, spacing_mm: float) -> Float:
    """(S, 3) points on top of the moving body above the nodes of a square grid."""
    upside_down = moving.points * [1.0, 1.0, -1.0]
    top = _empty_map(upside_down[:, :2].min(axis=0), upside_down[:, :2].max(axis=0), spacing_mm)
    rasterise(upside_down, np.ascontiguousarray(moving.triangles[:, ::-1]), top)
    row, column = np.nonzero(top.z < FAR_MM)
    z = -top.z[row, column]
    points = np.column_stack([top.x0 + column * spacing_mm, top.y0 + row * spacing_mm, z])
    return np.ascontiguousarray(points[z > z.max(initial=-NOTHING_MM) - SAMPLED_DEPTH_MM])


def _empty_map(low: Float, high: Float, spacing_mm: float) -> HeightMap:
    first = np.floor(low / spacing_mm) - 1.0  # nodes at multiples of the spacing: a mirror image has mirrored nodes
    columns, rows = (int(n) for n in np.ceil(high / spacing_mm) + 2.0 - first)
    x0, y0 = first * spacing_mm
    return HeightMap(np.full((rows, columns), NOTHING_MM), float(x0), float(y0), spacing_mm)
