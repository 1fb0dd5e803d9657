"""Laws of the clinical views: never mirrored, and the same words for a right and a left joint."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from pipeline.geometry.views import Direction, axis, view
from pipeline.records import Side
from tests.report.sample import frame_of

DIRECTIONS: tuple[Direction, ...] = get_args(Direction)
SIDES: tuple[Side, ...] = ("right", "left")
FOCUS = np.array([1.0, 2.0, 3.0])


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("seen_from", DIRECTIONS)
def test_a_view_is_a_right_handed_picture(side: Side, seen_from: Direction) -> None:
    seen = view(frame_of(side), seen_from, FOCUS, 50.0)
    assert np.cross(seen.right, seen.up) == pytest.approx(seen.toward)
    assert np.linalg.norm([seen.right, seen.up, seen.toward], axis=1) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("side", "seen_from", "edges"),
    [
        # What a radiographer sees in front of the patient: the right knee's lateral side at the left, as on a film.
        ("right", "anterior", ("lateral", "medial", "proximal", "distal")),
        ("left", "anterior", ("medial", "lateral", "proximal", "distal")),
        ("right", "lateral", ("posterior", "anterior", "proximal", "distal")),
        ("left", "lateral", ("anterior", "posterior", "proximal", "distal")),
        ("right", "posterior", ("medial", "lateral", "proximal", "distal")),
        # Axial, from the feet: anterior up, the patient's right at the left.
        ("right", "distal", ("lateral", "medial", "anterior", "posterior")),
        ("left", "distal", ("medial", "lateral", "anterior", "posterior")),
        ("right", "proximal", ("medial", "lateral", "anterior", "posterior")),
    ],
)
def test_what_lies_at_the_edges(side: Side, seen_from: Direction, edges: tuple[str, ...]) -> None:
    assert view(frame_of(side), seen_from, FOCUS, 50.0).edges == edges


@pytest.mark.parametrize("side", SIDES)
def test_points_fall_where_the_edges_say(side: Side) -> None:
    frame = frame_of(side)
    seen = view(frame, "anterior", FOCUS, 50.0)
    points = np.array([FOCUS, FOCUS + 50.0 * axis(frame, "proximal"), FOCUS + 25.0 * axis(frame, "lateral")])
    center, top, lateral = seen.pixels(points, (400, 200))
    assert center == pytest.approx([200.0, 100.0])
    assert top == pytest.approx([200.0, 0.0])
    assert lateral == pytest.approx([150.0 if side == "right" else 250.0, 100.0])


def test_a_view_has_a_size() -> None:
    with pytest.raises(ValueError, match="positive half height, got 0"):
        view(np.eye(4), "anterior", FOCUS, 0.0)
