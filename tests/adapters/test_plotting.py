"""Charts: the same bytes for the same input, and no text that a user gave can break them."""

from __future__ import annotations

from typing import Any, get_args

import cv2
import numpy as np
import pytest

from pipeline.adapters.plotting import (
    Backdrop,
    Band,
    Chart,
    ColorScale,
    Curve,
    Layout,
    Look,
    Points,
    Words,
    Zone,
    charts_png,
)

X = np.linspace(0.0, 120.0, 13)
CURVE = Curve(X, np.sin(X / 40.0), "#0072b2", "line", "varus 0 deg")


def chart(*curves: Curve, **more: Any) -> list[Chart]:
    """One chart of some curves."""
    return [Chart("Lateral shift", "Flexion (deg)", "mm", curves, **more)]


def test_the_same_charts_give_the_same_bytes_without_metadata() -> None:
    data = charts_png("Case A", "Research use", chart(CURVE))
    assert data == charts_png("Case A", "Research use", chart(CURVE))
    assert data.startswith(b"\x89PNG")
    assert not any(chunk in data for chunk in (b"tEXt", b"iTXt", b"tIME"))


def test_every_look_is_drawn() -> None:
    plain = charts_png("A", "", chart(CURVE))
    drawn = {charts_png("A", "", chart(CURVE, Curve(X[:3], X[:3] / 100.0, "#d55e00", look))) for look in get_args(Look)}
    assert len(drawn - {plain}) == len(get_args(Look))


def pixels(charts: list[Chart], layout: Layout | None = None) -> np.ndarray:
    """The picture of charts, (H, W, 3) BGR."""
    data = charts_png("A", "", charts) if layout is None else charts_png("A", "", charts, layout)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image


def count(image: np.ndarray, rgb: tuple[int, int, int]) -> int:
    """Pixels of exactly this colour."""
    return int((image == np.array(rgb[::-1])).all(axis=-1).sum())


def test_a_band_fills_what_lies_between_and_a_zone_all_of_the_height() -> None:
    # a fifth of pure red on white
    pale = (255, 204, 204)
    half = pixels(chart(CURVE, areas=[Band(X[:7], np.full(7, 0.0), np.full(7, 0.1), "#ff0000")]))
    whole = pixels(chart(CURVE, areas=[Zone(0.0, 60.0, "#ff0000")]))
    assert 1000 < count(half, pale) < 0.3 * count(whole, pale)
    assert count(pixels(chart(CURVE)), pale) == 0


def test_points_have_their_own_colours_and_hollow_ones_a_white_middle() -> None:
    colors = ["#ff0000", "#00ff00"]
    solid, hollow = (pixels(chart(marks=[Points(X[:2], X[:2], colors, empty)])) for empty in (False, True))
    for rgb in ((255, 0, 0), (0, 255, 0)):
        assert count(solid, rgb) > count(hollow, rgb) > 0


def test_words_stand_on_the_side_that_is_asked_for() -> None:
    blank = pixels(chart(Curve(X, X, "#ffffff")))
    left, right = (
        pixels(chart(Curve(X, X, "#ffffff"), marks=[Words(60.0, 60.0, "here", beside)])) for beside in ("left", "right")
    )
    middles = [np.flatnonzero((image != blank).any(axis=(0, 2))) for image in (left, right)]
    assert middles[0].max() < middles[1].min()


def test_a_backdrop_lies_where_its_edges_say_unstretched_and_may_run_backwards() -> None:
    # the left half of the picture is red
    picture = np.zeros((40, 80, 3), dtype=np.uint8)
    picture[:, :40] = (255, 0, 0)
    point = Curve(np.array([-20.0]), np.array([0.0]), "#ffffff", "star")

    def red_beside_the_point(edges: tuple[float, float, float, float]) -> tuple[bool, float]:
        image = pixels([Chart("Map", "mm", "mm", [point], backdrop=Backdrop(picture, edges))])
        rows, columns = np.nonzero((image == (0, 0, 255)).all(axis=-1))
        white = np.argwhere((image[rows.min() : rows.max(), columns.min() : columns.max()] == 255).all(axis=-1))
        return bool(len(white)), float(np.ptp(columns) / np.ptp(rows))

    forwards, backwards = (
        red_beside_the_point(edges) for edges in ((-40.0, 40.0, -20.0, 20.0), (40.0, -40.0, -20.0, 20.0))
    )
    assert (forwards[0], backwards[0]) == (True, False)
    assert forwards[1] == pytest.approx(1.0, abs=0.05)


def test_a_scale_shows_its_colours() -> None:
    colors = np.array([(255, 0, 0), (0, 255, 0)], dtype=np.uint8)
    image = pixels([Chart("Map", "mm", "mm", [CURVE], scale=ColorScale("Flexion (deg)", (0.0, 120.0), colors))])
    assert count(image, (255, 0, 0)) == pytest.approx(count(image, (0, 255, 0)), rel=0.1)
    assert count(image, (255, 0, 0)) > 500


def test_the_ends_of_the_vertical_axis_can_be_said() -> None:
    low = [Chart("Margin", "deg", "mm", [Curve(X, np.full(13, 5.0), "#ff0000")], y_ends=(0.0, 60.0))]
    image = pixels(low)
    rows, _ = np.nonzero((image == (0, 0, 255)).all(axis=-1))
    # a twelfth above the foot of the chart, not in its middle
    assert rows.min() > 0.55 * len(image)


def test_a_legend_in_a_cell_leaves_no_row_below() -> None:
    three = [*chart(CURVE), *chart(CURVE), *chart(CURVE)]
    below, beside = pixels(three), pixels(three, Layout(legend_in_cell=True))
    assert len(beside) < len(below)
    free = (slice(len(beside) // 2, len(beside) - 80), slice(720, None))
    assert (beside[free] != 255).any()
    assert (pixels(three, Layout(legend_in_cell=True))[free] == beside[free]).all()


def test_names_are_not_mathematics() -> None:
    assert charts_png(r"Case $\frac$ DOE$^$", "$", chart(CURVE)).startswith(b"\x89PNG")


def test_missing_values_leave_a_gap() -> None:
    holed = np.where(np.arange(13) == 6, np.nan, CURVE.y)
    assert charts_png("A", "", chart(Curve(X, holed, CURVE.color, "line", CURVE.label))) != charts_png(
        "A", "", chart(CURVE)
    )


def test_rounding_noise_does_not_fill_a_chart() -> None:
    noise = Curve(X, 1e-12 * np.cos(X), "#000000", "line", "noise")
    flat = Curve(X, np.zeros(13), "#000000", "line", "noise")

    assert (pixels(chart(noise)) == pixels(chart(flat))).all()


def test_a_line_of_one_point_is_seen() -> None:
    assert count(pixels(chart(Curve(np.array([3.0]), np.array([1.0]), "#ff0000"))), (255, 0, 0)) > 10
