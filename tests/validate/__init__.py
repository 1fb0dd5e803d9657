"""How true the program is: figures against closed forms, the paper's test objects and published data.

``make validate`` prints every figure and writes them to ``build/validate.json``. A measurement is a function without
arguments that yields rows, each with a target or without, and tables; to add one, write it in a module of this package
and list it in ``MEASUREMENTS`` of ``__main__``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple


class Row(NamedTuple):
    """One figure: its short name in the file, what was measured, in which unit, and the most it may be."""

    key: str
    name: str
    value: float
    unit: str
    target: float | None = None

    @property
    def met(self) -> bool:
        """Whether the value is a number within the target."""
        return self.target is None or self.value <= self.target


class Table(NamedTuple):
    """Several figures of one kind; ``rows`` maps the name of each row to a value for each column."""

    key: str
    title: str
    columns: Sequence[str]
    rows: Mapping[str, Sequence[float]]


Measurement = Callable[[], Iterable[Row | Table]]
