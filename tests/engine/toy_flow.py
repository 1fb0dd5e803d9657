"""A small pipeline that has nothing to do with knees: numbers, their multiples, a summary folder."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from pydantic import Field

from pipeline.engine.artifacts import SOURCE, Files, folder
from pipeline.engine.records import record_artifact
from pipeline.engine.runner import CaseJob, Execution, RunOutcome, StageOutcome, run_case
from pipeline.engine.stage import Finding, Findings, Inputs, Outputs, Severity, Stage, StrictParams, findings_of, timed
from pipeline.errors import CaseRejected

NUMBERS = record_artifact("numbers", "numbers.json", tuple[int, ...])
MULTIPLES = record_artifact("multiples", "multiples.json", tuple[float, ...])
PARTS = folder("parts", "parts/")
SUMMARY = folder("summary", "./")


class GatherParams(StrictParams):
    keep: int = Field(default=5, ge=1)


class Grid(StrictParams):
    step_deg: float = Field(default=2.0, gt=0)


class MultiplyParams(StrictParams):
    factor: float = 3.0
    grid: Grid = Grid()


class SumParams(StrictParams):
    title: str = "sum"


def gather(reads: Inputs, params: GatherParams, out: Outputs) -> Findings:
    words = reads[SOURCE].read("numbers.txt").decode().split()
    if not all(word.isdigit() for word in words):
        raise CaseRejected("E-TOY-01", "numbers.txt holds something that is no number.", "Correct it.")
    out[NUMBERS] = tuple(int(word) for word in words)[: params.keep]
    return ()


def multiply(reads: Inputs, params: MultiplyParams, out: Outputs) -> Findings:
    multiples = tuple(params.factor * params.grid.step_deg * number for number in reads[NUMBERS])
    out[MULTIPLES] = multiples
    out[PARTS] = {f"{index}/value.txt": repr(value).encode() for index, value in enumerate(multiples[:2])}
    out.progress(len(multiples), len(multiples))
    for _ in range(2):
        with timed(out, "multiplying"):
            time.sleep(0.002)
    large = [Finding("W-TOY-01", Severity.REVIEW, f"{value} is large") for value in multiples if value > 100]
    return (Finding("N-TOY-01", Severity.NOTE, "multiplied"), *large)


def total(reads: Inputs, params: SumParams, out: Outputs) -> Findings:
    findings, multiples = reads[findings_of("multiply")], reads[MULTIPLES]
    text = f"{params.title} {sum(multiples)} {len(findings)}"
    out[SUMMARY] = {"summary.txt": text.encode(), "images/0.txt": reads[PARTS]["0/value.txt"]}
    return ()


GATHER = Stage(10, "gather", (SOURCE,), (NUMBERS,), GatherParams, gather)
MULTIPLY = Stage(20, "multiply", (NUMBERS,), (MULTIPLES, PARTS), MultiplyParams, multiply)
TOTAL = Stage(30, "total", (MULTIPLES, PARTS, findings_of("multiply")), (SUMMARY,), SumParams, total)
FLOW = (GATHER, MULTIPLY, TOTAL)
DEFAULTS: Mapping[str, StrictParams] = {stage.name: stage.Params() for stage in FLOW}


@dataclass
class Recorder:
    """A listener that remembers."""

    started: list[tuple[str, int, int, str]] = field(default_factory=list)
    progress: list[tuple[str, int, int]] = field(default_factory=list)
    finished: list[StageOutcome] = field(default_factory=list)

    def stage_started(self, stage: str, index: int, total: int, reason: str) -> None:
        self.started.append((stage, index, total, reason))

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        self.progress.append((stage, done, total))

    def stage_finished(self, outcome: StageOutcome, index: int, total: int) -> None:
        self.finished.append(outcome)


def make_case(base: Path, numbers: str = "1 2 3") -> CaseJob:
    source = base / "cases" / "P1"
    source.mkdir(parents=True)
    (source / "numbers.txt").write_text(numbers)
    return CaseJob("P1", source, base / "results" / "P1")


def run(
    job: CaseJob, flow: Sequence[Stage] = FLOW, settings: Mapping[str, StrictParams] | None = None
) -> tuple[RunOutcome, Recorder]:
    listener = Recorder()
    return run_case(job, flow, {**DEFAULTS, **(settings or {})}, Execution(jobs=1), listener), listener


def states(outcome: RunOutcome) -> list[str]:
    return [stage.state for stage in outcome.stages]


def reasons(outcome: RunOutcome) -> dict[str, str]:
    return {stage.stage: stage.reason for stage in outcome.stages}


def artifact_bytes(results: Path) -> Files:
    """Everything the stages wrote, without the records of the engine (which hold wall times)."""
    files = sorted(path for path in results.rglob("*") if path.is_file() and path.name != "stage.json")
    named = {path.relative_to(results).as_posix(): path for path in files}
    return {name: path.read_bytes() for name, path in named.items() if name[0].isdigit()}


def leftovers(results: Path) -> list[str]:
    return sorted(path.name for path in results.iterdir() if path.name.startswith(".") and path.name != ".lock")


def copy_case(job: CaseJob, base: Path) -> CaseJob:
    """The case and its results as they are, at another place."""
    shutil.copytree(job.source.parents[1], base)
    return replace(job, source=base / "cases" / "P1", results=base / "results" / "P1")
