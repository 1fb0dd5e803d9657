"""The commands of many cases."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

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
) -> int:
    """Process many cases, on this machine or on a cluster.

    The same command goes on where it was stopped, however it was stopped. A case that is refused does not stop the
    others. At the end: cohort.csv and index.html in the results. The exit code is 0 when every case passed, 11 when
    some need review, 10 when some failed, 30 when the machine kept cases from a result.

    Example: ct2lut cohort --cases cases --results results --at-once 2
    """
    from pipeline.cohort.model import CaseLimits
    from pipeline.cohort.start import Order

    limits = CaseLimits(memory_mb, 60.0 * minutes)
    order = Order(
        str(cases.resolve()),
        _absolute(protocol),
        tuple(overrides or ()),
        jobs,
        limits,
        at_once,
        batch_size,
        _absolute(profile),
        program,
    )
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
def overview(
    results: Results = DEFAULT_RESULTS,
    out: Annotated[
        Path | None, typer.Option("--out", help="The page to write; index.html in the results by default.")
    ] = None,
) -> None:
    """Write one page of all cases: pictures, verdict, numbers, what is unusual.

    Only what changed since the last time is read again.

    Example: ct2lut overview --results results
    """
    from pipeline.commands.cohort_index import Places, overview_lines, write_overview

    page = out or results / "index.html"
    say(*overview_lines(write_overview(Places(results, page), shared.flow()), page))


def _absolute(name: str) -> str:
    """A name as it is, a path so that it means the same elsewhere."""
    return str(Path(name).resolve()) if "/" in name or name.endswith(".yaml") else name


def _run_cohort(order: Order, results: Path, *, retry_failed: bool) -> int:
    from pipeline.cohort.place import CohortPlace
    from pipeline.cohort.start import Screen, run_cohort
    from pipeline.cohort.summary import summary_lines

    screen = Screen(shared.write, sys.stdout.isatty())
    place = CohortPlace(results.resolve())
    summary = run_cohort(order, place, shared.flow(), screen, retry_failed=retry_failed)
    say(*summary_lines(summary))
    return summary.exit_code
