"""What several tests of pictures look at."""

from __future__ import annotations

import pytest

from pipeline.adapters import pictures
from pipeline.adapters.pictures import Image, Text


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Every line of text that is drawn."""
    lines: list[str] = []
    draw = pictures.draw_text

    def remember(image: Image, text: Text, at: tuple[float, float], align: float = 0.0) -> None:
        lines.append(text.words)
        draw(image, text, at, align)

    monkeypatch.setattr(pictures, "draw_text", remember)
    return lines
