"""What one check of the machine answers."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    """How a check ended: nothing to do, worth a look, or a run cannot be trusted to end well."""

    OK = "ok"
    LOOK = "LOOK"
    FAIL = "FAIL"


@dataclass(frozen=True)
class Answer:
    """What was found.

    Attributes
    ----------
    found : str
        Numbers with units; no path but what the user typed.
    state : State
    action : str
        What to do, with the command to type; empty where there is nothing to do.
    """

    found: str
    state: State = State.OK
    action: str = ""
