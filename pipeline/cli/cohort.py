"""The commands of many cases."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipeline import __version__
from pipeline.case_id import check_case_id
from pipeline.cli import shared
from pipeline.cli.shared import DEFAULT_CASES, DEFAULT_PROTOCOL, DEFAULT_RESULTS, Overrides, Protocol, Results, app, say
from pipeline.errors import ExitCode

if TYPE_CHECKING:
    from pipeline.cohort.start import Order

Cohort = Annotated[
    Path, typer.Option("--cases", help="Folder with one folder a case, or a list of cases (.csv); never written to.")
]
CaseJobs = Annotated[int, typer.Option("--jobs", min=1, help="Processes of one case.")]
Memory = Annotated[int, typer.Option("--memory-mb", min=0, help="Memory a case may use; 0 means no limit.")]
Minutes = Annotated[float, typer.Option("--time-limit-min", min=0, help="Minutes a case may take; 0 means no limit.")]

#: A case takes a minute or two; one that needs this long hangs.
DEFAULT_MINUTES = 120.0


@app.command()
def cohort(
    cases: Cohort = DEFAULT_CASES,
    results: Results = DEFAULT_RESULTS,
    protocol: Protocol = DEFAULT_PROTOCOL,
    overrides: Overrides = None,
    jobs: CaseJobs = 1,
    memory_mb: Memory = 0,
    minutes: Minutes = DEFAULT_MINUTES,
    at_once: Annotated[
        int, typer.Option("--at-once", min=0, help="Batches at the same time; 0 means as many as the machine bears.")
    ] = 0,
    batch_size: Annotated[int, typer.Option("--batch-size", min=0, help="Cases of a batch; 0 chooses.")] = 0,
    profile: Annotated[
        str, typer.Option("--profile", help="workstation, slurm, generic, kubernetes, or a folder of your own.")
    ] = "workstation",
    program: Annotated[
        str, typer.Option("--program", help="What a job types for ct2lut, such as 'apptainer exec ct2lut.sif ct2lut'.")
    ] = "",
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Try cases again that have failed.")] = False,
    plan_only: Annotated[bool, typer.Option("--plan-only", help="Lay out the batches for another engine.")] = False,
) -> int:
    """Process many cases, on this machine or on a cluster.

    The same command goes on where it was stopped, however it was stopped. A case that is refused does not stop the
    others. At the end: cohort.csv and index.html in the results. The exit code is 0 when every case passed, 11 when
    some need review, 10 when some failed, 30 when the machine kept cases from a result.

    Example: ct2lut cohort --cases cases --results results --at-once 2
    """
    from pipeline.cohort.model import CaseLimits, CohortRequest
    from pipeline.cohort.start import Order

    limits = CaseLimits(memory_mb, 60.0 * minutes)
    request = CohortRequest(str(cases.resolve()), _absolute(protocol), tuple(overrides or ()), jobs, limits)
    order = Order(request, at_once, batch_size, _absolute(profile), program)
    if plan_only:
        return _plan_cohort(order, results, retry_failed=retry_failed)
    return _run_cohort(order, results, retry_failed=retry_failed)


@app.command()
def resume(
    results: Results = DEFAULT_RESULTS,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Try cases again that have failed.")] = False,
) -> int:
    """Go on with the last cohort of a results folder, as it was asked for.

    Example: ct2lut resume --results results
    """
    from pipeline.cohort.place import CohortPlace
    from pipeline.cohort.start import last_order

    return _run_cohort(last_order(CohortPlace(results.resolve())), results, retry_failed=retry_failed)


@app.command()
def watch(
    cases: Annotated[Path, typer.Option("--cases", help="Folder into which cases are copied.")] = DEFAULT_CASES,
    results: Results = DEFAULT_RESULTS,
    protocol: Protocol = DEFAULT_PROTOCOL,
    overrides: Overrides = None,
    jobs: CaseJobs = 1,
    memory_mb: Memory = 0,
    minutes: Minutes = DEFAULT_MINUTES,
    settle: Annotated[
        float, typer.Option("--settle", help="Seconds without a change that make a case complete.")
    ] = 60.0,
    every: Annotated[float, typer.Option("--every", help="Seconds between two looks.")] = 5.0,
    marker: Annotated[str, typer.Option("--marker", help="File in a case folder that says it is complete.")] = "",
) -> None:
    """Process cases as they arrive in a folder, one after the other, until stopped.

    A case is run when it is complete, and again when it has changed. The overview is kept up to date.

    Example: ct2lut watch --cases inbox --results results --marker complete
    """
    from pipeline.cohort.case_process import CaseWork, program
    from pipeline.cohort.model import CaseLimits, CohortRequest
    from pipeline.cohort.place import CohortPlace
    from pipeline.cohort.watching.inbox import Watch
    from pipeline.cohort.watching.serving import server
    from pipeline.cohort.watching.watch import watch as watch_folder

    limits = CaseLimits(memory_mb, 60.0 * minutes)
    request = CohortRequest(str(cases.resolve()), _absolute(protocol), tuple(overrides or ()), jobs, limits)
    place = CohortPlace(results.resolve())
    run = server(CaseWork(place.results, request, program()), shared.flow())
    watch_folder(Watch(cases.resolve(), settle, every, marker), place, run, say)


@app.command()
def batch(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A batch of the cohort: a file below batches/.")],
    results: Results = DEFAULT_RESULTS,
    attempt: Annotated[int, typer.Option("--attempt", min=1, help="Which attempt this is.")] = 1,
) -> int:
    """Process one batch of a cohort; the workflow engine types this.

    The exit code is 0 when every case has a result, be it a refusal, and 30 when the machine kept one from it.

    Example: ct2lut batch bucket-0001 --results results
    """
    from pipeline.cohort.batch import Batch, run_batch
    from pipeline.cohort.case_process import program
    from pipeline.cohort.place import CohortPlace

    ends = run_batch(Batch(CohortPlace(results.resolve()), name, program(), attempt))
    say(*(f"{end.case_id}  {end.word}  {end.seconds:.1f} s  {end.code}".rstrip() for end in ends))
    return ExitCode.PASS


@app.command(name="cohort-summary")
def cohort_summary(results: Results = DEFAULT_RESULTS) -> int:
    """Write cohort.csv and the overview of a cohort as it stands.

    Example: ct2lut cohort-summary --results results
    """
    from pipeline.cohort.batches import load_plan
    from pipeline.cohort.place import CohortPlace
    from pipeline.cohort.summary import summary_lines, write_summary

    place = CohortPlace(results.resolve())
    say(*summary_lines(write_summary(place, load_plan(place), shared.flow())))
    return ExitCode.PASS


@app.command()
def verify(
    case_id: Annotated[str | None, typer.Argument(metavar="[ID]", help="One case; without it, all of them.")] = None,
    results: Results = DEFAULT_RESULTS,
    repair: Annotated[
        bool, typer.Option("--repair", help="Set damaged results aside, so that the next run makes them again.")
    ] = False,
) -> int:
    """Compare results with their checksums.

    The exit code is 30 where something is not as it was written, and 0 after a repair.

    Example: ct2lut verify P001 --repair
    """
    from pipeline.commands.repair import case_folders, repair_case, verified_lines, verify_all, verify_one

    flow = shared.flow()
    if repair:
        folders = case_folders(results) if case_id is None else [results / check_case_id(case_id)]
        for folder in folders:
            say(*repair_case(folder, flow))
        return ExitCode.PASS
    damaged = False
    for found in verify_all(results, flow) if case_id is None else [verify_one(results / check_case_id(case_id), flow)]:
        say(*verified_lines(found))
        damaged = damaged or bool(found.problems)
    return ExitCode.ENVIRONMENT if damaged else ExitCode.PASS


@app.command()
def clean(
    results: Results = DEFAULT_RESULTS,
    days: Annotated[float, typer.Option("--older-than-days", help="Age by the clock of the results disk.")] = 7.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would go.")] = False,
) -> int:
    """Remove what killed runs left behind and damaged results that were set aside; never a result.

    Example: ct2lut clean --results results --dry-run
    """
    from pipeline.cohort.cleaning import clean as clean_results
    from pipeline.cohort.cleaning import cleaned_lines

    done = clean_results(results, days, dry_run=dry_run)
    say(*cleaned_lines(done))
    return ExitCode.ENVIRONMENT if done.refused else ExitCode.PASS


@app.command()
def overview(
    results: Results = DEFAULT_RESULTS,
    out: Annotated[
        Path | None, typer.Option("--out", help="The page to write; index.html in the results by default.")
    ] = None,
) -> None:
    """Write one page of all cases: pictures, verdict, numbers, what is unusual.

    Only what changed since the last time is read again. After a cohort its table, cohort.csv, is written too.

    Example: ct2lut overview --results results
    """
    from pipeline.cohort.place import CohortPlace
    from pipeline.cohort.summary import bring_up_to_date, summary_lines
    from pipeline.commands.cohort_index import Places, overview_lines, write_overview

    if out is None and (summary := bring_up_to_date(CohortPlace(results), shared.flow())):
        say(*summary_lines(summary))
        return
    page = out or results / "index.html"
    say(*overview_lines(write_overview(Places(results, page), shared.flow()), page))


def _absolute(name: str) -> str:
    """A name as it is, a path so that it means the same elsewhere."""
    return str(Path(name).resolve()) if "/" in name or name.endswith(".yaml") else name


def _plan_cohort(order: Order, results: Path, *, retry_failed: bool) -> int:
    from pipeline.cohort.place import CohortPlace
    from pipeline.cohort.start import plan_cohort

    place = CohortPlace(results.resolve())
    plan = plan_cohort(order, place, shared.flow(), retry_failed=retry_failed)
    cases = sum(map(len, plan.batches.values()))
    say(f"{cases} cases in {len(plan.batches)} batches", f"lists: {place.case_list('any').parent}")
    return ExitCode.PASS


def _run_cohort(order: Order, results: Path, *, retry_failed: bool) -> int:
    from pipeline.cohort.place import CohortPlace
    from pipeline.cohort.start import Screen, run_cohort
    from pipeline.cohort.summary import summary_lines

    screen = Screen(shared.write, sys.stdout.isatty())
    place = CohortPlace(results.resolve())
    summary = run_cohort(order, place, shared.flow(), screen, retry_failed=retry_failed)
    say(*summary_lines(summary))
    return summary.exit_code


def run_bids_app(arguments: Sequence[str]) -> int:
    """The call of a BIDS-App: ``IN OUT participant|group``."""
    from pipeline.cohort.bids.app import run_participants, summarise_group
    from pipeline.cohort.bids.call import bids_help, parse_bids_call
    from pipeline.cohort.case_process import program
    from pipeline.cohort.summary import summary_lines

    call = parse_bids_call(arguments)
    say(*call.notes)
    if call.show:
        say(f"ct2lut {__version__}" if call.show == "version" else bids_help())
        return ExitCode.PASS
    if call.level == "participant":
        return run_participants(call, program(), shared.flow(), say)
    summary = summarise_group(call, shared.flow())
    say(*summary_lines(summary))
    return summary.exit_code
