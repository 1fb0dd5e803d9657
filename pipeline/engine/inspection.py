"""Looking at a case without changing it: what would run, what is there, is it as it was written."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pipeline.engine.artifacts import SOURCE
from pipeline.engine.cache import Lookup, altered_outputs, look_up
from pipeline.engine.exchange import Shelf
from pipeline.engine.lock import is_running
from pipeline.engine.manifest import InputRecord, Manifest, Unusable, load_manifest
from pipeline.engine.outcome import CaseJob, RunOutcome, load_record
from pipeline.engine.source import list_source
from pipeline.engine.stage import Findings, Stage, StrictParams
from pipeline.engine.storage_faults import storage
from pipeline.engine.wiring import check_flow, writers_of, written_by


@dataclass(frozen=True)
class PlanRow:
    """What a run would do with one stage, and the first reason."""

    stage: str
    action: Literal["run", "skip"]
    reason: str


@dataclass(frozen=True)
class StageStatus:
    """What one stage has left: nothing, a result, or one whose record cannot be used; wall time of its run."""

    stage: str
    number: int
    state: Literal["done", "absent", "damaged"]
    seconds: float | None
    findings: Findings


@dataclass(frozen=True)
class CaseStatus:
    """How far a case is.

    Attributes
    ----------
    stages : tuple of StageStatus
        Records only; outputs are not read (``verify_case`` does).
    state : "never", "running", "interrupted" or "finished"
        Of the last run; a killed run counts as interrupted.
    last : RunOutcome or None
        Outcome of the last run where it finished.
    """

    stages: tuple[StageStatus, ...]
    state: Literal["never", "running", "interrupted", "finished"]
    last: RunOutcome | None


def plan_case(job: CaseJob, flow: Sequence[Stage], settings: Mapping[str, StrictParams]) -> tuple[PlanRow, ...]:
    """What a run would do, without doing anything.

    A stage behind one that runs is planned to run, for a reason of its own or because its inputs may change; when the
    earlier stage then writes the same bytes as before, the run skips it after all.

    Raises
    ------
    PipelineError
        When the case or its results cannot be read.
    """
    check_flow(flow)
    shelf = Shelf(job.results, list_source(job.case_id, job.source))
    writers = writers_of(flow)
    rows = []
    for stage in flow:
        found = look_up(job.results / stage.folder, stage, settings[stage.name], shelf.records)
        behind = [writers[artifact.name] for artifact in stage.reads if artifact.name not in shelf.records]
        if found.manifest and not behind:
            shelf.add(stage, found.manifest)
        rows.append(_row(stage, found, behind))
    return tuple(rows)


def verify_case(results: Path, flow: Sequence[Stage]) -> tuple[str, ...]:
    """Every way in which the results on disk are not what was once written, or do not belong together.

    Returns
    -------
    tuple of str
        One sentence each; empty when all recorded results are sound. A stage without a result is no problem.

    Raises
    ------
    EnvironmentFault
        When the disk fails.
    """
    check_flow(flow)
    problems: list[str] = []
    known: dict[str, InputRecord] = {}
    with storage("Verifying the results"):
        for stage in flow:
            folder = results / stage.folder
            manifest = load_manifest(folder)
            if isinstance(manifest, Unusable):
                problems += [f"{stage.folder}: {manifest.reason}"] if folder.exists() else []
                continue
            problems += [f"{stage.folder}: {one}" for one in _problems(folder, manifest, known)]
            held = [one for one in written_by(stage) if one.is_folder or manifest.files_of(one)]
            absent = [one.name.replace("_", " ") for one in written_by(stage) if one not in held]
            if absent:
                problems.append(f"{stage.folder}: made by another version of the program (no {', '.join(absent)})")
            known |= {one.name: InputRecord(manifest.content_hash(one), one.schema) for one in held}
    return tuple(problems)


def read_status(results: Path, flow: Sequence[Stage]) -> CaseStatus:
    """How far a case is, from its records.

    Raises
    ------
    EnvironmentFault
        When the disk fails.
    """
    with storage("Reading the results"):
        stages = tuple(_status(stage, load_manifest(results / stage.folder)) for stage in flow)
    record = load_record(results)
    if is_running(results):
        return CaseStatus(stages, "running", None)
    if record is None:
        return CaseStatus(stages, "never", None)
    return CaseStatus(stages, "finished" if record.outcome else "interrupted", record.outcome)


def _row(stage: Stage, found: Lookup, behind: Sequence[Stage]) -> PlanRow:
    if found.manifest is None:
        return PlanRow(stage.name, "run", found.reason)
    if behind:
        return PlanRow(stage.name, "run", f"{behind[0].folder} may change")
    return PlanRow(stage.name, "skip", found.reason)


def _problems(folder: Path, manifest: Manifest, known: Mapping[str, InputRecord]) -> Iterator[str]:
    if manifest.key != manifest.recipe.key:
        yield "its key is not that of its recorded ingredients"
    yield from altered_outputs(folder, manifest)
    for name, record in sorted(manifest.recipe.inputs.items()):
        if name != SOURCE.name and name in known and known[name] != record:
            yield f"made from another {name} than the one that is there now"


def _status(stage: Stage, manifest: Manifest | Unusable) -> StageStatus:
    if isinstance(manifest, Unusable):
        return StageStatus(stage.name, stage.number, "damaged" if manifest.damaged else "absent", None, ())
    return StageStatus(stage.name, stage.number, "done", manifest.seconds, manifest.findings)
