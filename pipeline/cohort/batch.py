"""One batch: its cases one after the other, each in a process of its own.

A case that is refused, or that breaks its own process, is a result. A fault of the machine is none: the batch then ends
with exit code 30, and whoever started it tries it again; cases that have a result are found in the cache.
"""

from __future__ import annotations

import csv
import io
import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from pipeline.cohort.batches import BatchCase, load_batch, load_plan
from pipeline.cohort.case_process import CaseWork, run_case
from pipeline.cohort.ledger import Ledger, event_key
from pipeline.cohort.model import CaseEnd, ListedCase, Plan
from pipeline.cohort.place import CohortPlace
from pipeline.engine.lock import hold
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import make_folder, replace_file, sweep
from pipeline.errors import EnvironmentFault

#: So many cases in a row that end in the same fault of the machine stop the batch: the next would fare no better.
SAME_FAULTS = 3
#: Twice what the largest case we measured leaves (docs/scale.md); with less free space no case is begun.
NEEDED_BYTES = 500_000_000
#: Pause before the second and the third attempt of a batch.
BACK_OFF_S = (10.0, 60.0)


@dataclass(frozen=True)
class Batch:
    """What a batch works with; ``attempt`` counts from 1."""

    place: CohortPlace
    name: str
    program: Sequence[str]
    attempt: int = 1
    wait: Callable[[float], None] = time.sleep


def run_batch(batch: Batch) -> tuple[CaseEnd, ...]:
    """Bring every case of a batch to a result.

    A second run of the same batch waits until the first has ended.

    Raises
    ------
    ConfigError
        When there is no such batch.
    EnvironmentFault
        When cases ended in a fault of the machine, after all others have a result; at once after three in a row, or
        when the disk is nearly full.
    """
    plan, cases = load_plan(batch.place), load_batch(batch.place, batch.name)
    if batch.attempt > 1:
        batch.wait(BACK_OFF_S[min(batch.attempt, len(BACK_OFF_S) + 1) - 2])
    with storage("Beginning the batch"):
        make_folder(batch.place.ledger(batch.name).parent)
        make_folder(batch.place.done(batch.name).parent)
    done = batch.place.done(batch.name)
    with hold(batch.place.batch_lock(batch.name), wait=True):
        sweep(done.parent, done.name)
        ends = _run_all(batch, plan, cases)
        faults = [end for end in ends if end.transient]
        if faults:
            raise _unfinished(faults)
        if load_batch(batch.place, batch.name) != cases:  # this one outlived its engine, and a new plan was made
            problem = f"The list of {batch.name} changed while it was at work."
            raise EnvironmentFault("E-BAT-03", problem, "Nothing is to be done: the batch is tried again.")
        replace_file(done, _rows(ends))
    return tuple(ends)


def run_listed(case: ListedCase, work: CaseWork, ledger: Ledger, key: str) -> CaseEnd:
    """Run one case to its end or limit; the ledger tells when it began and how it ended.

    Raises
    ------
    KeyboardInterrupt
        After its process has been stopped.
    """
    ledger.started(case.case_id, key)
    end = run_case(case, work)
    ledger.ended(end, key)
    return end


def refuse_full_disk(place: CohortPlace) -> None:
    """Nothing is begun that would end half-way.

    Raises
    ------
    EnvironmentFault
        E-BAT-01.
    """
    with storage("Looking at the results disk"):
        free = shutil.disk_usage(place.results).free
    if free < NEEDED_BYTES:
        problem = f"The results disk has {free / 1e6:.0f} MB left, less than the {NEEDED_BYTES / 1e6:.0f} MB of a case."
        raise EnvironmentFault("E-BAT-01", problem, "Free space and give the same command again; nothing is lost.")


def _run_all(batch: Batch, plan: Plan, cases: Iterable[BatchCase]) -> list[CaseEnd]:
    work = CaseWork(batch.place.results, plan.request, batch.program)
    ledger = Ledger(batch.place.ledger(batch.name), batch.attempt)
    ends: list[CaseEnd] = []
    for one in cases:
        refuse_full_disk(batch.place)
        ends.append(run_listed(one.case, work, ledger, event_key(plan.key, one.signature, one.tries)))
        if _systemic(ends):
            raise _unfinished([end for end in ends if end.transient])
    return ends


def _systemic(ends: Sequence[CaseEnd]) -> bool:
    last = ends[-SAME_FAULTS:]
    return len(last) == SAME_FAULTS and all(end.transient for end in last) and len({end.code for end in last}) == 1


def _unfinished(faults: Sequence[CaseEnd]) -> EnvironmentFault:
    first = faults[0]
    ids = ", ".join(end.case_id for end in faults[:5]) + (" ..." if len(faults) > 5 else "")
    return EnvironmentFault("E-BAT-02", f"No result yet of {ids}: {first.code}  {first.problem}", first.action)


def _rows(ends: Iterable[CaseEnd]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("id", "word", "code"))
    writer.writerows((end.case_id, end.word, end.code) for end in ends)
    return text.getvalue().encode()
