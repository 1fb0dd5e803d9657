"""Stage 80, qa: numbers, verdict, pictures and the report page."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import count

from pydantic import Field

from pipeline.adapters.rendering import require_renderer
from pipeline.adapters.workers import map_in_order
from pipeline.artifacts import (
    ANATOMY,
    CASE_FACTS,
    CT,
    LABELS,
    MADE_MESHES,
    MESH_QUALITY,
    MESHES,
    MOVING_BODY,
    NEUTRAL_CURVE,
    RAW_TABLE,
    REFERENCE_BODY,
    REPORT,
    SCAN_RETURNS,
    SMOOTH_TABLE,
    SURFACE_ORIGINS,
    SWEEP_FACTS,
    VERDICT,
)
from pipeline.engine.stage import Findings, Inputs, Outputs, Stage, StrictParams, findings_of, timed
from pipeline.errors import EnvironmentFault
from pipeline.report.build import PAGE_FILES, Page, picture_files, report_html, report_pdf
from pipeline.report.evidence import Evidence
from pipeline.report.figure_slices import ct_cuts
from pipeline.report.figure_viewer import VIEWER_FILES
from pipeline.report.figures import Drawn, drawn, expected_figures
from pipeline.report.metrics import all_metrics
from pipeline.report.motion import TEMPLATE as MOTION_TEMPLATE
from pipeline.report.motion import expected_motion
from pipeline.report.settings import Limits, PictureSettings
from pipeline.report.verdict import judge, metric_findings, picture_findings

FINDINGS = {name: findings_of(name) for name in ("intake", "segment", "mesh", "anatomy", "contact", "sweep", "smooth")}

#: The longest first, and the charts side by side: a worker that has drawn the one has loaded what draws the other.
DRAWING_ORDER = (
    *("motion", "poses", "neutral", "curves", "checks", "repeats", "baselines"),
    *("paths", "slices", "contact", "bones"),
)


class Params(StrictParams):
    """Settings of the quality report."""

    limits: Limits = Field(default=Limits(), description="what is guaranteed; beyond it a person has to look")
    pictures: PictureSettings = Field(default=PictureSettings(), description="what the pictures show")


def run(reads: Inputs, params: Params, out: Outputs) -> Findings:
    """Measure, draw, judge, and write the report."""
    with timed(out, "what the stages left, and numbers"):
        evidence = gather(reads, params.pictures)
        metrics = all_metrics(evidence, params.limits)
    pictures = _draw(evidence, params, out)
    missing = {item.figure.title: item.problem for item in pictures if not item.data}
    findings = (*metric_findings(metrics), *picture_findings(missing))
    verdict = judge(metrics, findings, evidence.findings)
    out[VERDICT] = verdict
    page = Page(evidence, verdict, pictures, findings, params.pictures)
    with timed(out, "report.html"):
        html = report_html(page)
    with timed(out, "report.pdf"):
        paper = report_pdf(page)
    out[REPORT] = {"report.html": html, "report.pdf": paper, **picture_files(page)}
    return findings


def gather(reads: Inputs, pictures: PictureSettings) -> Evidence:
    """What the stages before left, as evidence."""
    evidence = Evidence(
        facts=reads[CASE_FACTS],
        labels=reads[LABELS],
        ct_cuts=None,
        meshes=reads[MESHES] | reads[MADE_MESHES],
        mesh_quality=reads[MESH_QUALITY],
        anatomy=reads[ANATOMY],
        reference=reads[REFERENCE_BODY],
        moving=reads[MOVING_BODY],
        origins=reads[SURFACE_ORIGINS],
        raw=reads[RAW_TABLE],
        scan_returns=reads[SCAN_RETURNS],
        sweep=reads[SWEEP_FACTS],
        neutral=reads[NEUTRAL_CURVE],
        smooth=reads[SMOOTH_TABLE],
        findings={name: reads[artifact] for name, artifact in FINDINGS.items()},
    )
    ct = reads[CT]
    return evidence if ct is None else replace(evidence, ct_cuts=ct_cuts(evidence, ct, pictures))


def _draw(evidence: Evidence, params: Params, out: Outputs) -> list[Drawn]:
    figures, finished = (*expected_figures(evidence), *expected_motion(evidence)), count(1)
    work = partial(drawn, evidence=evidence, settings=params.pictures, limits=params.limits)
    order = sorted(figures, key=lambda figure: DRAWING_ORDER.index(figure.name))
    out.progress(0, len(figures))
    try:
        found = map_in_order(work, order, out.jobs, lambda _: out.progress(next(finished), len(figures)))
    except EnvironmentFault:
        if out.jobs > 1:
            # VTK ends the worker that draws where no renderer is installed: then this says so
            require_renderer()
        raise
    found.sort(key=lambda one: figures.index(one.figure))
    for one in found:
        out.took(f"drawing '{one.figure.title}'", one.seconds)
    return found


STAGE = Stage(
    number=80,
    name="qa",
    reads=(
        CASE_FACTS,
        LABELS,
        CT,
        MESHES,
        MADE_MESHES,
        MESH_QUALITY,
        ANATOMY,
        REFERENCE_BODY,
        MOVING_BODY,
        SURFACE_ORIGINS,
        RAW_TABLE,
        SCAN_RETURNS,
        SWEEP_FACTS,
        NEUTRAL_CURVE,
        SMOOTH_TABLE,
        *FINDINGS.values(),
    ),
    writes=(VERDICT, REPORT),
    Params=Params,
    run=run,
    resources=tuple(f"pipeline.report:{name}" for name in (*PAGE_FILES, MOTION_TEMPLATE, *VIEWER_FILES)),
)
