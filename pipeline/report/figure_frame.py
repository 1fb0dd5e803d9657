"""What every picture carries: case, side, what it shows, orientation marks, legend, and what it is not for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.adapters import pictures
from pipeline.adapters.pictures import BOLD, Color, Image, Text
from pipeline.geometry.views import View
from pipeline.records import CaseFacts

RESEARCH_USE = "Research use - not for diagnosis"
MARGIN_PX = 14
HEADER_PX = 64
FOOTER_PX = 30

Legend = Sequence[tuple[str, Color]]


def side_words(facts: CaseFacts) -> str:
    """Such as ``RIGHT knee (R)``."""
    return f"{facts.side.upper()} {facts.joint} ({facts.side[0].upper()})"


def heading(facts: CaseFacts) -> str:
    """Such as ``Case P001  |  RIGHT knee (R)``."""
    return f"Case {facts.case_id}  |  {side_words(facts)}"


def finished(facts: CaseFacts, title: str, body: Sequence[Image], legend: Legend = ()) -> Image:
    """A picture with heading, title, legend and footer around images that are put one below the other."""
    width = max(image.shape[1] for image in body)
    header = pictures.blank(width, HEADER_PX)
    pictures.draw_text(header, Text(heading(facts), 24, BOLD), (MARGIN_PX, 28))
    pictures.draw_text(header, Text(title, 17), (MARGIN_PX, 54))
    key = pictures.blank(width, pictures.legend_height(legend, width))
    pictures.draw_legend(key, legend, (MARGIN_PX, 24))
    footer = pictures.blank(width, FOOTER_PX)
    pictures.draw_text(footer, Text(RESEARCH_USE, 15, BOLD, pictures.GREY), (width - MARGIN_PX, 21), 1.0)
    return np.vstack([header, *(_padded(image, width) for image in body), key, footer])


def _padded(image: Image, width: int) -> Image:
    out = pictures.blank(width, image.shape[0])
    out[:, : image.shape[1]] = image
    return out


def mark_edges(panel: Image, view: View, color: Color = pictures.GREY) -> None:
    """Write at the edges of a panel what lies there."""
    height, width = panel.shape[:2]
    left, right, top, bottom = (Text(words, 13, color=color) for words in view.edges)
    pictures.draw_tag(panel, left, (5, height / 2))
    pictures.draw_tag(panel, right, (width - 5, height / 2), 1.0)
    pictures.draw_tag(panel, top, (width / 2, 40), 0.5)
    pictures.draw_tag(panel, bottom, (width / 2, height - 8), 0.5)


def title_panel(panel: Image, words: str, color: Color = pictures.INK) -> None:
    """Write the title of a panel into its top left corner."""
    pictures.draw_tag(panel, Text(words, 16, BOLD, color), (7, 20))


def words_panel(size_px: int, lines: Sequence[str]) -> Image:
    """A panel that says in words why there is nothing to see."""
    panel = pictures.blank(size_px, size_px, (245, 240, 235))
    for i, line in enumerate(lines):
        pictures.draw_text(panel, Text(line, 16), (size_px / 2, size_px / 2 + 22 * i), 0.5)
    return panel
