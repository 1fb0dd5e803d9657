"""Drawing: text, legends, sheets and PNG."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipeline.adapters import pictures
from pipeline.adapters.pictures import Text


def inked(image: pictures.Image) -> tuple[int, int]:
    """First and last column that is not white."""
    columns = np.nonzero((image < 255).any(axis=(0, 2)))[0]
    return int(columns[0]), int(columns[-1])


@pytest.mark.parametrize(("align", "start", "end"), [(0.0, 100, None), (1.0, None, 100), (0.5, None, None)])
def test_text_is_as_wide_as_said_and_where_it_belongs(align: float, start: int | None, end: int | None) -> None:
    image, text = pictures.blank(220, 40), Text("RIGHT 30°", 18)
    pictures.draw_text(image, text, (100, 25), align)
    first, last = inked(image)
    assert last - first == pytest.approx(pictures.text_width(text), abs=5)
    assert start is None or first == pytest.approx(start, abs=4)
    assert end is None or last == pytest.approx(end, abs=4)


def test_every_sign_we_use_is_in_the_font() -> None:
    def drawn(words: str) -> pictures.Image:
        image = pictures.blank(40, 40)
        pictures.draw_text(image, Text(words, 24), (5, 30))
        return image

    unknown = drawn("?")
    assert all((drawn(sign) != unknown).any() and (drawn(sign) != drawn(" ")).any() for sign in "°Δ±|")


def test_a_plate_does_not_leave_the_picture() -> None:
    image = pictures.blank(60, 30, (0, 0, 0))
    pictures.draw_tag(image, Text("outside", 16), (-20, 4))
    pictures.draw_tag(image, Text("outside", 16), (50, 40))
    assert image.shape == (30, 60, 3)


def test_lines_arrows_and_dots_are_drawn_in_their_colour() -> None:
    image, red = pictures.blank(60, 60), (200, 0, 0)
    pictures.draw_segments(image, np.array([[[5.0, 10.0], [55.0, 10.0]]]), red, 3)
    pictures.draw_arrow(image, np.array([[30.0, 55.0], [30.0, 25.0]]), red)
    pictures.draw_dots(image, np.array([[10.0, 40.0]]), red)
    pictures.draw_segments(image, np.empty((0, 2, 2)), red)
    assert [tuple(image[y, x].tolist()) for y, x in ((10, 30), (45, 30), (40, 10))] == [red] * 3


def test_a_sheet_holds_every_panel() -> None:
    panels = [[pictures.blank(20, 10, (10 * i + j, 0, 0)) for j in range(3)] for i in range(2)]
    sheet = pictures.tiled(panels, 4)
    assert sheet.shape == (24, 68, 3)
    assert [[int(sheet[14 * i + 5, 24 * j + 5, 0]) for j in range(3)] for i in range(2)] == [[0, 1, 2], [10, 11, 12]]


def test_a_long_legend_wraps_within_its_height() -> None:
    entries = [(f"structure {i}", (i, 0, 0)) for i in range(12)]
    height = pictures.legend_height(entries, 400)
    image = pictures.blank(400, height)
    pictures.draw_legend(image, entries, (14, 24))
    found = {int(value) for value in np.unique(image[..., 0][(image[..., 1] == 0) & (image[..., 2] == 0)])}
    assert set(range(12)) <= found
    assert pictures.legend_height([], 400) == 0


def test_png_gives_the_picture_back_and_nothing_else() -> None:
    image = np.random.default_rng(3).integers(0, 256, (7, 5, 3), dtype=np.uint8)
    data = pictures.png(image)
    assert data == pictures.png(image)
    read = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert read is not None
    assert (read[..., ::-1] == image).all()
    assert not any(chunk in data for chunk in (b"tEXt", b"iTXt", b"tIME"))


@pytest.mark.parametrize("image", [np.zeros((4, 4, 3)), np.zeros((4, 4), np.uint8), np.zeros((4, 4, 4), np.uint8)])
def test_png_refuses_what_it_would_silently_change(image: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"expected a picture \(H, W, 3\) of uint8"):
        pictures.png(image)
