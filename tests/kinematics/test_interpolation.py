"""Between the entries: the spline against scipy, the motion against the scalar formula, and what is not covered."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from pipeline.kinematics.interpolation import (
    found_at,
    found_coordinates,
    look_up,
    motion_map,
    motions,
    moved_from_scan_table,
    pose_curves,
    usable_entries,
    usable_runs,
)
from pipeline.kinematics.joint_coordinates import JointCoordinates, moved_from_scan
from pipeline.kinematics.spline import interval_polynomials
from pipeline.kinematics.table import Grid, LutTable
from tests.files.lut_sample import GRID, frames, poses

Float = NDArray[np.float64]

#: Entries that break column 1 into runs of 3 and 8, column 2 into 1, 2 and 8, and leave column 3 without its ends.
BAD = ((3, 1), (4, 1), (1, 2), (4, 2), (0, 3), (12, 3))


def table(side: str = "right", bad: tuple[tuple[int, int], ...] = ()) -> LutTable:
    return LutTable(side, GRID, poses(GRID, bad), *frames(side))


@pytest.mark.parametrize("count", range(2, 14))
def test_spline_is_scipys(count: int) -> None:
    rng = np.random.default_rng(count)
    x = np.cumsum(rng.uniform(0.5, 3.0, count))
    y = rng.normal(size=(count, 4))
    ours, theirs = interval_polynomials(x, y), CubicSpline(x, y)
    for at in np.linspace(x[0], x[-1], 57):
        i = min(np.searchsorted(x, at, side="right") - 1, count - 2)
        value = sum(ours[i, power] * (at - x[i]) ** (3 - power) for power in range(4))
        np.testing.assert_allclose(value, theirs(at), rtol=0, atol=1e-12)


def test_spline_refuses_what_is_no_axis() -> None:
    with pytest.raises(ValueError, match="two or more samples at increasing places"):
        interval_polynomials(np.array([0.0]), np.zeros((1, 4)))
    with pytest.raises(ValueError, match="two or more samples at increasing places"):
        interval_polynomials(np.array([0.0, 0.0]), np.zeros((2, 4)))


def test_runs_are_the_unbroken_stretches() -> None:
    usable = np.array([True, False, True, True, False, False, True])
    assert usable_runs(usable) == [slice(0, 1), slice(2, 4), slice(6, 7)]
    assert usable_runs(np.zeros(3, dtype=bool)) == []


@pytest.mark.parametrize("side", ["right", "left"])
def test_every_motion_is_the_scalar_formula(side: str) -> None:
    lut = table(side, BAD)
    moved, usable = moved_from_scan_table(lut), usable_entries(lut.poses)
    assert np.isnan(moved[~usable]).all()
    for i, j in np.argwhere(usable):
        x, y, z, rotation = map(float, found_coordinates(lut.poses)[i, j])
        flexion, varus = np.radians([GRID.flexion_deg[i], GRID.varus_deg[j]])
        pose = JointCoordinates(float(flexion), float(varus), float(np.radians(rotation)), x, y, z)
        expected = moved_from_scan(lut.scan_from_reference, lut.scan_from_moving, pose)
        np.testing.assert_allclose(moved[i, j], expected, rtol=0, atol=1e-10)
        np.testing.assert_array_equal(moved[i, j, 3], [0.0, 0.0, 0.0, 1.0])


@pytest.mark.parametrize("side", ["right", "left"])
def test_every_motion_is_proper_and_rigid(side: str) -> None:
    turns = moved_from_scan_table(table(side))[..., :3, :3]
    np.testing.assert_allclose(np.linalg.det(turns), 1.0, atol=1e-12)
    np.testing.assert_allclose(turns @ np.swapaxes(turns, -1, -2), np.broadcast_to(np.eye(3), turns.shape), atol=1e-12)


def test_mirrored_frames_make_the_mirrored_motion() -> None:
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    right = table("right")
    left = LutTable("left", GRID, right.poses, mirror @ right.scan_from_reference, mirror @ right.scan_from_moving)
    np.testing.assert_allclose(
        moved_from_scan_table(left), mirror @ moved_from_scan_table(right) @ mirror, rtol=0, atol=1e-10
    )


def test_right_handed_frames_of_a_left_joint_negate_three_coordinates() -> None:
    left = table("left")
    found, varus = found_coordinates(left.poses)[5, 3], GRID.varus_deg[3]
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    right_handed = motion_map(left.scan_from_reference @ mirror, left.scan_from_moving @ mirror)
    flexion = GRID.flexion_deg[5]
    other = motions(right_handed, flexion, -varus, found * [-1.0, 1.0, 1.0, -1.0])
    np.testing.assert_allclose(other, moved_from_scan_table(left)[5, 3], rtol=0, atol=1e-10)


def test_entries_are_reproduced_exactly() -> None:
    curves = pose_curves(GRID, poses(GRID, BAD))
    flexion, varus = np.meshgrid(GRID.flexion_deg, GRID.varus_deg, indexing="ij")
    np.testing.assert_array_equal(found_at(curves, flexion, varus), found_coordinates(poses(GRID, BAD)))


def test_a_column_is_the_spline_of_a_reader() -> None:
    curves, found = pose_curves(GRID, poses(GRID)), found_coordinates(poses(GRID))
    flexion = np.linspace(0.0, 60.0, 111)
    for j, varus in enumerate(GRID.varus_deg):
        expected = CubicSpline(GRID.flexion_deg, found[:, j])(flexion)
        np.testing.assert_allclose(found_at(curves, flexion, np.full(111, varus)), expected, rtol=0, atol=1e-12)


def test_between_columns_it_is_linear() -> None:
    curves = pose_curves(GRID, poses(GRID))
    one, other, between = found_at(curves, np.full(3, 17.3), np.array([0.0, 2.5, 0.75]))
    np.testing.assert_allclose(between, 0.7 * one + 0.3 * other, rtol=0, atol=1e-12)


def test_a_run_is_the_spline_of_its_own_entries() -> None:
    curves, found = pose_curves(GRID, poses(GRID, BAD)), found_coordinates(poses(GRID, BAD))
    for j, run in ((1, slice(0, 3)), (1, slice(5, 13)), (2, slice(2, 4)), (3, slice(1, 12))):
        x = GRID.flexion_deg[run]
        flexion = np.linspace(x[0], x[-1], 41)
        expected = CubicSpline(x, found[run, j])(flexion)
        np.testing.assert_allclose(found_at(curves, flexion, np.full(41, GRID.varus_deg[j])), expected, atol=1e-12)


def test_beside_an_unusable_entry_there_is_nothing() -> None:
    curves = pose_curves(GRID, poses(GRID, ((6, 1),)))
    for flexion, varus in ((27.5, -1.0), (30.0, -1.0), (32.5, -1.0), (27.5, -0.5), (30.0, -1.5)):
        assert np.isnan(found_at(curves, np.array(flexion), np.array(varus))).all()
    for flexion, varus in ((25.0, -1.0), (27.5, 0.0), (35.0, -0.5), (27.5, -4.0)):
        assert np.isfinite(found_at(curves, np.array(flexion), np.array(varus))).all()


@pytest.mark.parametrize(
    ("flexion", "varus", "sentence"),
    [
        (60.5, 0.0, "flexion 60.5 deg is outside the table, which covers 0 to 60 deg"),
        (-1.0, 0.0, "flexion -1 deg is outside"),
        (10.0, 3.0, "varus 3 deg is outside the table, which covers -4 to 2.5 deg"),
        (17.0, -1.0, "no stable pose at flexion 17 deg, varus -1 deg"),
        (np.nan, 0.0, "flexion nan deg is outside"),
    ],
)
def test_raise_says_what_is_not_covered(flexion: float, varus: float, sentence: str) -> None:
    curves = pose_curves(GRID, poses(GRID, BAD))
    with pytest.raises(ValueError, match=sentence):
        look_up(curves, flexion, varus, "raise")
    with pytest.raises(ValueError, match=sentence):
        look_up(curves, [10.0, flexion], [0.0, varus], "raise")
    assert np.isnan(look_up(curves, flexion, varus, "nan")[2]).all()


def test_clamp_stops_at_the_ends_of_the_grid() -> None:
    curves = pose_curves(GRID, poses(GRID))
    flexion, varus, found = look_up(curves, [-20.0, 99.0, 33.0], [0.3, 9.0, -7.0], "clamp")
    np.testing.assert_array_equal(flexion, [0.0, 60.0, 33.0])
    np.testing.assert_array_equal(varus, [0.3, 2.5, -4.0])
    np.testing.assert_array_equal(found, found_at(curves, flexion, varus))


def test_clamp_takes_the_nearest_covered_attitude() -> None:
    curves = pose_curves(GRID, poses(GRID, BAD))
    flexion, varus = np.meshgrid(np.linspace(-5, 65, 141), np.linspace(-5, 3, 81), indexing="ij")
    covered = np.isfinite(found_at(curves, flexion, varus)[..., 0])
    places = np.stack([flexion[covered], varus[covered]], axis=-1)
    for wanted in np.random.default_rng(1).uniform([-5.0, -5.0], [65.0, 3.0], (60, 2)):
        *used, found = look_up(curves, wanted[0], wanted[1], "clamp")
        assert np.isfinite(found).all()
        assert np.hypot(*(np.array(used) - wanted)) <= np.hypot(*(places - wanted).T).min() + 1e-12


def test_clamp_needs_a_number_and_an_entry() -> None:
    with pytest.raises(ValueError, match="not a number has no nearest one"):
        look_up(pose_curves(GRID, poses(GRID)), np.nan, 0.0, "clamp")
    small = Grid(np.array([0.0, 5.0]), np.array([0.0]))
    with pytest.raises(ValueError, match="the table has no usable entry"):
        look_up(pose_curves(small, poses(small, ((0, 0), (1, 0)))), 0.0, 0.0, "clamp")


def test_an_unknown_policy_is_refused() -> None:
    with pytest.raises(ValueError, match="expected 'raise', 'clamp' or 'nan', got 'wrap'"):
        look_up(pose_curves(GRID, poses(GRID)), 0.0, 0.0, "wrap")  # type: ignore[arg-type]


def test_a_table_of_one_attitude_answers_there_and_only_there() -> None:
    grid = Grid(np.array([10.0]), np.array([0.0]))
    curves = pose_curves(grid, poses(grid))
    np.testing.assert_array_equal(found_at(curves, np.array(10.0), np.array(0.0)), found_coordinates(poses(grid))[0, 0])
    assert np.isnan(look_up(curves, 10.5, 0.0, "nan")[2]).all()
    np.testing.assert_array_equal(look_up(curves, 12.0, -3.0, "clamp")[:2], (10.0, 0.0))


def test_poses_that_do_not_fit_the_grid_are_refused() -> None:
    with pytest.raises(ValueError, match="expected shape"):
        pose_curves(Grid(GRID.flexion_deg[1:], GRID.varus_deg), poses(GRID))
