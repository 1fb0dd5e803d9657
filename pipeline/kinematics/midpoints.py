"""Contact half-way between entries: where the way along delta has a corner that no curve through the entries follows.

Where contact passes from one place to another within a step, the depth bends at once; a spline through entries that are
all in contact then cuts the corner and swings beside it. Shared between entries and midpoints the error is smaller: a
few entries stand off contact by at most an allowance, no more of them and no farther than an aim at midpoints asks for.
Where the aim is out of reach (a coarse grid), every entry stays in contact.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.kinematics.interpolation import usable_runs
from pipeline.kinematics.spline import interval_polynomials
from pipeline.kinematics.table import Float, Grid


def shared_error(
    grid: Grid, usable: NDArray[np.bool_], midpoint_error_mm: Float, aim_mm: float, allowance_mm: float
) -> Float:
    """How far to push entries on along delta so that the midpoints of their column come nearer to contact.

    For each unbroken run of entries, a linear programme: the least total of pushes, none above the allowance, that
    takes every midpoint within the aim; none at all where there is no such.

    Parameters
    ----------
    grid : Grid
    usable : (F, V) bool
        Entries that a reader interpolates between.
    midpoint_error_mm : (F - 1, V) float64
        Signed way to contact half-way between entries that are all in contact: + a gap; NaN where not known.
    aim_mm, allowance_mm : float
        Wanted at midpoints; allowed at entries.

    Returns
    -------
    (F, V) float64
        To be added to z: + pushes on (an overlap at the entry), - pulls back (a gap); 0 where nothing is asked for.
    """
    push = np.zeros(grid.shape)
    for column in range(grid.shape[1]):
        for run in usable_runs(usable[:, column]):
            error = midpoint_error_mm[run.start : run.stop - 1, column]
            if np.nanmax(np.abs(error), initial=0.0) > aim_mm:
                push[run, column] = _least_push(_half_way(grid.flexion_deg[run]), error, aim_mm, allowance_mm)
    return push


def _half_way(flexion_deg: Float) -> Float:
    """(N - 1, N) the spline's value in the middle of each interval from the values at the samples."""
    cubic = interval_polynomials(flexion_deg, np.eye(len(flexion_deg)))
    powers = (0.5 * np.diff(flexion_deg))[:, None] ** np.arange(3, -1, -1)
    return np.asarray(np.einsum("ip,ipk->ik", powers, cubic))


def _least_push(half_way: Float, error: Float, aim_mm: float, allowance_mm: float) -> Float:
    """(N,) push of each entry of one run; the variables are pushes on and pulls back."""
    from scipy.optimize import linprog  # noqa: PLC0415 - not loaded by a cached run

    known = np.isfinite(error)
    moved = np.hstack([half_way[known], -half_way[known]])
    answer = linprog(
        np.ones(moved.shape[1]),
        A_ub=np.vstack([moved, -moved]),
        b_ub=aim_mm + np.concatenate([error[known], -error[known]]),
        bounds=(0.0, allowance_mm),
        method="highs-ds",
    )
    if not answer.success:
        return np.zeros(half_way.shape[1])
    on, back = np.split(np.asarray(answer.x), 2)
    return np.asarray(on - back)
