"""Case IDs: checked before any path is made of one."""

from __future__ import annotations

import os
import re
from pathlib import Path

from pipeline.errors import ConfigError
from pipeline.suggestions import shown

PATTERN = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", re.ASCII)

#: Names that Windows gives to devices: a folder of such a name cannot be copied there.
DEVICE_NAMES = frozenset({"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(1, 10))})


def is_case_id(text: str) -> bool:
    """Whether a text is safe as the name of a case's folder on every system."""
    return PATTERN.fullmatch(text) is not None and text.casefold() not in DEVICE_NAMES


def check_case_id(case_id: str) -> str:
    """The ID itself.

    Raises
    ------
    ConfigError
        E-ID-01 for one that is not safe.
    """
    if is_case_id(case_id):
        return case_id
    problem = f"{shown(case_id)} cannot be used as a case ID."
    action = "An ID has 1 to 64 of A-Z a-z 0-9 - _, begins with a letter or digit, and is no device name such as CON."
    raise ConfigError("E-ID-01", problem, action)


def refuse_twin(case_id: str, folder: Path) -> None:
    """P1 and p1 are one folder on many shared drives, and one of two patients would get the other's result.

    Raises
    ------
    ConfigError
        E-ID-02.
    """
    names = set(os.listdir(folder)) if folder.is_dir() else set()  # noqa: PTH208 - a cohort's folder has 100,000
    twins = sorted(name for name in names - {case_id} if name.casefold() == case_id.casefold())
    if twins:
        problem = f"The case ID {case_id} differs from the folder {twins[0]} only in upper and lower case."
        raise ConfigError("E-ID-02", problem, "Rename one of the two cases.")
