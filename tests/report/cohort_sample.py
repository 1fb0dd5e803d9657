"""Results of many cases without their runs: the records of the engine, a verdict, and small sheets of panels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from pipeline.adapters.pictures import png, tiled
from pipeline.artifacts import CASE_FACTS, REPORT, VERDICT
from pipeline.engine.manifest import InputRecord, Manifest, OutputRecord, Recipe, encode_manifest
from pipeline.engine.outcome import RunOutcome, RunRecord, StageOutcome, State, Word, save_record
from pipeline.engine.stage import Finding, Severity
from pipeline.engine.store import fingerprint
from pipeline.errors import ExitCode
from pipeline.flow import FLOW
from pipeline.records import CaseFacts, Metric, Side, Verdict
from pipeline.report.cohort_page import COLUMNS
from pipeline.report.figure_frame import HEADER_PX
from pipeline.report.sign_off import DECIDED

SEGMENT, QA = "20_segment", "80_qa"
#: Side of a panel of the made sheets; as small as is taken for a panel.
PANEL_PX = 64


def sheet(color: tuple[int, int, int], columns: int = 4, rows: int = 1) -> bytes:
    """PNG of panels of one colour below a white heading, the column in the red channel."""
    panels = [
        [
            np.full((PANEL_PX, PANEL_PX, 3), (color[0] + 20 * j, color[1] + 20 * i, color[2]), np.uint8)
            for j in range(columns)
        ]
        for i in range(rows)
    ]
    body = tiled(panels)
    return png(np.vstack([np.full((HEADER_PX, body.shape[1], 3), 255, np.uint8), body]))


@cache
def sheets(seed: int = 0) -> Mapping[str, bytes]:
    """The pictures that a report has, by name; other ones for another seed."""
    blue = seed % 250
    return {
        "slices": sheet((0, 0, blue)),
        "bones": sheet((40, 0, blue)),
        "poses": sheet((80, 0, blue), 5, 4),
        "contact": sheet((120, 0, blue), 5),
        "curves": sheet((160, 0, blue)),
    }


def facts(case_id: str, side: Side = "right") -> CaseFacts:
    """Facts of a case of labels."""
    zeros = {"femur": 0.0, "tibia": 0.0}
    structures = {"femur": 1, "tibia": 2}
    shape = ((0.5, 0.5, 0.5), (100, 100, 100))
    return CaseFacts(
        case_id, "knee", side, "labels", {"labels.nrrd": "0" * 64}, structures, structures, *shape, zeros, {}
    )


def metrics(value: float = 1.0, **others: float) -> tuple[Metric, ...]:
    """Every metric that has a column, all of one value but for others by name (dots as two underscores)."""
    values = dict.fromkeys(COLUMNS, value) | {name.replace("__", "."): one for name, one in others.items()}
    return tuple(Metric(name, f"The {name}", one, "mm", "none", "info", "") for name, one in values.items())


def write_finished(
    results: Path, case_id: str, verdict: Verdict, side: Side = "right", images: Mapping[str, bytes] | None = None
) -> None:
    """A case that ran to its end, with a package."""
    known = CASE_FACTS.encode(facts(case_id, side))[""]
    folder = results / case_id
    files = {
        VERDICT.file: VERDICT.encode(verdict)[""],
        f"{REPORT.file}report.html": b"<p>report</p>",
        **{f"{REPORT.file}images/{name}.png": data for name, data in (sheets() if images is None else images).items()},
    }
    for stage in FLOW:
        own = files if stage.folder == QA else {CASE_FACTS.file: known} if stage.folder == SEGMENT else {}
        own = {"report.html": b"<p>report</p>"} if stage is FLOW[-1] else own
        write_stage(folder / stage.folder, own, known)
    findings = tuple(Finding("W-QA-03", Severity.REVIEW, words) for words in verdict.reasons)
    write_run(results, case_id, verdict.word, findings)


def write_run(results: Path, case_id: str, word: Word, findings: Sequence[Finding] = ()) -> None:
    """``run.json`` of a run that came to its end."""
    stages = [StageOutcome(one.name, one.number, "ran", "no result yet", 1.0, ()) for one in FLOW]
    stages[-2] = StageOutcome("qa", 80, "ran", "no result yet", 1.0, tuple(findings))
    save_record(
        results / case_id,
        RunRecord("finished", RunOutcome(case_id, word, ExitCode[word], tuple(stages), None, None, None)),
    )


def write_stopped(results: Path, case_id: str, word: Word, message: tuple[str, str, str], ran: int | None = 0) -> None:
    """A case whose last run was refused or failed after so many stages, or did not begin: code, problem, action."""
    (results / case_id).mkdir(parents=True, exist_ok=True)
    failed = -1 if ran is None else ran

    def state(index: int) -> State:
        return "ran" if index < failed else "failed" if index == failed else "not reached"

    stages = tuple(StageOutcome(one.name, one.number, state(i), "", 0.0, ()) for i, one in enumerate(FLOW))
    outcome = RunOutcome(case_id, word, ExitCode[word], stages, *message)
    save_record(results / case_id, RunRecord("finished", outcome))


def write_stage(folder: Path, files: Mapping[str, bytes], known: bytes) -> None:
    """A stage's folder with its record; ``known`` is what it says that it has read."""
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    folder.mkdir(parents=True, exist_ok=True)
    prints = {name: fingerprint(data) for name, data in files.items()}
    outputs = {name: OutputRecord("any", one.sha256, one.size) for name, one in prints.items()}
    read = InputRecord(fingerprint(known).sha256, 1)
    recipe = Recipe(folder.name, {}, {one.name: read for one in DECIDED}, {}, {}, {})
    manifest = Manifest(recipe.key, recipe, outputs, (), 1.0, {})
    (folder / "stage.json").write_bytes(encode_manifest(manifest))
