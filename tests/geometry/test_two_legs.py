"""Two legs in one label map: the declared one is taken whole, and nothing is taken where bones contradict the side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import get_args

import numpy as np
import pytest

from pipeline.geometry.phantom import PHANTOM_LABELS
from pipeline.geometry.two_legs import one_leg
from pipeline.geometry.volume import LabelVolume, cropped
from pipeline.records import Side
from tests.two_legs import leg, side_by_side, two_legs

SIDES: tuple[Side, ...] = get_args(Side)
each_side = pytest.mark.parametrize("side", SIDES)
FEMUR, TIBIA, FIBULA = (PHANTOM_LABELS[name] for name in ("femur", "tibia", "fibula"))


def without(volume: LabelVolume, *labels: int) -> LabelVolume:
    values = np.where(np.isin(volume.values, labels), 0, volume.values).astype(np.uint8)
    return LabelVolume(values, volume.lps_from_index)


def present(volume: LabelVolume) -> Mapping[str, int]:
    return {name: value for name, value in PHANTOM_LABELS.items() if (volume.values == value).any()}


def upper(volume: LabelVolume, label: int, share: float) -> LabelVolume:
    """The volume without the upper part of one structure."""
    values = np.array(volume.values)
    levels = np.flatnonzero((values == label).any(axis=(0, 1)))
    begin = int(levels[int(len(levels) * (1 - share))])
    values[:, :, begin:][values[:, :, begin:] == label] = 0
    return LabelVolume(values, volume.lps_from_index)


@each_side
def test_the_declared_leg_is_that_of_a_map_of_one_leg(side: Side) -> None:
    found, left_out = one_leg(two_legs(), PHANTOM_LABELS, side)
    assert set(left_out) == set(PHANTOM_LABELS)
    mine, alone = cropped(found, 2), cropped(leg(side), 2)
    np.testing.assert_array_equal(mine.values, alone.values)
    shift = (leg("right").values.shape[0] + 20) * leg("right").lps_from_index[:3, 0] if side == "left" else np.zeros(3)
    np.testing.assert_allclose(mine.lps_from_index[:3, 3] - shift, alone.lps_from_index[:3, 3], atol=1e-9)


@each_side
def test_one_leg_is_left_as_it_is(side: Side) -> None:
    for volume in (leg("right"), leg("left")):  # whether it is of the declared side is for the anatomy to say
        found, left_out = one_leg(volume, PHANTOM_LABELS, side)
        assert found is volume
        assert left_out == ()


@each_side
def test_a_femur_of_one_leg_and_the_tibiae_of_both(side: Side) -> None:
    legs = [leg("right"), leg("left")]
    bare = [one if name == side else without(one, FEMUR) for name, one in zip(SIDES, legs, strict=True)]
    found, left_out = one_leg(side_by_side(bare[0], bare[1]), PHANTOM_LABELS, side)
    np.testing.assert_array_equal(cropped(found, 2).values, cropped(leg(side), 2).values)
    assert "femur" not in left_out
    assert "tibia" in left_out


@each_side
def test_a_femur_of_the_other_leg_is_never_taken(side: Side) -> None:
    """As in a volume that was mirrored after its femora were named: the one named right lies at the patient's left."""
    legs = [leg("right"), leg("left")]
    bare = [without(one, FEMUR) if name == side else one for name, one in zip(SIDES, legs, strict=True)]
    with pytest.raises(ValueError, match=f"femur and tibia of the {side} leg are .* across to the other leg"):
        one_leg(side_by_side(bare[0], bare[1]), PHANTOM_LABELS, side)


@each_side
def test_legs_that_are_mirrored_each_for_itself_are_refused(side: Side) -> None:
    exchanged = side_by_side(leg("left"), leg("right"))
    with pytest.raises(ValueError, match=f"the fibula of the {side} leg lies .* to the inner side of its tibia"):
        one_leg(exchanged, PHANTOM_LABELS, side)


def test_one_above_the_other_cannot_be_told() -> None:
    one = np.asarray(leg().values)
    stacked = LabelVolume(np.concatenate([one, np.zeros_like(one[:, :, :8]), one], axis=2), np.diag([1.5, 1.5, 1.5, 1]))
    with pytest.raises(ValueError, match="the two large pieces of the femur lie 0 mm apart from left to right"):
        one_leg(stacked, PHANTOM_LABELS, "right")


def test_three_legs_cannot_be_told() -> None:
    three = side_by_side(two_legs(), LabelVolume(two_legs().values, two_legs().lps_from_index))
    with pytest.raises(ValueError, match="the femur is in 4 large pieces"):
        one_leg(three, PHANTOM_LABELS, "right")


def test_tibiae_that_were_labelled_into_one_another_are_refused() -> None:
    values = np.array(two_legs().values)
    tibia = np.argwhere(values == TIBIA)
    level = int(np.median(tibia[:, 2]))
    span = tibia[tibia[:, 2] == level]
    row = int(np.median(span[:, 1]))
    bridge = values[span[:, 0].min() : span[:, 0].max(), row, level]
    bridge[bridge == 0] = TIBIA
    with pytest.raises(ValueError, match=r"femur and tibia of the left leg are .* across to the other leg"):
        one_leg(LabelVolume(values, two_legs().lps_from_index), PHANTOM_LABELS, "left")


def test_a_structure_of_the_other_leg_alone_goes() -> None:
    mixed = side_by_side(without(leg("right"), PHANTOM_LABELS["patella"]), leg("left"))
    found, left_out = one_leg(mixed, PHANTOM_LABELS, "right")
    assert not (found.values == PHANTOM_LABELS["patella"]).any()
    assert "patella" in left_out


def test_an_island_goes_with_the_nearest_leg() -> None:
    values = np.array(two_legs().values)
    values[0, 0, 0], values[-1, 0, 0] = TIBIA, TIBIA
    right, _ = one_leg(LabelVolume(values, two_legs().lps_from_index), PHANTOM_LABELS, "right")
    left, _ = one_leg(LabelVolume(values, two_legs().lps_from_index), PHANTOM_LABELS, "left")
    assert (right.values[0, 0, 0], right.values[-1, 0, 0]) == (TIBIA, 0)
    assert (left.values[0, 0, 0], left.values[-1, 0, 0]) == (0, TIBIA)


def test_a_short_piece_of_the_other_leg_does_not_pass_for_the_declared_one() -> None:
    """The largest tibia is not taken for its size: the declared leg shows less of it."""
    cut = upper(leg("right"), FEMUR, 0.6)
    found, _ = one_leg(side_by_side(cut, leg("left")), PHANTOM_LABELS, "right")
    np.testing.assert_array_equal(cropped(found, 2).values, cropped(cut, 2).values)


def test_other_joints_are_none_of_its_business() -> None:
    values = np.zeros((40, 10, 10), dtype=np.uint8)
    values[2:8, 2:8, 2:8], values[30:36, 2:8, 2:8] = 1, 1
    volume = LabelVolume(values, np.diag([5.0, 1.0, 1.0, 1.0]))
    assert one_leg(volume, {"ball": 1}, "right") == (volume, ())


def test_the_given_volume_is_not_altered() -> None:
    before = np.array(two_legs().values)
    one_leg(two_legs(), present(two_legs()), "left")
    np.testing.assert_array_equal(two_legs().values, before)
