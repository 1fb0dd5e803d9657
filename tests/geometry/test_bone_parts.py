"""Threshold, filling and naming of bones, on shapes whose answer is plain."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.geometry.bone_parts import (
    Piece,
    boundary_hu,
    chosen_knee,
    contested,
    everywhere_nearest,
    filled,
    find_knee,
    knees_of,
    largest_piece,
    refined,
)
from pipeline.geometry.volume import CtVolume

ONE = np.ones(3)


def tube(gap: int = 0) -> NDArray[np.bool_]:
    """A tube along k that both ends of the array cut, with a slit of some voxels in its wall."""
    i, j = np.meshgrid(np.arange(21) - 10.0, np.arange(21) - 10.0, indexing="ij")
    radius = np.hypot(i, j)
    out = np.repeat(((radius < 8) & (radius > 5.5))[:, :, None], 30, axis=2)
    out[15:, 10 : 10 + gap, 12:18] = False
    return out


def test_a_canal_that_the_border_cuts_is_filled() -> None:
    out = filled(tube(), 0.0, ONE)
    assert out[10, 10].all()
    assert not out[0, 0].any()
    np.testing.assert_array_equal(out, filled(tube(), 1.5, ONE))


def test_a_slit_in_the_wall_lets_nothing_out() -> None:
    out = filled(tube(gap=2), 1.5, ONE)
    assert out[10, 10].all()
    assert np.count_nonzero(out & ~filled(tube(), 0.0, ONE)) == 0


def test_a_dish_stays_empty() -> None:
    block = np.zeros((24, 24, 16), dtype=bool)
    block[3:21, 3:21, 3:12] = True
    block[6:18, 6:18, 9:12] = False
    np.testing.assert_array_equal(filled(block, 0.0, ONE), block)


@pytest.mark.parametrize("blur", [0.8, 1.5])
def test_the_boundary_of_thick_dense_bone_is_not_moved_by_blur(blur: float) -> None:
    step = np.where(np.arange(60) >= 30, np.float32(900), np.float32(50))
    values = ndimage.gaussian_filter1d(np.broadcast_to(step, (9, 9, 60)).copy(), blur, axis=2)
    bone = values > boundary_hu(values, ONE, 0.5)
    assert int(np.argmax(bone[4, 4])) == 30
    assert not bone[4, 4, :30].any()


def test_metal_does_not_raise_the_boundary() -> None:
    values = np.full((20, 20, 20), 300, np.float32)
    values[10, 10, 10] = 3071
    assert boundary_hu(values, ONE).max() == pytest.approx(50 + 0.6 * 250)


def test_refined_undoes_averaging_of_whole_blocks() -> None:
    coarse = np.arange(8, dtype=np.uint8).reshape(2, 2, 2)
    fine = refined(coarse, (2, 3, 1), (4, 5, 2))
    assert fine.shape == (4, 5, 2)
    np.testing.assert_array_equal(fine[::2, ::3], coarse)


def test_only_where_two_bones_are_near_is_it_contested() -> None:
    regions = np.zeros((30, 5, 5), np.uint8)
    regions[:10], regions[12:] = 1, 2
    where = np.flatnonzero(contested(regions, ONE, 3.0)[:, 2, 2])
    assert (where[0], where[-1]) == (9, 12)
    owner = everywhere_nearest(regions, ONE, 1.0)[:, 2, 2]
    assert owner[:11].tolist() == [1] * 11
    assert owner[11:].tolist() == [2] * 19


def test_the_largest_piece() -> None:
    mask = np.zeros((9, 9, 9), dtype=bool)
    mask[1:3, 1, 1] = mask[5:8, 5, 5] = True
    assert np.argwhere(largest_piece(mask)).tolist() == [[5, 5, 5], [6, 5, 5], [7, 5, 5]]
    with pytest.raises(ValueError, match="no pieces"):
        largest_piece(np.zeros((2, 2, 2), dtype=bool))


def box(number: int, low: tuple[float, float, float], high: tuple[float, float, float]) -> Piece:
    axes = [np.arange(a, b + 0.1, 3.0) for a, b in zip(low, high, strict=True)]
    points = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
    return Piece(number, points, len(points) * 27.0)


def right_knee(x: float, number: int, *, fibula_way: int = -1) -> list[Piece]:
    """Blocks in the place of femur, tibia, patella and fibula of a right knee; LPS mm."""
    femur = box(number, (x - 36, -30, 2), (x + 36, 30, 90))
    tibia = box(number + 1, (x - 36, -24, -90), (x + 36, 24, -2))
    patella = box(number + 2, (x - 20, -60, 0), (x + 20, -45, 40))
    middle = x + 48 * fibula_way
    fibula = box(number + 3, (middle - 6, 3, -90), (middle + 6, 15, -15))
    return [fibula, patella, tibia, femur]


def test_bones_are_named_by_where_they_lie() -> None:
    (knee,) = knees_of(right_knee(0.0, 1))
    assert [bone.number if bone else None for bone in knee] == [1, 2, 3, 4]
    assert knee.joint_mm == pytest.approx(0.0, abs=3.0)


def test_the_leg_of_the_declared_side_is_chosen() -> None:
    knees = knees_of([*right_knee(-150.0, 1), *right_knee(150.0, 11, fibula_way=1)])
    assert len(knees) == 2
    right, left = chosen_knee(knees, "right"), chosen_knee(knees, "left")
    assert right is not None
    assert left is not None
    assert (right.femur.number, left.femur.number) == (1, 11)
    assert (right.fibula and right.fibula.number, left.fibula and left.fibula.number) == (4, 14)


def test_bones_that_do_not_meet_are_no_knee() -> None:
    femur = box(1, (-36, -30, 60), (36, 30, 150))
    assert knees_of([femur, *right_knee(0.0, 11)[1:3]]) == ()
    assert chosen_knee((), "left") is None


def test_soft_tissue_alone_is_no_knee() -> None:
    with pytest.raises(ValueError, match="nothing in it is as dense as bone"):
        find_knee(CtVolume(np.full((40, 40, 40), 60, np.int16), np.eye(4)), "right")
