"""The page a person opens after a run, ``report.html`` of a case's results folder."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from pipeline.engine.inspection import CaseStatus
from pipeline.engine.outcome import RunOutcome
from pipeline.engine.stage import Stage
from pipeline.engine.store import read_file, replace_file
from pipeline.errors import PipelineError
from pipeline.report.settings import RUN_MARK

PAGE = "report.html"


def write_run_page(outcome: RunOutcome, results: Path, flow: Sequence[Stage]) -> Path | None:
    """Write the page of a run and say where it is; None where the run did not begin or nothing can be written.

    Raises
    ------
    PipelineError
        When it cannot be written after a run that went well; a run that failed keeps the reason it has.
    """
    if all(stage.state == "not reached" for stage in outcome.stages):
        return None
    page, made = results / PAGE, None if outcome.code else _made_by_stages(results, flow)
    if outcome.code is None and (made is None or _stands(page, outcome)):
        return page if made else None
    from pipeline.report.run_page import run_page  # noqa: PLC0415 - a run with nothing to do need not load it

    with suppress(*((PipelineError, OSError) if outcome.code else ())):
        replace_file(page, run_page(outcome, read_file(made) if made else None))
        return page
    return None


def _stands(page: Path, outcome: RunOutcome) -> bool:
    """Whether nothing was computed since the page was made of a run that went well."""
    if any(stage.state != "cached" for stage in outcome.stages) or not page.is_file():
        return False
    return RUN_MARK in read_file(page)


def report_page(results: Path, flow: Sequence[Stage]) -> Path | None:
    """The page to open: that of the last run, else the one that a stage made."""
    page = results / PAGE
    return page if page.is_file() else _made_by_stages(results, flow)


def tells_last_run(page: Path, status: CaseStatus) -> bool:
    """Whether a page tells how the last run ended.

    A run that is at work or was killed has written none; one that was stopped for its time or memory has its reason in
    ``run.json`` only, and leaves the page of the run before it.

    Raises
    ------
    EnvironmentFault
        When the page cannot be read.
    """
    if status.last is None:
        return status.state == "never"
    return status.last.code is None or status.last.code.encode() in read_file(page)


def _made_by_stages(results: Path, flow: Sequence[Stage]) -> Path | None:
    """The packaged page if the case got that far, else the one that qa made."""
    made = [results / stage.folder / artifact.file for stage in flow for artifact in stage.writes if artifact.is_folder]
    return next((page for folder in reversed(made) if (page := folder / PAGE).is_file()), None)
