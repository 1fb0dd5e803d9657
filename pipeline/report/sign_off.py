"""The reader's decision at the end of the report: the facts that tie the file it saves to exactly one result."""

from __future__ import annotations

from typing import Any

from pipeline import __version__
from pipeline.artifacts import ANATOMY, CASE_FACTS, SMOOTH_TABLE, VERDICT
from pipeline.engine.artifacts import Artifact
from pipeline.engine.store import fingerprint
from pipeline.records import Verdict
from pipeline.report.evidence import Evidence
from pipeline.report.figure_frame import RESEARCH_USE

REVIEW_SCHEMA = "ct2lut-review"
REVIEW_VERSION = "1.0"
#: What a decision is about: input and side, frames, poses, judgement. The package is made from these very files.
DECIDED: tuple[Artifact[Any], ...] = (CASE_FACTS, ANATOMY, SMOOTH_TABLE, VERDICT)


def review_facts(evidence: Evidence, verdict: Verdict) -> dict[str, Any]:
    """What the page puts into the file of a review beside the decision; plain JSON values.

    ``result`` is artifact name -> SHA-256 of its file in the results folder, ``smooth_table`` that of
    ``70_smooth/smooth_table.npz``, and so on.
    """
    facts = evidence.facts
    content = (facts, evidence.anatomy, evidence.smooth, verdict)
    marks = {one.name: fingerprint(one.encode(value)[""]).sha256 for one, value in zip(DECIDED, content, strict=True)}
    return {
        "schema": {"name": REVIEW_SCHEMA, "version": REVIEW_VERSION},
        "notice": RESEARCH_USE,
        "case_id": facts.case_id,
        "joint": facts.joint,
        "side": facts.side,
        "software": f"ct2lut {__version__}",
        "verdict": verdict.word,
        "result": marks,
    }
