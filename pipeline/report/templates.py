"""How pages are filled: every text from a case is escaped, and a name that is not given is an error."""

from __future__ import annotations

from importlib import resources
from typing import TYPE_CHECKING

import numpy as np

from pipeline.suggestions import plain

if TYPE_CHECKING:
    from jinja2 import Environment

#: Smaller numbers are rounding to a reader.
SMALLEST = 1e-4


def environment() -> Environment:
    """Templates of this package, with the filters ``plain`` and ``number``."""
    import jinja2  # noqa: PLC0415  - a cached run does not need it

    made = jinja2.Environment(
        loader=jinja2.FunctionLoader(resource), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    made.filters["plain"] = plain
    made.filters["number"] = number
    return made


def resource(name: str) -> str:
    """Text of a file of this package: a template, a style or a script."""
    return resources.files("pipeline.report").joinpath(name).read_text(encoding="utf-8")


#: Nothing of a joint is known more finely; rounding errors of 1e-16 would look like results.
SMALLEST = 1e-4


def number(value: float, digits: int | None = None) -> str:
    """A number for people: ``digits`` decimals, or three significant ones; a dash for what is not known."""
    if not np.isfinite(value):
        return "–"
    if digits is None and 0.0 < abs(value) < SMALLEST:
        return f"< {SMALLEST:.4f}"
    if digits is None and 0.0 < abs(value) < SMALLEST:
        return f"< {SMALLEST:.4f}"
    text = f"{value:.{digits}f}" if digits is not None else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return "0" + text[2:] if text.startswith("-0") and not float(text) else text
