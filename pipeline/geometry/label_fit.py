"""Whether a label of bone lies on bone in a CT: density just inside its edge against density just outside.

Where it does not, how the label map would have to be moved or mirrored to do so: what exports do to a header.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.volume import CtVolume, LabelVolume, box_of

Float = NDArray[np.float64]

#: Layers of voxels on either side of the edge that are compared; the one at the edge itself is a mixture.
INNER, OUTER = 2, 3
#: Places of each layer that tell how far labels lie off, and the steps in which that is looked for (mm).
MOST_PLACES = 6000
STEPS_MM = (2.0, 1.0, 0.5, 0.25, 0.125)
#: A shift is worth looking for up to here (mm).
FARTHEST_MM = 12.0
#: CT numbers beyond these tell nothing more about an edge: air outside, dense bone or metal inside.
TELLING_HU = (-150.0, 900.0)


class BoneFit(NamedTuple):
    """One label against a CT.

    Attributes
    ----------
    inside_hu, outside_hu : float
        Median CT number of the layer inside the edge, and of soft tissue around it; NaN outside the CT.
    covered : float
        Share of the compared voxels that lie in the CT.
    """

    inside_hu: float
    outside_hu: float
    covered: float


class Edge(NamedTuple):
    """Voxel centres (N, 3) in LPS mm on both sides of the edge of a label: thick layers, and those next to it."""

    inside: Float
    outside: Float
    just_inside: Float
    just_outside: Float


def edge_of(labels: LabelVolume, value: int) -> Edge:
    """Both sides of the edge of one label; what borders on another label is left out.

    Raises
    ------
    ValueError
        When the label is empty.
    """
    from scipy import ndimage  # noqa: PLC0415 - half a second that a run of cached stages need not pay

    every = np.asarray(labels.values)
    box = tuple(slice(max(edge.start - OUTER - 1, 0), edge.stop + OUTER + 1) for edge in box_of(every == value))
    part = every[box]
    mask, free = part == value, part == 0
    core, wider = ndimage.binary_erosion(mask, border_value=1), ndimage.binary_dilation(mask)
    within = mask & ~ndimage.binary_erosion(core, iterations=INNER - 1, border_value=1)
    around = ndimage.binary_dilation(wider, iterations=OUTER - 1) & ~wider & free
    begin = np.array([edge.start for edge in box])
    layers = (within, around, mask & ~core, wider & ~mask & free)
    return Edge(*(_placed(labels.lps_from_index, np.argwhere(layer) + begin) for layer in layers))


def bone_fit(ct: CtVolume, edge: Edge, moved: Float | None = None) -> BoneFit:
    """Density on both sides of an edge, after the label was moved by a (4, 4) matrix in LPS mm."""
    inside, outside = (_nearest(ct, points if moved is None else _placed(moved, points)) for points in edge[:2])
    known = np.concatenate([inside, outside])
    return BoneFit(_median(inside), _median(outside), float(np.isfinite(known).mean()))


def displacement_mm(ct: CtVolume, edges: tuple[Edge, ...]) -> Float:
    """(3,) how far labels lie off the bones of a CT, LPS mm: the shift back that makes their edges sharpest.

    Parameters
    ----------
    ct : CtVolume
    edges : tuple of Edge
        Of labels that are off by the same.
    """
    layers = [_sparse(np.concatenate([edge[side] for edge in edges])) for side in (2, 3)]

    def blur(shift: Float) -> float:
        inside, outside = (np.clip(_between(ct, points + shift), *TELLING_HU).mean() for points in layers)
        return float(outside - inside)

    best, shift = blur(np.zeros(3)), np.zeros(3)
    for step in STEPS_MM:
        better = True
        while better and np.linalg.norm(shift) < FARTHEST_MM:
            trials = [shift + sign * step * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
            values = [blur(trial) for trial in trials]
            better = min(values) < best
            if better:
                best, shift = min(values), trials[int(np.argmin(values))]
    return -shift


def header_mistakes(ct: CtVolume) -> Iterator[tuple[str, Float]]:
    """What exports do to a label map, and the (4, 4) LPS matrix that undoes it."""
    middle = ct.lps_from_index @ [*(0.5 * (np.array(ct.values.shape) - 1.0)), 1.0]
    axes = ct.lps_from_index[:3, :3] / ct.spacing_mm
    for words, signs in (
        ("mirrored left to right", (-1.0, 1.0, 1.0)),
        ("mirrored front to back", (1.0, -1.0, 1.0)),
        ("mirrored head to feet", (1.0, 1.0, -1.0)),
        ("turned about the long axis of the body", (-1.0, -1.0, 1.0)),
        ("turned head to feet and left to right", (-1.0, 1.0, -1.0)),
        ("turned head to feet and front to back", (1.0, -1.0, -1.0)),
    ):
        turn = axes @ np.diag(signs) @ axes.T
        yield words, _about(turn, middle[:3])
    yield "read as RAS instead of LPS", np.diag([-1.0, -1.0, 1.0, 1.0])


def _about(turn: Float, centre: Float) -> Float:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, centre - turn @ centre
    return matrix


def _placed(matrix: NDArray[Any], points: NDArray[Any]) -> Float:
    return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3], dtype=np.float64)


def _nearest(ct: CtVolume, points: Float) -> Float:
    """(N,) CT number of the voxel nearest to each place; NaN outside."""
    at = np.rint(_placed(np.linalg.inv(ct.lps_from_index), points)).astype(int)
    inside = ((at >= 0) & (at < ct.values.shape)).all(axis=1)
    out = np.full(len(at), np.nan)
    out[inside] = ct.values[tuple(at[inside].T)]
    return out


def _between(ct: CtVolume, points: Float) -> Float:
    """(N,) CT number between voxels; that of the border outside."""
    from scipy import ndimage  # noqa: PLC0415 - as above

    at = _placed(np.linalg.inv(ct.lps_from_index), points)
    return np.asarray(ndimage.map_coordinates(ct.values, at.T, np.float64, order=1, mode="nearest"))


def _sparse(points: Float) -> Float:
    return points[:: max(1, len(points) // MOST_PLACES)]


def _median(values: Float) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")
