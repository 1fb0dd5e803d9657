"""What the command line says about a case, as lines of text; nothing here prints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.engine.runner import CaseStatus, PlanRow, RunOutcome, StageOutcome, StageStatus
from pipeline.engine.stage import Severity, StrictParams

#: More reasons than this are read by nobody on a screen; the report has them all.
MAX_REASONS = 3


def header(case_id: str, protocol: str, settings: Mapping[str, StrictParams]) -> str:
    """One line: which case, which joint and side, which protocol.

    Parameters
    ----------
    settings : mapping of str to StrictParams
        By stage name; side and joint are read from the settings of ``intake`` where there is such a stage.
    """
    facts = settings["intake"].model_dump() if "intake" in settings else {}
    side, joint = facts.get("side"), facts.get("joint", "")
    what = f"{side} {joint}".strip() if side else f"{joint}, side not declared"
    return "   ".join((case_id, what, f"protocol {Path(protocol).stem}"))


def closing(outcome: RunOutcome, report: Path | None) -> list[str]:
    """The last lines of a run: the word, at most three reasons, what to do, where the report is."""
    lines = [f"{outcome.word}   {outcome.case_id}   {_gist(outcome)}".rstrip()]
    lines += [f"  {line}" for line in _reasons(outcome)]
    return lines if report is None else [*lines, f"report: {report}"]


def plan_lines(rows: Sequence[PlanRow]) -> list[str]:
    """One line a stage: run or skip, and the first reason."""
    if all(row.action == "skip" for row in rows):
        return [up_to_date(len(rows))]
    width = max(len(row.stage) for row in rows)
    return [f"{row.stage:<{width}}  {row.action:<4}  {row.reason}".rstrip() for row in rows]


def status_lines(status: CaseStatus, review: str | None = None) -> list[str]:
    """One line a stage, how the last run ended, and what is said of a review, if there is one."""
    lines = [_stage_line(stage) for stage in status.stages]
    return [*lines, f"last run: {_last_run(status)}", *([review] if review else [])]


def overview_line(case_id: str, status: CaseStatus) -> str:
    """One line for a case: how the last run ended, how many stages have a result, for how long they computed."""
    done = [stage for stage in status.stages if stage.state == "done"]
    seconds = sum(stage.seconds or 0.0 for stage in done)
    return f"{case_id:<16}  {len(done)}/{len(status.stages)} stages  {seconds:7.1f} s  {_last_run(status)}"


def earlier_page_lines(status: CaseStatus) -> list[str]:
    """What is said before the page of an earlier run is opened."""
    if status.last is None:
        what = "A run is at work" if status.state == "running" else "The last run was interrupted"
        return [f"{what}; this is the report of an earlier run."]
    ended = " ".join(filter(None, [status.last.word, status.last.code]))
    reason = [text for text in (status.last.problem, status.last.action) if text]
    return [f"The last run left no report ({ended}); this is the report of an earlier run.", *reason]


def up_to_date(stages: int) -> str:
    """What is said when no stage had anything to do."""
    return f"nothing to do: all {stages} stages are up to date"


def _stage_line(stage: StageStatus) -> str:
    seconds = "" if stage.seconds is None else f"{stage.seconds:.1f} s"
    notable = [finding.code for finding in stage.findings if finding.severity is Severity.REVIEW]
    return f"{stage.number} {stage.stage:<10} {stage.state:<8} {seconds:>9}  {' '.join(notable)}".rstrip()


def _last_run(status: CaseStatus) -> str:
    if status.last is None:
        return {"never": "none", "finished": "none"}.get(status.state, status.state)
    return " ".join(filter(None, [status.last.word, status.last.problem]))


def _gist(outcome: RunOutcome) -> str:
    if outcome.code is not None:
        return outcome.code
    if all(stage.state == "cached" for stage in outcome.stages):
        return up_to_date(len(outcome.stages))
    return ""


def _reasons(outcome: RunOutcome) -> list[str]:
    if outcome.code is not None:
        return [text for text in (outcome.problem, outcome.action) if text]
    reasons = [reason for stage in outcome.stages for reason in _review_reasons(stage)]
    more = len(reasons) - MAX_REASONS
    return reasons[:MAX_REASONS] + ([f"and {more} more in the report"] if more > 0 else [])


def _review_reasons(stage: StageOutcome) -> list[str]:
    return [f"{each.code}  {each.message}" for each in stage.findings if each.severity is Severity.REVIEW]
