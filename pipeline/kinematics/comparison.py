"""Two tables against one another: how far each found coordinate differs, attitude by attitude.

The signs are the clinical ones, the same for both sides, so a left joint compares directly with a right one, and a
joint with an earlier result of itself. Each table answers as playback does; only attitudes that both cover count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.kinematics.interpolation import FOUND, found_at, pose_curves
from pipeline.kinematics.table import Float, Grid, LutTable

#: Grid values nearer than this are one attitude, degrees.
SAME_DEG = 1e-6


@dataclass(frozen=True)
class CurveDifference:
    """How one coordinate of the second table differs from the first, over the shared attitudes.

    Attributes
    ----------
    name : str
        Such as ``anterior_mm``; its unit is that of every number here but the attitude's.
    mean : float
        Second minus first.
    rms : float
        Root mean square.
    about_mean : float
        Root mean square of what is left without the mean: the difference in shape, where frames put the zero apart.
    largest : float
        Signed; where it is, ``flexion_deg`` and ``varus_deg`` tell.
    """

    name: str
    mean: float
    rms: float
    about_mean: float
    largest: float
    flexion_deg: float
    varus_deg: float


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two tables over one grid.

    Attributes
    ----------
    sides : (str, str)
        ``right`` or ``left``, first and second.
    grid : Grid
        Every flexion and varus of either grid that lies within both.
    first, second : (F, V, 4) float64
        Coordinates in the order of ``FOUND``, mm and degrees; NaN where that table has no pose.
    curves : tuple of CurveDifference
        In the order of ``FOUND``.
    """

    sides: tuple[str, str]
    grid: Grid
    first: Float
    second: Float
    curves: tuple[CurveDifference, ...]

    @property
    def difference(self) -> Float:
        """(F, V, 4) second minus first; NaN where not both have a pose."""
        return self.second - self.first

    @property
    def shared(self) -> int:
        """Number of attitudes of the grid at which both have a pose."""
        return int(np.isfinite(self.difference[..., 0]).sum())


def compare(first: LutTable, second: LutTable) -> Comparison:
    """Compare two tables at the attitudes that both cover.

    Raises
    ------
    ValueError
        When there is no such attitude.
    """
    grid = Grid(
        _shared(first.grid.flexion_deg, second.grid.flexion_deg), _shared(first.grid.varus_deg, second.grid.varus_deg)
    )
    if not all(grid.shape):
        raise ValueError(f"one covers {_words(first.grid)}, the other {_words(second.grid)}")
    found = _found(first, grid), _found(second, grid)
    difference = found[1] - found[0]
    if not np.isfinite(difference).any():
        raise ValueError("wherever one has a stable pose, the other has none")
    curves = tuple(_curve(name, difference[..., k], grid) for k, name in enumerate(FOUND))
    return Comparison((first.side, second.side), grid, *found, curves)


def _shared(first: Float, second: Float) -> Float:
    """Values of either axis within both; those that differ by rounding alone count once."""
    low, high = max(first[0], second[0]), min(first[-1], second[-1])
    every = np.unique(np.concatenate([first, second]))
    inside = every[(every >= low) & (every <= high)]
    return np.asarray(inside[np.diff(inside, prepend=-np.inf) > SAME_DEG], dtype=np.float64)


def _words(grid: Grid) -> str:
    (f, g), (v, w) = ((axis[0], axis[-1]) for axis in (grid.flexion_deg, grid.varus_deg))
    return f"flexion {f:g} to {g:g} and varus {v:g} to {w:g} deg"


def _found(table: LutTable, grid: Grid) -> Float:
    return found_at(pose_curves(table.grid, table.poses), *np.meshgrid(grid.flexion_deg, grid.varus_deg, indexing="ij"))


def _curve(name: str, difference: Float, grid: Grid) -> CurveDifference:
    mean = float(np.nanmean(difference))
    row, column = np.unravel_index(np.nanargmax(np.abs(difference)), difference.shape)
    return CurveDifference(
        name=name,
        mean=mean,
        rms=_root_mean_square(difference),
        about_mean=_root_mean_square(difference - mean),
        largest=float(difference[row, column]),
        flexion_deg=float(grid.flexion_deg[row]),
        varus_deg=float(grid.varus_deg[column]),
    )


def _root_mean_square(values: Float) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
