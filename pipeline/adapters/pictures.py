"""Drawing on pictures with OpenCV: text, lines, outlines, contact sheets, PNG.

Pictures are (H, W, 3) uint8 RGB arrays. Functions named ``draw_*`` change the picture they are given; the others return
a new one. OpenCV is imported inside the functions, so that a run that draws nothing does not load it.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import cv2

Float = NDArray[np.float64]
Image = NDArray[np.uint8]
Color = tuple[int, int, int]

INK: Color = (25, 25, 25)
PAPER: Color = (255, 255, 255)
GREY: Color = (110, 110, 110)

REGULAR, BOLD = 400, 700
#: Effort of compression, 0 to 9: 9 makes files of 2 % less and takes three times as long as 6.
PNG_LEVEL = 6
#: Sub-pixel bits that OpenCV's anti-aliased drawing takes.
_SHIFT = 4


@dataclass(frozen=True)
class Text:
    """A line of text: what, how large (pixels), how heavy, in which colour."""

    words: str
    size_px: int = 16
    weight: int = REGULAR
    color: Color = INK


@functools.cache
def _font() -> cv2.FontFace:
    import cv2  # noqa: PLC0415

    # Comes with the OpenCV wheel: the same letters on every machine, Greek and degree signs included.
    return cv2.FontFace("sans")


def blank(width: int, height: int, color: Color = PAPER) -> Image:
    """A picture of one colour."""
    return np.full((height, width, 3), color, dtype=np.uint8)


def text_width(text: Text) -> int:
    """Pixels that a line of text is wide."""
    import cv2  # noqa: PLC0415

    box = cv2.getTextSize((1, 1), text.words, (0, 0), _font(), text.size_px, text.weight)
    return int(box[0]) + int(box[2])


def draw_text(image: Image, text: Text, at: tuple[float, float], align: float = 0.0) -> None:
    """Write a line whose baseline begins (``align`` 0), has its middle (0.5) or ends (1) at ``at``, (x, y) pixels."""
    import cv2  # noqa: PLC0415

    x = round(at[0] - align * text_width(text))
    cv2.putText(image, text.words, (x, round(at[1])), text.color, _font(), text.size_px, text.weight)


def draw_tag(image: Image, text: Text, at: tuple[float, float], align: float = 0.0) -> None:
    """Like :func:`draw_text` on a plate, pale under dark letters and dark under pale ones: readable on anything."""
    width, x = text_width(text), at[0] - align * text_width(text)
    top, bottom = max(0, round(at[1] - 0.95 * text.size_px)), max(0, round(at[1] + 0.3 * text.size_px))
    plate = image[top:bottom, max(0, round(x) - 3) : max(0, round(x) + width + 4)]
    shade = 255 if sum(text.color) < 384 else 20
    plate[:] = (0.2 * plate + 0.8 * shade).astype(np.uint8)
    draw_text(image, text, (x, at[1]))


def draw_segments(image: Image, segments: Float, color: Color, width_px: int = 2) -> None:
    """Draw straight lines, (N, 2, 2) pixels: end, (x, y)."""
    import cv2  # noqa: PLC0415

    ends = np.round(np.asarray(segments) * 2**_SHIFT).astype(np.int32)
    cv2.polylines(
        image, list(ends), isClosed=False, color=color, thickness=width_px, lineType=cv2.LINE_AA, shift=_SHIFT
    )


def draw_arrow(image: Image, ends: Float, color: Color, width_px: int = 3) -> None:
    """Draw an arrow from ``ends[0]`` to ``ends[1]``, (2, 2) pixels."""
    import cv2  # noqa: PLC0415

    tail, tip = np.round(np.asarray(ends) * 2**_SHIFT).astype(int).tolist()
    length = max(1.0, float(np.linalg.norm(np.subtract(*np.asarray(ends)))))
    cv2.arrowedLine(image, tail, tip, color, width_px, cv2.LINE_AA, _SHIFT, min(0.5, 14.0 / length))


def draw_dots(image: Image, points: Float, color: Color, radius_px: float = 5.0) -> None:
    """Draw filled circles with a white rim at points (N, 2) in pixels."""
    import cv2  # noqa: PLC0415

    for x, y in np.round(np.asarray(points) * 2**_SHIFT).astype(int).tolist():
        for radius, shade in ((radius_px + 1.5, PAPER), (radius_px, color)):
            cv2.circle(image, (x, y), round(radius * 2**_SHIFT), shade, -1, cv2.LINE_AA, _SHIFT)


def draw_legend(image: Image, entries: Sequence[tuple[str, Color]], at: tuple[int, int]) -> None:
    """A row of coloured squares with their names, from ``at`` (x, baseline) to the right; wraps at the right edge."""
    x, y = at
    for name, color in entries:
        text = Text(name, 16)
        width = text_width(text) + 44
        if x + width > image.shape[1] and x > at[0]:
            x, y = at[0], y + 24
        image[y - 13 : y + 2, x : x + 18] = color
        draw_text(image, text, (x + 25, y))
        x += width


def legend_height(entries: Sequence[tuple[str, Color]], width_px: int) -> int:
    """Pixels that :func:`draw_legend` needs in a picture of this width, from a left margin of 14."""
    x, rows = 14, 1
    for name, _ in entries:
        width = text_width(Text(name, 16)) + 44
        if x + width > width_px and x > 14:
            x, rows = 14, rows + 1
        x += width
    return 24 * rows + 12 if entries else 0


def tiled(panels: Sequence[Sequence[Image]], gap_px: int = 6) -> Image:
    """One picture of rows of panels; all panels of one size."""
    height, width = panels[0][0].shape[:2]
    columns = max(len(row) for row in panels)
    sheet = blank(columns * (width + gap_px) - gap_px, len(panels) * (height + gap_px) - gap_px, (225, 225, 225))
    for i, row in enumerate(panels):
        for j, panel in enumerate(row):
            y, x = i * (height + gap_px), j * (width + gap_px)
            sheet[y : y + height, x : x + width] = panel
    return sheet


def color_bar(colors: NDArray[np.uint8], labels: Sequence[str], width_px: int) -> Image:
    """A horizontal bar of colours (K, 3) with words spread evenly from its left to its right end."""
    bar = blank(width_px, 52)
    left, right = 40, width_px - 40
    columns = np.linspace(0, len(colors) - 1, right - left).round().astype(int)
    bar[6:26, left:right] = colors[columns]
    for i, label in enumerate(labels):
        draw_text(bar, Text(label, 16), (left + (right - left) * i / (len(labels) - 1), 45), 0.5)
    return bar


def png(image: Image) -> bytes:
    """PNG bytes of a picture, without metadata.

    Raises
    ------
    ValueError
        When the array is not (H, W, 3) uint8, or the encoder refuses it.
    """
    import cv2  # noqa: PLC0415

    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"expected a picture (H, W, 3) of uint8, got {image.shape} of {image.dtype}")
    done, data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])
    if not done:
        raise ValueError("the picture cannot be written as PNG")
    return data.tobytes()
