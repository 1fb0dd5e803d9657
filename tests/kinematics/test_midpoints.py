"""Errors shared between entries and midpoints, against another library's spline."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from pipeline.kinematics.midpoints import shared_error
from pipeline.kinematics.table import Float, Grid

FLEXION = np.arange(0.0, 21.0)
HALF = FLEXION[:-1] + 0.5
GRID = Grid(FLEXION, np.array([-1.0, 0.0]))
EVERY = np.ones(GRID.shape, dtype=bool)
AIM, ALLOWED = 0.01, 0.012


def depth(flexion: Float, bend: float, at: float = 9.4) -> Float:
    """A way to contact that bends at once, by so many millimetres a degree."""
    return bend * np.maximum(flexion - at, 0.0)


def gaps(bend: float, push: Float) -> Float:
    """(F - 1,) way to contact half-way, as a reader interpolates entries that were pushed."""
    spline = CubicSpline(FLEXION, depth(FLEXION, bend) + push)
    return np.asarray(depth(HALF, bend) - spline(HALF))


@pytest.mark.parametrize("bend", [0.15, -0.15])
def test_entries_near_a_corner_give_way_until_midpoints_hold_the_aim(bend: float) -> None:
    error = np.column_stack([gaps(bend, np.zeros(21)), np.zeros(20)])
    assert np.abs(error).max() > AIM
    push = shared_error(GRID, EVERY, error, AIM, ALLOWED)
    assert np.abs(gaps(bend, push[:, 0])).max() <= AIM + 1e-9
    assert np.abs(push).max() <= ALLOWED
    np.testing.assert_array_equal(push[:, 1], 0.0)
    assert set(np.flatnonzero(np.abs(push[:, 0]) > 1e-9)) <= {8, 9, 10, 11}


def test_an_aim_out_of_reach_leaves_every_entry_in_contact() -> None:
    error = np.column_stack([gaps(0.4, np.zeros(21)), gaps(0.15, np.zeros(21))])
    push = shared_error(GRID, EVERY, error, AIM, ALLOWED)
    np.testing.assert_array_equal(push[:, 0], 0.0)
    assert push[:, 1].any()


def test_midpoints_within_the_aim_ask_for_nothing() -> None:
    error = np.full((20, 2), 0.99 * AIM)
    np.testing.assert_array_equal(shared_error(GRID, EVERY, error, AIM, ALLOWED), 0.0)


def test_runs_are_apart_and_what_is_not_known_asks_for_nothing() -> None:
    """The first column is broken at 6 deg: its corner lies in the second run; the second column is not known."""
    usable = EVERY.copy()
    usable[6, 0] = False
    later = slice(7, 21)
    spline = CubicSpline(FLEXION[later], depth(FLEXION[later], 0.15))
    error = np.full((20, 2), np.nan)
    error[:5, 0] = 0.0
    error[7:, 0] = depth(HALF[7:], 0.15) - spline(HALF[7:])
    push = shared_error(GRID, usable, error, AIM, ALLOWED)
    np.testing.assert_array_equal(push[:7, 0], 0.0)
    np.testing.assert_array_equal(push[:, 1], 0.0)
    mended = CubicSpline(FLEXION[later], depth(FLEXION[later], 0.15) + push[later, 0])
    assert np.abs(depth(HALF[7:], 0.15) - mended(HALF[7:])).max() <= AIM + 1e-9
