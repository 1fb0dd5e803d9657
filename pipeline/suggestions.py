"""Words for messages: what a mistyped name probably meant, names, lists and values in a sentence."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`` (did you mean 'x'?)`` for the known word nearest to a mistyped one; empty where none is near."""
    near = difflib.get_close_matches(word.lower(), list(known), n=1, cutoff=0.6)
    return f" (did you mean {near[0]!r}?)" if near else ""


def plain(name: str) -> str:
    """A name of ours in words."""
    return name.replace("_", " ")


def listed(words: Iterable[str]) -> str:
    """Words separated by commas, or ``none``."""
    return ", ".join(words) or "none"


def shown(value: object) -> str:
    """A value as a message shows it: JSON, on one line, printable, at most 60 characters."""
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else f"{text[:57]}..."
