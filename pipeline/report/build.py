"""The report page: one self-contained HTML file, the same bytes for the same result."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata, resources
from typing import Any

import numpy as np

from pipeline import __version__
from pipeline.engine.stage import Findings
from pipeline.records import CaseFacts, SurfaceOrigin, Verdict
from pipeline.report.evidence import CURVES, STATUS_WORDS, Evidence, cell, neutral_varus, plain, shown_flexions
from pipeline.report.figure_frame import RESEARCH_USE
from pipeline.report.figure_viewer import content_policy, scripts, viewer_data
from pipeline.report.figures import Drawn
from pipeline.report.settings import PictureSettings

TEMPLATE = "report.html.j2"
STYLE = "report.css"
#: Packages whose version can change a number or a picture.
PACKAGES = ("numpy", "scipy", "vtk", "python-fcl", "opencv-python-headless", "matplotlib")
#: Where the bones come from, for the headline.
SOURCE_WORDS = {"ct": "a CT", "labels": "a label map", "meshes": "meshes"}
#: Folders of more files are one row of the list of inputs.
MOST_FILES_LISTED = 20
ORIGIN_WORDS = {
    "labelled": "labelled in the scan",
    "synthesised": "MADE BY THE PROGRAM, not seen in the scan",
    "absent": "absent: bare bone there",
}
BODY_WORDS = {"reference": "stands still", "moving": "moves"}


@dataclass(frozen=True, eq=False)
class Page:
    """All that the page shows; ``findings`` are those of the qa stage itself."""

    evidence: Evidence
    verdict: Verdict
    figures: Sequence[Drawn]
    findings: Findings
    settings: PictureSettings


def report_files(page: Page) -> dict[str, bytes]:
    """The report as files: ``report.html`` and ``images/*.png``."""
    images = {f"images/{item.figure.name}.png": item.data for item in page.figures if item.data}
    return {"report.html": report_html(page), **images}


def report_html(page: Page) -> bytes:
    """The page with its pictures embedded; every text from a case is escaped."""
    import jinja2  # noqa: PLC0415  - a cached run does not need it
    import markupsafe  # noqa: PLC0415  - the same

    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_resource), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    environment.filters["plain"] = plain
    environment.filters["number"] = number
    # our own constant files; every text from a case goes through the escaping of the template
    library, module = (markupsafe.Markup(text) for text in scripts())  # noqa: S704
    return environment.get_template(TEMPLATE).render(**_context(page), library=library, module=module).encode()


def _resource(name: str) -> str:
    return resources.files("pipeline.report").joinpath(name).read_text(encoding="utf-8")


def _context(page: Page) -> dict[str, Any]:
    evidence = page.evidence
    return {
        "style": STYLE,
        "policy": content_policy(scripts()),
        "viewer": viewer_data(evidence, page.settings),
        "research_use": RESEARCH_USE,
        "software": f"ct2lut {__version__}",
        "packages": [(name, metadata.version(name)) for name in PACKAGES],
        "facts": evidence.facts,
        "origin_of_bones": SOURCE_WORDS[evidence.facts.source],
        "sources": _sources(evidence.facts.source_files),
        "anatomy": evidence.anatomy,
        "mesh_quality": evidence.mesh_quality,
        "verdict": page.verdict,
        "more_reasons": _count_of_reviews(page) - len(page.verdict.reasons),
        "origins": [_origin_row(origin, evidence.facts) for origin in evidence.origins],
        "made": [plain(o.structure) for o in evidence.origins if o.origin == "synthesised"],
        "figures": [_figure(item) for item in page.figures],
        "curves": CURVES,
        "table": table_rows(evidence, page.settings),
        "findings": [(name, found) for name, found in evidence.findings.items()] + [("qa", page.findings)],
    }


def _count_of_reviews(page: Page) -> int:
    every = [*page.findings, *(finding for found in page.evidence.findings.values() for finding in found)]
    return len({finding.message for finding in every if finding.severity == "review"})


def _origin_row(origin: SurfaceOrigin, facts: CaseFacts) -> tuple[str, str, str, str]:
    found = facts.source == "ct" and origin.origin == "labelled"
    words = f"found in the CT by {', '.join(facts.found_by) or 'the program'}" if found else ORIGIN_WORDS[origin.origin]
    return plain(origin.structure), BODY_WORDS[origin.body], words, origin.origin


def _sources(files: Mapping[str, str]) -> list[tuple[str, str]]:
    """Name and SHA-256 of every input file; those of a folder as one, by the hash of their names and hashes."""
    rows = [(name, digest) for name, digest in sorted(files.items()) if "/" not in name]
    for folder in sorted({name.split("/")[0] for name in files if "/" in name}):
        inside = [(name, digest) for name, digest in sorted(files.items()) if name.startswith(f"{folder}/")]
        if len(inside) <= MOST_FILES_LISTED:
            rows += inside
        else:
            whole = hashlib.sha256("".join(f"{digest}  {name}\n" for name, digest in inside).encode()).hexdigest()
            rows.append((f"{folder}/ ({len(inside)} files, one SHA-256 over the list of all)", whole))
    return rows


def _figure(item: Drawn) -> dict[str, Any]:
    source = "data:image/png;base64," + base64.b64encode(item.data).decode() if item.data else ""
    caption = asdict(item.figure.caption)
    return {"title": item.figure.title, "caption": caption, "source": source, "problem": item.problem}


def table_rows(evidence: Evidence, settings: PictureSettings) -> list[list[str]]:
    """Rows of the smoothed table at a few attitudes: flexion, varus, the four coordinates, status in words."""
    table = evidence.smooth
    varus = sorted({0, neutral_varus(table.grid), len(table.grid.varus_deg) - 1})
    rows = []
    for i in shown_flexions(table.grid, settings.flexions_deg):
        for j in varus:
            here = cell(table, i, j)
            values = [number(float(getattr(table.poses, name)[i, j]), 2) for name, _, _ in CURVES]
            rows.append([f"{here.flexion_deg:g}", f"{here.varus_deg:g}", *values, STATUS_WORDS[here.status]])
    return rows


def number(value: float, digits: int | None = None) -> str:
    """A number for people: ``digits`` decimals, or three significant ones; a dash for what is not known."""
    if not np.isfinite(value):
        return "–"
    text = f"{value:.{digits}f}" if digits is not None else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return "0" + text[2:] if text.startswith("-0") and not float(text) else text
