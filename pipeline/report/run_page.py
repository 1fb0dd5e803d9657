"""The page a person opens after a run: the report and how the run went, or why there is no report.

It lies beside the folders of the stages and is made anew by each run; the report that it is made from is the same bytes
for the same result, and holds no times.
"""

from __future__ import annotations

from typing import Any

from pipeline import __version__
from pipeline.engine.outcome import RunOutcome
from pipeline.report.figure_frame import RESEARCH_USE
from pipeline.report.settings import RUN_MARK
from pipeline.report.templates import environment

STATE_WORDS = {
    "ran": "computed",
    "cached": "up to date, not computed again",
    "failed": "failed",
    "not reached": "not reached",
}


def run_page(outcome: RunOutcome, report: bytes | None) -> bytes:
    """The page of one run, HTML.

    Parameters
    ----------
    report : bytes, optional
        ``report.html`` of the case; None where the run left none. It is not shown where the run was refused or failed:
        it is then of an earlier run.
    """
    if report is not None and outcome.code is None:
        return report.replace(RUN_MARK, _section(outcome).encode() + RUN_MARK, 1)
    found = [(stage.stage, finding) for stage in outcome.stages for finding in stage.findings]
    context = _context(outcome) | {"research_use": RESEARCH_USE, "software": f"ct2lut {__version__}", "findings": found}
    return environment().get_template("refused.html.j2").render(context).encode()


def _section(outcome: RunOutcome) -> str:
    return environment().get_template("run.html.j2").render(_context(outcome))


def _context(outcome: RunOutcome) -> dict[str, Any]:
    stages = outcome.stages
    return {
        "outcome": outcome,
        "stages": stages,
        "words": STATE_WORDS,
        "total": sum(stage.seconds for stage in stages),
        "computing": sum(stage.computing_s for stage in stages),
    }
