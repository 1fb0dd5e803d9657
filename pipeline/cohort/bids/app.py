"""``ct2lut IN OUT participant`` and ``ct2lut IN OUT group``: cases of a BIDS dataset, without the workflow engine."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from pipeline.cohort.batch import refuse_full_disk, run_listed
from pipeline.cohort.batches import PlanInputs, source_signature, write_plan
from pipeline.cohort.bids.call import BidsCall
from pipeline.cohort.bids.layout import BidsCase, bids_cases
from pipeline.cohort.bids.prepare import CASES_FOLDER, prepare_case, write_dataset_files
from pipeline.cohort.case_process import CaseWork
from pipeline.cohort.ledger import Ledger, event_key
from pipeline.cohort.model import CaseEnd, CaseLimits, CohortRequest, ListedCase
from pipeline.cohort.place import CohortPlace
from pipeline.cohort.progress import Progress, ended_line
from pipeline.cohort.summary import Summary, worst, write_summary
from pipeline.engine.outcome import CaseJob
from pipeline.engine.runner import record_refusal
from pipeline.engine.stage import Stage
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import make_folder
from pipeline.errors import CaseRejected, ExitCode

#: Stands for the key of a plan: participants are run one by one, without a plan.
_KEY = "bids"

Say = Callable[[str], None]


def run_participants(call: BidsCall, program: Sequence[str], flow: Sequence[Stage], say: Say) -> ExitCode:
    """Run the cases of a call one after the other; the worst of their ends as an exit code.

    Calls for other participants may be at work on the same output folder.

    Raises
    ------
    ConfigError
        For labels that the dataset does not have, before any case is begun.
    EnvironmentFault
        When the disk fails.
    """
    cases = bids_cases(call)
    write_dataset_files(call.out)
    place = CohortPlace(call.out.resolve())
    with storage("Preparing the output folder"):
        make_folder(place.ledger("any").parent)
    work = CaseWork(place.results, _request(call), tuple(program))
    ends = []
    for number, case in enumerate(cases, 1):
        refuse_full_disk(place)
        ends.append(_run(case, work, place, flow))
        say(ended_line(ends[-1], Progress(len(cases), number)))
    return worst((end.word for end in ends), unfinished=any(end.transient for end in ends))


def summarise_group(call: BidsCall, flow: Sequence[Stage]) -> Summary:
    """Write the summary and the overview of all cases of a dataset, as far as they have got.

    Raises
    ------
    ConfigError, EnvironmentFault
    """
    write_dataset_files(call.out)
    place = CohortPlace(call.out.resolve())
    cases = tuple(_listed(case, place) for case in bids_cases(call))
    return write_summary(place, write_plan(place, PlanInputs(_request(call), _KEY, cases, "ct2lut")), flow)


def _request(call: BidsCall) -> CohortRequest:
    limits = CaseLimits(call.memory_mb, 60.0 * call.time_limit_min)
    return CohortRequest(str(call.dataset.resolve()), call.protocol, call.overrides, call.jobs, limits)


def _listed(case: BidsCase, place: CohortPlace) -> ListedCase:
    return ListedCase(case.case_id, place.results / CASES_FOLDER / case.case_id)


def _run(case: BidsCase, work: CaseWork, place: CohortPlace, flow: Sequence[Stage]) -> CaseEnd:
    """One case; one that cannot be prepared is refused, and that is its result."""
    try:
        listed = prepare_case(case, place.results)
    except CaseRejected as error:
        job = CaseJob(case.case_id, _listed(case, place).folder, place.results / case.case_id)
        record_refusal(job, flow, error)
        return CaseEnd(case.case_id, "REJECTED", error.code, error.problem, error.action)
    key = event_key(_KEY, source_signature(listed.folder), 1)
    return run_listed(listed, work, Ledger(place.ledger(case.case_id)), key)
