"""From what a person asked for to a cohort at work: list, plan, engine, progress, summary."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.cohort.batches import PlanInputs, bucket_count, default_batch_size, load_plan, write_plan
from pipeline.cohort.case_list import listed_cases
from pipeline.cohort.case_process import program as own_program
from pipeline.cohort.driver import find_engine, is_driven, run_engine, wait_for_driver
from pipeline.cohort.key import plan_key
from pipeline.cohort.model import CohortRequest, ListedCase, Plan
from pipeline.cohort.place import CohortPlace
from pipeline.cohort.progress import Reporter
from pipeline.cohort.summary import Summary, failed_ids, write_summary
from pipeline.engine.records import record_artifact
from pipeline.engine.stage import Stage
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import make_folder, read_file, replace_file
from pipeline.errors import ConfigError, EnvironmentFault

#: How often the engine tries a batch again that ended in a fault of the machine.
RETRIES = 2
LOCAL_PROFILE = "workstation"


@dataclass(frozen=True)
class Order:
    """``order.json``: what a person asked for, so that ``ct2lut resume`` can ask for it again.

    Attributes
    ----------
    request : CohortRequest
        Its number of buckets is chosen when the plan is made.
    at_once : int
        Batches at work at the same time; 0 leaves it to the profile and the machine.
    batch_size : int
        Cases of a batch, about; 0 chooses.
    profile : str
    program : str
        Command that stands for ``ct2lut`` inside a job; empty for this one.
    """

    request: CohortRequest
    at_once: int = 0
    batch_size: int = 0
    profile: str = LOCAL_PROFILE
    program: str = ""


_ORDER = record_artifact("cohort_order", "order.json", Order)


@dataclass(frozen=True)
class Screen:
    """Where a cohort shows how it goes."""

    write: Callable[[str], None]
    terminal: bool


def run_cohort(
    order: Order, place: CohortPlace, flow: Sequence[Stage], screen: Screen, *, retry_failed: bool = False
) -> Summary:
    """Bring every case of a cohort to a result and write its summary and overview.

    Where another driver is at work on the same results, its progress is followed until it ends.

    Raises
    ------
    ConfigError
        For a wrong list, setting or profile, before anything begins.
    EnvironmentFault
        When the engine is missing or the disk fails.
    """
    engine = find_engine(order.profile, order.at_once)
    if is_driven(place):
        _follow_other(place, screen)
    plan = plan_cohort(order, place, flow, retry_failed=retry_failed)
    with _reported(place, plan, screen) as tick:
        end = run_engine(place, engine, tick)
    summary = write_summary(place, plan, flow)
    if not end.ok and summary.unfinished:
        screen.write(f"The workflow engine left cases without a result: {end.said}\n")
    if not end.ok and not summary.unfinished:
        raise EnvironmentFault("E-COH-01", f"The workflow engine failed: {end.said}", f"Read {place.engine_log.name}.")
    return summary


def plan_cohort(order: Order, place: CohortPlace, flow: Sequence[Stage], *, retry_failed: bool = False) -> Plan:
    """Read the list and lay out the batches.

    Raises
    ------
    ConfigError
    EnvironmentFault
    """
    cases = listed_cases(Path(order.request.cases))
    with storage("Opening the results folder"):
        make_folder(place.workflow)
    replace_file(place.files / _ORDER.file, _ORDER.encode(order)[""])
    request = replace(order.request, buckets=_buckets(order, place, cases))
    retry = failed_ids(place) if retry_failed else frozenset()
    words = order.program or shlex.join(own_program())
    key = plan_key(request, flow)
    return write_plan(place, PlanInputs(request, key, cases, words, request.jobs, RETRIES, retry))


def last_order(place: CohortPlace) -> Order:
    """What was asked for the last time.

    Raises
    ------
    ConfigError
        E-COH-02 where there was no cohort.
    """
    try:
        return _ORDER.decode({"": read_file(place.files / _ORDER.file)})
    except (OSError, ValueError) as error:
        problem = "No cohort was begun in this results folder, or its record cannot be read."
        raise ConfigError("E-COH-02", problem, "Begin one: ct2lut cohort --cases CASES --results RESULTS.") from error


def _buckets(order: Order, place: CohortPlace, cases: Sequence[ListedCase]) -> int:
    """As many as the last time where that still fits, so that a longer list moves no case to another batch."""
    before = 0
    with suppress(ConfigError):
        before = load_plan(place).request.buckets
    size = order.batch_size or default_batch_size(len(cases), cluster=order.profile != LOCAL_PROFILE)
    return bucket_count(len(cases), size, before)


def _follow_other(place: CohortPlace, screen: Screen) -> None:
    """Nothing is planned anew below a driver that is at work."""
    screen.write("The cohort is at work already. Its progress is shown; then this command goes on.\n")
    with _reported(place, load_plan(place), screen) as tick:
        wait_for_driver(place, tick)


@contextmanager
def _reported(place: CohortPlace, plan: Plan, screen: Screen) -> Iterator[Callable[[], None]]:
    reporter = Reporter(place, plan, screen.write, terminal=screen.terminal)
    try:
        yield reporter.tick
    finally:
        reporter.close()
