"""What a watched folder does with a case that is complete: run it, and bring the overview up to date."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from pipeline.cohort.batch import run_listed
from pipeline.cohort.case_process import CaseWork
from pipeline.cohort.ledger import Ledger
from pipeline.cohort.model import CaseEnd, ListedCase
from pipeline.cohort.place import CohortPlace
from pipeline.cohort.summary import bring_up_to_date
from pipeline.commands.cohort_index import Places, write_overview
from pipeline.engine.stage import Stage
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import make_folder
from pipeline.errors import PipelineError

#: Where there are thousands of cases the overview takes seconds: no more than this share of the time goes into it.
SHARE = 20

#: Stands for the key of a plan: there is no list of what may arrive.
_KEY = "watch"


def server(work: CaseWork, flow: Sequence[Stage]) -> Callable[[ListedCase], CaseEnd]:
    """Runs one case with its limits and its ledger.

    The function that is returned raises EnvironmentFault when its ledger cannot be kept. An overview that cannot be
    written is left for the next case: it is of less worth than the result.
    """
    place, overview = CohortPlace(work.results), _Overview(CohortPlace(work.results), flow)

    def run(case: ListedCase) -> CaseEnd:
        ledger = place.ledger(case.case_id)
        with storage("Beginning a case"):
            make_folder(ledger.parent)
            end = run_listed(case, work, Ledger(ledger), _KEY)
        overview.refresh()
        return end

    return run


@dataclass
class _Overview:
    place: CohortPlace
    flow: Sequence[Stage]
    not_before: float = float("-inf")

    def refresh(self) -> None:
        """Bring the page up to date, but not all the time."""
        begun = time.monotonic()
        if begun < self.not_before:
            return
        with suppress(PipelineError):
            if bring_up_to_date(self.place, self.flow) is None:
                write_overview(Places(self.place.results, self.place.results / "index.html"), self.flow)
        now = time.monotonic()
        self.not_before = now + SHARE * (now - begun)
