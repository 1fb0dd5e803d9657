"""The word and its reasons: pure functions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from pipeline.engine.stage import Finding, Findings, Severity
from pipeline.records import Metric, Verdict

#: Units of metrics that count something.
COUNTED = ("edges", "entries")
#: What fits on a screen beside the word; every finding stands further down in the report.
MAX_REASONS = 3


@dataclass(frozen=True)
class Guarantee:
    """What the program promises about a metric: code and words of the finding when it is broken."""

    code: str
    broken: str


def guarantees() -> dict[str, Guarantee]:
    """Name of each metric that has a limit -> what is said when it fails."""
    return {
        "open_edges": Guarantee("W-QA-01", "A surface has holes"),
        "mesh_volume_error": Guarantee("W-QA-02", "A surface is larger or smaller than its label"),
        "usable_cells": Guarantee("W-QA-03", "Some entries of the table stay without a pose"),
        "raw_contact_gap": Guarantee("W-QA-04", "A pose of the sweep is not proven to be in contact"),
        "contact_error": Guarantee("W-QA-05", "An entry of the table leaves a gap or an overlap"),
        "midpoint_error": Guarantee("W-QA-06", "Between two entries of the table a gap or an overlap can be seen"),
        "untested": Guarantee("W-QA-07", "Some entries of the table were not tested for contact"),
    }


def metric_findings(metrics: Iterable[Metric]) -> Findings:
    """One review finding for each metric beyond its limit."""
    known = guarantees()
    return tuple(
        Finding(known[metric.name].code, Severity.REVIEW, f"{known[metric.name].broken}: {_numbers(metric)}.")
        for metric in metrics
        if metric.state == "review"
    )


def _numbers(metric: Metric) -> str:
    unit = "" if metric.unit in COUNTED else f" {metric.unit}"
    return f"{metric.value:.4g} {metric.unit}, expected {metric.limit}{unit}"


def picture_findings(missing: Mapping[str, str]) -> Findings:
    """One review finding for each expected picture (title -> why) that could not be made."""
    return tuple(
        Finding("W-QA-10", Severity.REVIEW, f"The picture '{title}' is missing: {why}.")
        for title, why in missing.items()
    )


def judge(metrics: tuple[Metric, ...], own: Findings, earlier: Mapping[str, Findings]) -> Verdict:
    """The verdict: REVIEW when any finding, ours or of a stage before, asks for it.

    Our own guarantees are named first; at most three reasons are given, all findings stand in the report.
    """
    before = tuple(finding for findings in earlier.values() for finding in findings)
    reasons = tuple(dict.fromkeys(f.message for f in (*own, *before) if f.severity is Severity.REVIEW))
    return Verdict("REVIEW" if reasons else "PASS", reasons[:MAX_REASONS], metrics)
