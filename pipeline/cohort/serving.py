"""What a watched folder does with a case that is complete: run it, and bring the overview up to date."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress

from pipeline.cohort.batch import run_listed
from pipeline.cohort.case_process import CaseWork
from pipeline.cohort.ledger import Ledger
from pipeline.cohort.model import CaseEnd, ListedCase
from pipeline.cohort.place import CohortPlace
from pipeline.commands.cohort_index import Places, write_overview
from pipeline.engine.stage import Stage
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import make_folder
from pipeline.errors import PipelineError

#: Stands for the key of a plan: there is no list of what may arrive.
_KEY = "watch"


def server(work: CaseWork, flow: Sequence[Stage]) -> Callable[[ListedCase], CaseEnd]:
    """Runs one case with its limits and its ledger.

    The function that is returned raises EnvironmentFault when its ledger cannot be kept. An overview that cannot be
    written is left for the next case: it is of less worth than the result.
    """
    place = CohortPlace(work.results)

    def run(case: ListedCase) -> CaseEnd:
        ledger = place.ledger(case.case_id)
        with storage("Beginning a case"):
            make_folder(ledger.parent)
            end = run_listed(case, work, Ledger(ledger), _KEY)
        with suppress(PipelineError):
            write_overview(Places(place.results, place.results / "index.html"), flow)
        return end

    return run
