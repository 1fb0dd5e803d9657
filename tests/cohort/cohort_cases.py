"""A cohort of phantoms of which some are broken: which case is which, and their folders."""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tests.cohort.breakages import BREAKAGES, Breakage
from tests.cohort.phantoms import case_id, phantom_cases


@dataclass(frozen=True)
class CohortCases:
    """How many cases, and how many of them are broken, each in its own way, spread over the whole."""

    count: int
    broken: int

    def __post_init__(self) -> None:
        if not 0 <= self.broken <= min(self.count, len(BREAKAGES)):
            raise ValueError(f"broken: expected 0 to {min(self.count, len(BREAKAGES))}, got {self.broken}")

    @property
    def ids(self) -> tuple[str, ...]:
        """Of all cases, sorted."""
        return tuple(case_id(index) for index in range(self.count))

    @property
    def breakages(self) -> Mapping[str, Breakage]:
        """ID -> what is wrong with it."""
        places = (int((number + 0.5) * self.count / self.broken) for number in range(self.broken))
        return {case_id(index): BREAKAGES[number] for number, index in enumerate(places)}

    def write(self, folder: Path, processes: int = 2) -> None:
        """Write every case folder that is not there yet; equal cohorts give equal bytes."""
        names = range(self.count)
        if processes == 1:
            for index in names:
                self._write(folder, index)
            return
        with multiprocessing.get_context("spawn").Pool(processes) as pool:
            pool.map(partial(self._write, folder), names, chunksize=1)

    def _write(self, folder: Path, index: int) -> None:
        name = case_id(index)
        if (folder / name).exists():
            return
        if broken := self.breakages.get(name):
            broken.write(folder / name)
        else:
            next(one for one in phantom_cases(self.count) if one.case_id == name).write(folder)
