"""How true the program is: figures against closed forms, the paper's test objects and published data.

``make validate`` prints one table. A row is a function without arguments that returns a :class:`Row`; to add one, write
it in a module of this package and list it in ``ROWS`` of ``__main__``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class Row(NamedTuple):
    """One line of the table: its key in the JSON, what was measured, in which unit, and the most it may be."""

    key: str
    name: str
    value: float
    unit: str
    target: float

    @property
    def met(self) -> bool:
        """Whether the value is a number within the target."""
        return self.value <= self.target


Measurement = Callable[[], Row]
