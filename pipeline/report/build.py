"""The report: one self-contained HTML file and the same on paper, the same bytes for the same result."""

from __future__ import annotations

import base64
import hashlib
import struct
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from typing import Any

from pipeline import __version__
from pipeline.adapters.pdf import pdf
from pipeline.engine.stage import Findings
from pipeline.records import CaseFacts, SurfaceOrigin, Verdict
from pipeline.report.evidence import CURVES, Evidence, cell, neutral_varus, shown_flexions
from pipeline.report.figure_frame import RESEARCH_USE
from pipeline.report.figure_viewer import content_policy, scripts, viewer_data
from pipeline.report.figures import Drawn
from pipeline.report.motion import MOTION
from pipeline.report.settings import PictureSettings
from pipeline.report.sign_off import review_facts
from pipeline.report.templates import environment, number
from pipeline.suggestions import plain

TEMPLATE = "report.html.j2"
STYLE = "report.css"
#: What the page is put together from, beside the parts that are another module's.
PAGE_FILES = (TEMPLATE, STYLE, "meaning.html.j2")
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
#: Width over height below which a picture would be too small on half a page of paper.
TALL = 1.3
#: How a PNG begins; its width and height are at bytes 16 and 20.
PNG = b"\x89PNG\r\n\x1a\n"
BODY_WORDS = {"reference": "stands still", "moving": "moves"}


@dataclass(frozen=True, eq=False)
class Page:
    """All that the page shows; ``findings`` are those of the qa stage itself."""

    evidence: Evidence
    verdict: Verdict
    figures: Sequence[Drawn]
    findings: Findings
    settings: PictureSettings


def picture_files(page: Page) -> dict[str, bytes]:
    """The pictures and the film as files below ``images/``."""
    return {item.figure.file: item.data for item in page.figures if item.data}


def report_html(page: Page) -> bytes:
    """The page with its pictures embedded; every text from a case is escaped."""
    return _rendered(page, paper=False).encode()


def report_pdf(page: Page) -> bytes:
    """The same page on paper, PDF/A: without what moves, with case, side and notice on every sheet.

    Raises
    ------
    EnvironmentFault
        ``E-ENV-12`` when this machine cannot set text.
    """
    return pdf(_rendered(page, paper=True))


def _rendered(page: Page, *, paper: bool) -> str:
    context = _context(page) if paper else _context(page) | _moving(page)
    return environment().get_template(TEMPLATE).render(context, paper=paper)


def _moving(page: Page) -> dict[str, Any]:
    """What only a browser shows: data and scripts of the model that can be moved, and the policy that lets them run."""
    import markupsafe  # noqa: PLC0415  - a cached run does not need it

    # our own constant files; every text from a case goes through the escaping of the template
    library, module = (markupsafe.Markup(text) for text in scripts())  # noqa: S704
    viewer = viewer_data(page.evidence, page.settings)
    return {"policy": content_policy(scripts()), "viewer": viewer, "library": library, "module": module}


def _context(page: Page) -> dict[str, Any]:
    evidence = page.evidence
    return {
        "style": STYLE,
        "research_use": RESEARCH_USE,
        "software": f"ct2lut {__version__}",
        "packages": [(name, metadata.version(name)) for name in PACKAGES],
        "facts": evidence.facts,
        "origin_of_bones": SOURCE_WORDS[evidence.facts.source],
        "sources": _sources(evidence.facts.source_files),
        "anatomy": evidence.anatomy,
        "sweep": evidence.sweep,
        "mesh_quality": evidence.mesh_quality,
        "verdict": page.verdict,
        "review": review_facts(evidence, page.verdict),
        "more_reasons": _count_of_reviews(page) - len(page.verdict.reasons),
        "origins": [_origin_row(origin, evidence.facts) for origin in evidence.origins],
        "made": [plain(o.structure) for o in evidence.origins if o.origin == "synthesised"],
        "figures": [_figure(item) for item in page.figures if item.figure != MOTION],
        "motion": next((_figure(item) for item in page.figures if item.figure == MOTION), None),
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
    source = f"data:{item.figure.media};base64,{base64.b64encode(item.data).decode()}" if item.data else ""
    words = {"title": item.figure.title, "caption": asdict(item.figure.caption), "problem": item.problem}
    return {**words, "source": source, "tall": _is_tall(item.data)}


def _is_tall(picture: bytes) -> bool:
    """Whether a PNG is so high that on paper it gets more than half of a page; no for what is no PNG."""
    if not picture.startswith(PNG):
        return False
    width, height = struct.unpack(">II", picture[16:24])
    return bool(width < TALL * height)


def table_rows(evidence: Evidence, settings: PictureSettings) -> list[list[str]]:
    """Rows of the smoothed table at a few attitudes: flexion, varus, the four coordinates, status in words."""
    table = evidence.smooth
    varus = sorted({0, neutral_varus(table.grid), len(table.grid.varus_deg) - 1})
    rows = []
    for i in shown_flexions(table.grid, settings.flexions_deg):
        for j in varus:
            here = cell(table, i, j)
            values = [number(float(getattr(table.poses, name)[i, j]), 2) for name, _, _ in CURVES]
            rows.append([f"{here.flexion_deg:g}", f"{here.varus_deg:g}", *values, here.status.words])
    return rows
