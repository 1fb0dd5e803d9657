"""Pictures of a report made small: one strip of square panels for each case, as JPEG. OpenCV is imported inside."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.adapters.pictures import BOLD, GREY, PAPER, Image, Text, blank, draw_text

#: Height and width of one panel of a strip, and the space between two, pixels.
PANEL_PX = 96
GAP_PX = 4
#: 85 halves the bytes of 95 and shows no blocks at this size.
JPEG_QUALITY = 85
#: Colour between the panels of a contact sheet, and rows that are looked at to find it.
_SHEET_GAP = np.array((225, 225, 225), np.uint8)
_LOOKED_AT = slice(30, 130)
#: Below this a panel is no panel; also keeps a picture of another make from giving slivers.
_LEAST_PX = 64


def strip_jpeg(panels: Sequence[Image | None]) -> bytes:
    """JPEG of square panels side by side; a plate that says so stands for one that is missing.

    Raises
    ------
    ValueError
        When the encoder refuses it.
    """
    import cv2  # noqa: PLC0415 - a page with nothing new draws nothing

    strip = blank(len(panels) * (PANEL_PX + GAP_PX) - GAP_PX, PANEL_PX)
    for index, panel in enumerate(panels):
        x = index * (PANEL_PX + GAP_PX)
        strip[:, x : x + PANEL_PX] = _plate() if panel is None else _fitted(panel)
    done, data = cv2.imencode(".jpg", strip[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError("the thumbnails cannot be written as JPEG")
    return data.tobytes()


def panel_of_sheet(png: bytes, top_px: int, place: tuple[int, int]) -> Image | None:
    """One square panel of a contact sheet; the whole sheet where it has no panels, None where it is no picture.

    Parameters
    ----------
    png : bytes
    top_px : int
        Height of the heading above the panels.
    place : (row, column)
        Of the panel; the last one there is where the sheet has fewer.
    """
    import cv2  # noqa: PLC0415 - see above

    found = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR) if png else None
    if found is None:
        return None
    sheet = np.asarray(found[..., ::-1], np.uint8)
    body = sheet[top_px:]
    gaps = np.flatnonzero((body[_LOOKED_AT] == _SHEET_GAP).all(axis=(0, 2)))
    size = int(gaps[0]) if len(gaps) else 0
    if size < _LEAST_PX or len(body) < size:
        return sheet
    step = size + int(np.argmin(np.diff(gaps, append=len(sheet[0])) == 1)) + 1
    row, column = (min(at, (length - size) // step) for at, length in zip(place, body.shape[:2], strict=True))
    return body[row * step : row * step + size, column * step : column * step + size]


def _fitted(panel: Image) -> Image:
    """The whole panel in a square of paper."""
    import cv2  # noqa: PLC0415 - see above

    height, width = panel.shape[:2]
    scale = PANEL_PX / max(height, width)
    size = max(1, round(scale * width)), max(1, round(scale * height))
    small = np.asarray(cv2.resize(np.ascontiguousarray(panel), size, interpolation=cv2.INTER_AREA), np.uint8)
    square = blank(PANEL_PX, PANEL_PX, PAPER)
    x, y = (PANEL_PX - size[0]) // 2, (PANEL_PX - size[1]) // 2
    square[y : y + size[1], x : x + size[0]] = small
    return square


def _plate() -> Image:
    plate = blank(PANEL_PX, PANEL_PX, (240, 240, 240))
    draw_text(plate, Text("no picture", 13, BOLD, GREY), (PANEL_PX / 2, PANEL_PX / 2 + 5), 0.5)
    return plate
