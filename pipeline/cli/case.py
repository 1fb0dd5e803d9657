"""The commands of one case."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pipeline.case_id import check_case_id, is_case_id
from pipeline.cli import shared
from pipeline.cli.shared import (
    DEFAULT_CASES,
    DEFAULT_PROTOCOL,
    DEFAULT_RESULTS,
    CaseId,
    Cases,
    Jobs,
    Overrides,
    Protocol,
    Results,
    app,
    say,
    write,
)
from pipeline.errors import CaseRejected, ConfigError, ExitCode, PipelineError

if TYPE_CHECKING:
    from pipeline.commands.doctor_answer import Answer
    from pipeline.commands.request import Request
    from pipeline.engine.stage import Stage, StrictParams


@app.command()
def run(
    case_id: CaseId,
    cases: Cases = DEFAULT_CASES,
    results: Results = DEFAULT_RESULTS,
    protocol: Protocol = DEFAULT_PROTOCOL,
    overrides: Overrides = None,
    jobs: Jobs = 0,
    folder: Annotated[
        Path | None, typer.Option("--folder", help="The folder of the case, where it is not the one below --cases.")
    ] = None,
) -> int:
    """Process one case, from its CT or label map to the packaged table.

    What is up to date is not computed again.

    Example: ct2lut run P001 --cases cases --results results --set sweep.flexion_step_deg=2
    """
    request = _request(case_id, cases, results, protocol, overrides)
    return _run(replace(request, folder=folder), jobs, shared.flow())


@app.command()
def plan(
    case_id: CaseId,
    cases: Cases = DEFAULT_CASES,
    results: Results = DEFAULT_RESULTS,
    protocol: Protocol = DEFAULT_PROTOCOL,
    overrides: Overrides = None,
) -> None:
    """Say which stages would run, and why.

    Nothing is computed and nothing is written.

    Example: ct2lut plan P001 --set smooth.degree_flexion=8
    """
    from pipeline.commands.summary import plan_lines
    from pipeline.engine.runner import plan_case

    request = _request(case_id, cases, results, protocol, overrides)
    flow = shared.flow()
    say(*plan_lines(plan_case(request.job(), flow, request.settings(flow))))


@app.command()
def check(
    case_id: CaseId,
    cases: Cases = DEFAULT_CASES,
    results: Results = DEFAULT_RESULTS,
    protocol: Protocol = DEFAULT_PROTOCOL,
    overrides: Overrides = None,
) -> int:
    """Look at a case before it is processed, in seconds.

    One line for each check: OK, LOOK (before you use it) or STOP (a run would refuse it), and what to do next. Nothing
    is written. It is a quick look: what is OK here may still need review after the run.

    Example: ct2lut check P001
    """
    from pipeline.commands.preflight import closing, exit_code, lines
    from pipeline.commands.quick_look import examine

    request = _request(case_id, cases, results, protocol, overrides)
    rows = examine(request, request.settings(shared.flow()))
    say(*(line for row in rows for line in lines(row)), *closing(case_id, rows))
    return exit_code(rows)


@app.command()
def status(
    case_id: Annotated[str | None, typer.Argument(metavar="[ID]", help="One case; without it, all of them.")] = None,
    results: Results = DEFAULT_RESULTS,
) -> None:
    """Show how far a case has got.

    With ID one line for each stage, without it one line for each case, and how far the last cohort is.

    Example: ct2lut status P001
    """
    from pipeline.cohort.place import CohortPlace
    from pipeline.cohort.progress import cohort_line
    from pipeline.commands.review import ReviewedCase, review_line
    from pipeline.commands.summary import overview_line, status_lines
    from pipeline.engine.runner import read_status

    flow = shared.flow()
    if case_id is not None:
        folder = results / check_case_id(case_id)
        say(*status_lines(read_status(folder, flow), review_line(ReviewedCase(case_id, folder, flow[-1]))))
        return
    folders = sorted(path for path in results.iterdir() if path.is_dir()) if results.is_dir() else []
    say(*(overview_line(path.name, read_status(path, flow)) for path in folders if is_case_id(path.name)))
    if not folders:
        say(f"no results in {results}")
    if line := cohort_line(CohortPlace(results)):
        say(line)


@app.command()
def report(
    case_id: CaseId,
    cases: Cases = DEFAULT_CASES,
    results: Results = DEFAULT_RESULTS,
    protocol: Protocol = DEFAULT_PROTOCOL,
    overrides: Overrides = None,
    jobs: Jobs = 0,
) -> int:
    """Bring the report up to date and say where it is.

    Only what the report needs and what is out of date is computed.

    Example: ct2lut report P001
    """
    flow = shared.flow()
    upto = next(index for index, stage in enumerate(flow, 1) if any(a.name == "report" for a in stage.writes))
    return _run(_request(case_id, cases, results, protocol, overrides), jobs, flow[:upto])


@app.command(name="open")
def open_page(case_id: CaseId, results: Results = DEFAULT_RESULTS) -> None:
    """Open the report of a case.

    Says where it is, and shows it in a browser if this machine has one. Where the last run left no page, it opens that
    of an earlier run and says so.

    Example: ct2lut open P001
    """
    from pipeline.commands.open_report import open_in_browser
    from pipeline.commands.run_report import report_page, tells_last_run
    from pipeline.commands.summary import earlier_page_lines
    from pipeline.engine.runner import read_status

    flow, folder = shared.flow(), results / check_case_id(case_id)
    page = report_page(folder, flow)
    if page is None:
        raise ConfigError("E-OPN-01", f"{case_id} has no report yet.", f"Make it first: ct2lut report {case_id}.")
    status = read_status(folder, flow)
    if not tells_last_run(page, status):
        say(*earlier_page_lines(status))
    say(f"report: {page}")
    if not open_in_browser(page):
        say("No browser here. The page needs nothing else: copy it to a computer that has one and open it there.")


@app.command()
def query(
    table: Annotated[str, typer.Argument(metavar="ID", help="A finished case, or the path of a lut.h5.")],
    flexion: Annotated[str, typer.Option("--flexion", help="Degrees; several, separated by commas, give CSV.")],
    varus: Annotated[float, typer.Option("--varus", help="Varus in degrees; negative is valgus.")] = 0.0,
    frame: Annotated[
        Literal["jcs", "scan", "femur"] | None,
        typer.Option("--frame", help="Only the six coordinates, or only one of the matrices."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object, for a program.")] = False,
    clamp: Annotated[bool, typer.Option("--clamp", help="Outside the table, take its nearest pose.")] = False,
    results: Results = DEFAULT_RESULTS,
) -> None:
    """Print the stable pose at a flexion and varus.

    jcs: six coordinates (Grood & Suntay). scan: 4x4 that moves the moving bone from where it was scanned (LPS, mm).
    femur: 4x4 from the tibia's frame to the femur's (mm).

    Example: ct2lut query P001 --flexion 60 --varus 2 --frame jcs
    """
    from pipeline.commands.query import Question, answer, json_line, lines
    from pipeline.commands.two_tables import open_table

    found = answer(open_table(table, results), Question(flexion, varus, frame, clamp))
    say(*([json_line(found)] if as_json else lines(found)))


@app.command()
def export(
    case_id: CaseId,
    cases: Cases = DEFAULT_CASES,
    results: Results = DEFAULT_RESULTS,
    formats: Annotated[
        str, typer.Option("--format", help="Formats, separated by commas; all but dicom by default.")
    ] = "",
    out: Annotated[Path, typer.Option("--out", help="Folder for the files.")] = Path("export"),
) -> None:
    """Write a finished case for other programs.

    glb (AR/VR), json, osim (OpenSim), slicer (3D Slicer): every package holds them too. dicom (the archive): the report
    and its pictures in the study of the CT; these files name the patient.

    Example: ct2lut export P001 --format dicom --cases cases --out P001_archive
    """
    from pipeline.commands.export_case import ExportRequest, export_case

    wanted = tuple(name for name in formats.split(",") if name)
    say(*export_case(ExportRequest(case_id, cases, results, wanted, out)))


@app.command()
def compare(
    first: Annotated[str, typer.Argument(metavar="A", help="A finished case, or the path of a lut.h5.")],
    second: Annotated[str, typer.Argument(metavar="B", help="Another; the other side, or an earlier study.")],
    results: Results = DEFAULT_RESULTS,
    out: Annotated[Path, typer.Option("--out", help="The page to write.")] = Path("comparison.html"),
) -> None:
    """Compare two tables: the differences of each curve, and one page with both.

    Signs are clinical, so a left and a right knee compare directly.

    Example: ct2lut compare P001 P002 --out comparison.html
    """
    from pipeline.commands.export_case import write_files
    from pipeline.commands.two_tables import compare_cases, comparison_lines
    from pipeline.report.comparison_page import comparison_html

    page = compare_cases(first, second, results)
    write_files(out.parent, {out.name: comparison_html(page)})
    say(*comparison_lines(page), f"page: {out}")


@app.command()
def review(
    case_id: CaseId,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="What the last part of the report saved.")],
    results: Results = DEFAULT_RESULTS,
) -> None:
    """Keep a reader's decision beside the result that it is of.

    A review of another case or of an older result is refused; an earlier review is replaced.

    Example: ct2lut review P001 P001_review.json
    """
    from pipeline.commands.review import ReviewedCase, store_review

    kept = store_review(ReviewedCase(check_case_id(case_id), results / case_id, shared.flow()[-1]), file)
    say(f"{case_id}: {kept.sentence}")


@app.command()
def phantom(
    folder: Annotated[Path, typer.Argument(metavar="CASES", help="Folder with one folder a case.")],
    case_id: Annotated[str, typer.Option("--id", help="Name of the new case.")] = "phantom",
    numbers: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Change one number of the knee or the scan.")
    ] = None,
    ct: Annotated[
        bool, typer.Option("--ct", help="Make a synthetic CT (DICOM) without labels, not a label map.")
    ] = False,
) -> None:
    """Make a knee to try the program with.

    Its anatomy is known exactly, so results can be checked.

    Example: ct2lut phantom cases --id demo --set side=left --set spacing_mm=[1,1,1]
    """
    from pipeline.commands.request import phantom_spec
    from pipeline.files.phantom_case import write_phantom_case

    place = folder / check_case_id(case_id)
    write_phantom_case(place, phantom_spec(numbers or ()), as_ct=ct)
    say(f"made the case {place}")


@app.command()
def doctor(
    results: Results = DEFAULT_RESULTS,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object, for monitoring.")] = False,
) -> int:
    """Look whether this machine has what a run needs, in seconds.

    One line for each check: ok, LOOK (a run works, read what to do) or FAIL (mend it first), and what to type. Nothing
    is left in the results folder, and it is not made. The exit code is 30 where a check failed, else 0.

    Example: ct2lut doctor --results results
    """
    from pipeline.commands.doctor import closing, examine, exit_code, json_line, lines

    checks = []
    for check in examine(results, {"cohorts": _engine}):
        checks.append(check)
        say(*(() if as_json else lines(check)))
    say(json_line(checks) if as_json else closing(checks))
    return exit_code(checks)


def _engine() -> Answer:
    from pipeline.cohort.doctor_engine import engine_answer  # a library that is missing is an answer, too

    return engine_answer()


@app.command(name="compile")
def compile_solver() -> int:
    """Compile the solver, once after installing: no patient has to wait for it then."""
    from pipeline.kinematics.direct.warm_up import warm_up

    say("compiling the solver (once, about a minute)")
    say(f"the solver is ready ({warm_up():.0f} s)")
    return ExitCode.PASS


def _request(case_id: str, cases: Path, results: Path, protocol: str, overrides: Sequence[str] | None) -> Request:
    from pipeline.commands.request import Request

    return Request(case_id, cases, results, protocol, tuple(overrides or ()))


def _run(request: Request, jobs: int, flow: Sequence[Stage]) -> int:
    from pipeline.adapters.workers import get_ready
    from pipeline.commands.run_report import write_run_page
    from pipeline.commands.summary import closing, header
    from pipeline.engine.console import console_listener
    from pipeline.engine.runner import Execution, run_case

    settings = _settings_or_refusal(request)
    say(header(request.case_id, request.protocol, settings))
    listener = console_listener(write, terminal=sys.stdout.isatty())
    jobs = jobs or len(os.sched_getaffinity(0))
    execution = Execution(jobs, get_ready) if jobs > 1 else Execution(jobs)
    outcome = run_case(request.job(), flow, settings, execution, listener)
    say(*closing(outcome, write_run_page(outcome, request.job().results, flow)))
    return outcome.exit_code


def _settings_or_refusal(request: Request) -> dict[str, StrictParams]:
    """The settings of a case; what its own declaration does wrong is also left where the overview finds it."""
    from pipeline.engine.runner import record_refusal

    try:
        return request.settings(shared.flow())
    except CaseRejected as error:
        with suppress(PipelineError):
            record_refusal(request.job(), shared.flow(), error)
        raise
