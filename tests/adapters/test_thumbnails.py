"""Thumbnails: the panel that was asked for, whole pictures where there are no panels, and a plate for a missing one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipeline.adapters.pictures import png, tiled
from pipeline.adapters.thumbnails import GAP_PX, PANEL_PX, panel_of_sheet, strip_jpeg

TOP = 64


def sheet(size: int = 70, rows: int = 3, columns: int = 4) -> bytes:
    """Panels whose red tells their row and green their column, below a heading."""
    panels = [[np.full((size, size, 3), (40 * i, 50 * j, 99), np.uint8) for j in range(columns)] for i in range(rows)]
    body = tiled(panels)
    return png(
        np.vstack(
            [np.full((TOP, body.shape[1], 3), 255, np.uint8), body, np.full((30, body.shape[1], 3), 250, np.uint8)]
        )
    )


@pytest.mark.parametrize("size", [64, 70, 300])
@pytest.mark.parametrize(("asked", "got"), [((0, 0), (0, 0)), ((1, 3), (1, 3)), ((2, 1), (2, 1)), ((0, 9), (0, 3))])
def test_the_panel_that_was_asked_for(size: int, asked: tuple[int, int], got: tuple[int, int]) -> None:
    panel = panel_of_sheet(sheet(size), TOP, asked)
    assert panel is not None
    assert panel.shape == (size, size, 3)
    assert (panel == (40 * got[0], 50 * got[1], 99)).all()


def test_a_picture_without_panels_is_whole() -> None:
    curves = np.random.default_rng(1).integers(0, 200, (120, 300, 3), np.uint8)
    whole = panel_of_sheet(png(curves), TOP, (0, 0))
    np.testing.assert_array_equal(whole, curves)


@pytest.mark.parametrize("data", [b"", b"no picture", sheet()[:100]])
def test_no_picture_is_no_panel(data: bytes) -> None:
    assert panel_of_sheet(data, TOP, (0, 0)) is None


def test_a_strip_holds_the_panels_in_order_and_says_which_is_missing() -> None:
    red, wide = np.full((50, 50, 3), (220, 0, 0), np.uint8), np.full((20, 80, 3), (0, 0, 220), np.uint8)
    data = strip_jpeg([red, None, wide])
    assert data == strip_jpeg([red, None, wide])
    found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert found is not None
    strip = found[..., ::-1].astype(int)
    assert strip.shape == (PANEL_PX, 3 * PANEL_PX + 2 * GAP_PX, 3)
    assert np.abs(strip[10:-10, 10 : PANEL_PX - 10] - (220, 0, 0)).max() < 12
    plate = strip[:, PANEL_PX + GAP_PX : 2 * PANEL_PX + GAP_PX]
    assert plate.min() < 150  # the word
    assert np.median(plate) > 230
    last = strip[:, -PANEL_PX:]
    assert np.abs(last[42:54, 10:-10] - (0, 0, 220)).max() < 12
    assert last[:20].min() > 240
