"""What the kernels see of two bodies: plain arrays in named tuples, in the attitude frame (z is delta)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.kinematics.ligaments import Fibres

Float = NDArray[np.float64]
Int = NDArray[np.int32]
Bits = NDArray[np.uint8]
Flags = NDArray[np.bool_]

#: Height of "nothing here", and what is certainly none (mm).
NOTHING_MM = 1e9
FAR_MM = 1e8
#: What is steeper than this is a wall: its lower edge, which a face below it shares, is met instead.
STEEPEST = 1e6
#: Barycentric share by which a point may lie outside a triangle: points above shared edges belong to both.
SHARED = 1e-9


#: So many cells around a cell count for its peak: a triangle that reaches no farther is ruled out by one look.
PEAK_CELLS = 2


class HeightMap(NamedTuple):
    """Lowest height of the reference along delta at the nodes of a square grid; ``NOTHING_MM`` where there is none.

    Attributes
    ----------
    z : (NY, NX) float64
        Node (j, i) lies at (x0 + i * spacing, y0 + j * spacing), mm.
    x0, y0, spacing : float
    """

    z: Float
    x0: float
    y0: float
    spacing: float


class Surface(NamedTuple):
    """Triangles of one body that may be met.

    Attributes
    ----------
    points : (N, 3) float64
        mm.
    triangles : (M, 3) int32
        Counter-clockwise from outside.
    owned : (M,) uint8
        Which corners (bits 0..2) and edges from corner k to corner k + 1 (bits 3..5) count as this triangle's, so that
        each counts once.
    """

    points: Float
    triangles: Int
    owned: Bits


class Body(NamedTuple):
    """A whole body, its triangles in an order in which neighbours stand together.

    Attributes
    ----------
    points : (N, 3) float64
        mm.
    triangles : (M, 3) int32
        Counter-clockwise from outside.
    edges : (M, 3) int32
        Number of the edge from corner k to corner k + 1; shared by the triangles on both sides.
    edge_count : int
    blocks : (B + 1,) int32
        Block ``b`` is ``triangles[blocks[b]:blocks[b + 1]]``.
    spheres : (B, 4) float64
        A centre and a radius (mm) that hold the triangles of each block.
    """

    points: Float
    triangles: Int
    edges: Int
    edge_count: int
    blocks: Int
    spheres: Float


class Bins(NamedTuple):
    """Triangles of the moving body that face along delta, by the square cells of (x, y) that their boxes touch.

    Attributes
    ----------
    x0, y0, size : float
        Cell (j, i) begins at (x0 + i * size, y0 + j * size), mm.
    start : (NY * NX + 1,) int32
        Cell ``c = j * NX + i`` holds ``items[start[c]:start[c + 1]]``.
    items : (K,) int32
        Which of the facing triangles.
    spans : (K, 5) float64
        Least x and y, greatest x, y and z of each item.
    triangles : (F,) int32
        Index of each facing triangle in the body.
    facing : (F, 9) float64
        Least x, y, z, greatest x, y, z of each, then height at (0, 0) and slopes in x and y of its plane.
    cover : (NY, NX, 4) float64
        A plane that no triangle exceeds within the cell: height at (0, 0), slopes in x and y; then the greatest z of
        its triangles. Heights are ``-NOTHING_MM`` where there are none.
    highest : float
        Greatest z of all.
    """

    x0: float
    y0: float
    size: float
    start: Int
    items: Int
    spans: Float
    triangles: Int
    facing: Float
    cover: Float
    highest: float


class Rows(NamedTuple):
    """What is known of each sample or feature at a pose.

    Attributes
    ----------
    gaps : (K,) float64
        Clearance along z, mm; ``NOTHING_MM`` where the other body is not above.
    rates : (K, 3) float64
        Its change per mm of x, of y and per rad of theta.
    arms : (K, 2) float64
        Place in (x, y) from the moving origin, mm.
    """

    gaps: Float
    rates: Float
    arms: Float


class Attitude(NamedTuple):
    """Everything that kernels need at one attitude.

    Attributes
    ----------
    reference : Surface
        Points in the attitude frame; only triangles that face against delta.
    spots : (M, 4) float64
        Of each of these triangles: x and y of a point, how far from it the triangle reaches in (x, y), its least z.
    moving : Surface
        Points in the moving frame (z is delta).
    bins : Bins
        Of the moving body.
    samples : (S, 3) float64
        Points on top of the moving body, moving frame.
    sample_cells : (S,) int32
        The cell of the bins that each sample lies in.
    heights : HeightMap
        Of the reference.
    ceiling_mm : float
        What lies higher is left out of reference and map.
    fibres : Fibres
    """

    reference: Surface
    spots: Float
    moving: Surface
    bins: Bins
    samples: Float
    sample_cells: Int
    heights: HeightMap
    ceiling_mm: float
    fibres: Fibres
