"""The small linear programme, against reckoning by hand and against random search."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.kinematics.least_rate import best_motion

BOX = (1.0, 1.0, 1.0)


def advance(rates: np.ndarray, slack: np.ndarray, motion: object) -> float:
    return float((slack + rates @ np.asarray(motion)).min())


def test_one_contact_is_left_as_fast_as_the_box_allows() -> None:
    assert best_motion(np.array([[2.0, -3.0, 0.5]]), np.zeros(1), (1.0, 0.5, 0.25)) == pytest.approx((1, -0.5, 0.25))


def test_opposite_contacts_allow_only_what_both_gain() -> None:
    rates = np.array([[1.0, 0.5, 0.0], [-1.0, 0.5, 0.0]])
    assert best_motion(rates, np.zeros(2), BOX) == pytest.approx((0.0, 1.0, 0.0), abs=1e-9)


def test_slack_lets_the_better_side_go_first() -> None:
    """x leaves contact 0 and closes contact 1, which is 0.6 away: the least is greatest half-way."""
    x, _, _ = best_motion(np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), np.array([0.0, 0.6]), BOX)
    assert x == pytest.approx(0.3)


def test_zero_size_holds_a_component() -> None:
    motion = best_motion(np.array([[1.0, 2.0, 3.0]]), np.zeros(1), (0.0, 1.0, 0.0))
    assert motion == pytest.approx((0.0, 1.0, 0.0))


def test_only_the_combination_advances() -> None:
    """Neither a translation nor the turn alone gains on both contacts; x and turn together do."""
    rates = np.array([[3.0, 0.0, -1.0], [-1.0, 0.0, 3.0]])
    for axis in range(3):
        for sign in (1.0, -1.0):
            assert advance(rates, np.zeros(2), sign * np.eye(3)[axis]) <= 0.0
    assert advance(rates, np.zeros(2), best_motion(rates, np.zeros(2), BOX)) == pytest.approx(2.0)


@pytest.mark.parametrize("seed", range(6))
def test_no_random_motion_does_better(seed: int) -> None:
    random = np.random.default_rng(seed)
    rates, slack, box = random.normal(size=(8, 3)), random.uniform(0, 0.3, 8), (0.5, 0.3, 0.1)
    motion = best_motion(rates, slack, box)
    assert np.all(np.abs(motion) <= np.asarray(box) + 1e-9)
    trials = random.uniform(-1, 1, (2000, 3)) * box
    assert advance(rates, slack, motion) >= max(advance(rates, slack, trial) for trial in trials) - 1e-9
    assert advance(rates, slack, motion) >= advance(rates, slack, np.zeros(3)) - 1e-9


def test_neutral_directions_are_left_alone() -> None:
    """The turn changes nothing, and neither does anything between two walls: a body must not drift there."""
    walls = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    assert best_motion(walls, np.zeros(2), BOX) == (0.0, 0.0, 0.0)
    assert best_motion(np.array([[2.0, 0.0, 0.0]]), np.zeros(1), BOX) == pytest.approx((1.0, 0.0, 0.0))
