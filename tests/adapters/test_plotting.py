"""Charts: the same bytes for the same input, and no text that a user gave can break them."""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.adapters.plotting import Chart, Curve, charts_png

X = np.linspace(0.0, 120.0, 13)
CURVE = Curve(X, np.sin(X / 40.0), "#0072b2", "line", "varus 0 deg")


def chart(*curves: Curve) -> list[Chart]:
    """One chart of some curves."""
    return [Chart("Lateral shift", "Flexion (deg)", "mm", curves)]


def test_the_same_charts_give_the_same_bytes_without_metadata() -> None:
    data = charts_png("Case A", "Research use", chart(CURVE))
    assert data == charts_png("Case A", "Research use", chart(CURVE))
    assert data.startswith(b"\x89PNG")
    assert not any(chunk in data for chunk in (b"tEXt", b"iTXt", b"tIME"))


def test_every_look_is_drawn() -> None:
    plain = charts_png("A", "", chart(CURVE))
    for look in ("line", "dashed", "dots", "cross", "star", "bar"):
        assert charts_png("A", "", chart(CURVE, Curve(X[:3], X[:3] / 100.0, "#d55e00", look))) != plain


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

    def pixels(curve: Curve) -> np.ndarray:
        image = cv2.imdecode(np.frombuffer(charts_png("A", "", chart(curve)), np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return image

    assert (pixels(noise) == pixels(flat)).all()
