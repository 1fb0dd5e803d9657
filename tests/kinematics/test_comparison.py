"""Two tables compared: nothing for the same and for its mirror image, exactly what was changed otherwise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.kinematics.comparison import Comparison, compare
from pipeline.kinematics.interpolation import FOUND, moved_from_scan_table
from pipeline.kinematics.table import Float, Grid, LutTable
from tests.files.lut_sample import GRID, content

BAD = ((3, 1), (4, 1))


def table(side: str = "right", grid: Grid = GRID, bad: tuple[tuple[int, int], ...] = ()) -> LutTable:
    return content(side, grid, bad).table


def shifted(name: str, by: float, bad: tuple[tuple[int, int], ...] = ()) -> LutTable:
    made = table(bad=bad)
    return replace(made, poses=replace(made.poses, **{name: getattr(made.poses, name) + by}))


def numbers(comparison: Comparison) -> Float:
    return np.array([[curve.mean, curve.rms, curve.about_mean, curve.largest] for curve in comparison.curves])


def test_a_table_with_itself_differs_in_nothing() -> None:
    found = compare(table(bad=BAD), table(bad=BAD))
    assert not numbers(found).any()
    assert [curve.name for curve in found.curves] == list(FOUND)
    assert found.shared == GRID.shape[0] * GRID.shape[1] - len(BAD)
    np.testing.assert_array_equal(found.grid.flexion_deg, GRID.flexion_deg)
    np.testing.assert_array_equal(found.grid.varus_deg, GRID.varus_deg)


def test_a_joint_and_its_mirrored_twin_differ_in_nothing_though_they_move_apart() -> None:
    right, left = table("right"), table("left")
    found = compare(right, left)
    assert found.sides == ("right", "left")
    assert not numbers(found).any()
    assert np.abs(moved_from_scan_table(right) - moved_from_scan_table(left)).max() > 1.0


@pytest.mark.parametrize("name", FOUND)
def test_a_shift_is_found_in_its_curve_alone(name: str) -> None:
    found = compare(table(), shifted(name, 1.0))
    expected = np.zeros((4, 4))
    expected[FOUND.index(name)] = (1.0, 1.0, 0.0, 1.0)
    np.testing.assert_allclose(numbers(found), expected, rtol=0, atol=1e-14)
    back = compare(shifted(name, 1.0), table())
    np.testing.assert_allclose(numbers(back), expected * [-1.0, 1.0, 1.0, -1.0], rtol=0, atol=1e-14)


def test_one_entry_is_named_and_weighs_as_one() -> None:
    other = table()
    other.poses.anterior_mm[7, 2] -= 3.0
    curve = compare(table(), other).curves[FOUND.index("anterior_mm")]
    count = GRID.shape[0] * GRID.shape[1]
    assert (curve.flexion_deg, curve.varus_deg) == (35.0, 0.0)
    assert curve.largest == pytest.approx(-3.0)
    assert curve.mean == pytest.approx(-3.0 / count)
    assert curve.rms == pytest.approx(3.0 / np.sqrt(count))
    assert curve.about_mean == pytest.approx(np.sqrt(curve.rms**2 - curve.mean**2))


def test_other_grids_meet_where_both_cover() -> None:
    finer = table(grid=Grid(np.arange(20.0, 101.0, 2.5), np.array([-2.0, 0.0, 1.0, 2.0, 6.0])))
    found = compare(table(), finer)
    np.testing.assert_array_equal(found.grid.flexion_deg, np.arange(20.0, 60.1, 2.5))
    np.testing.assert_array_equal(found.grid.varus_deg, [-2.0, -1.0, 0.0, 1.0, 2.0, 2.5])
    assert found.shared == 17 * 6
    assert 0.0 < numbers(found)[:, 1].max() < 0.01
    np.testing.assert_array_equal(numbers(compare(finer, table()))[:, 1:3], numbers(found)[:, 1:3])


def test_rounding_of_a_grid_adds_no_attitude() -> None:
    rounded = table(grid=Grid(GRID.flexion_deg * (1.0 - 1e-12), GRID.varus_deg))
    assert compare(table(), rounded).grid.shape == GRID.shape


def test_what_has_no_pose_in_one_is_not_shared() -> None:
    found = compare(table(bad=BAD), shifted("lateral_mm", 1.0, bad=((0, 0),)))
    gone = np.isnan(found.difference).any(axis=-1)
    assert {(int(i), int(j)) for i, j in np.argwhere(gone)} == {*BAD, (0, 0)}
    assert found.curves[0].rms == pytest.approx(1.0)


def test_tables_without_a_shared_attitude_are_refused() -> None:
    far = table(grid=Grid(np.arange(70.0, 91.0, 5.0), GRID.varus_deg))
    with pytest.raises(ValueError, match=r"flexion 0 to 60 .* the other flexion 70 to 90 and varus -4 to 2\.5 deg"):
        compare(table(), far)
    some = tuple(np.ndindex(GRID.shape))
    with pytest.raises(ValueError, match="wherever one has a stable pose, the other has none"):
        compare(table(bad=some[:26]), table(bad=some[26:]))
