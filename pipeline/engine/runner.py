"""Runs a list of stages over one case, skipping what is proven to be done.

The only place of the engine that turns exceptions into the outcome of a run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial

from pipeline.engine.cache import Lookup, look_up
from pipeline.engine.confinement import Channel, ConfinedBug, Confinement, Made, confined
from pipeline.engine.exchange import Shelf, StageInputs, StageOutputs
from pipeline.engine.inspection import (
    CaseStatus,
    PlanRow,
    StageStatus,
    plan_case,
    read_status,
    verify_case,
)
from pipeline.engine.lock import case_lock
from pipeline.engine.manifest import Manifest, OutputRecord, encode_manifest
from pipeline.engine.outcome import (
    CaseJob,
    Execution,
    Listener,
    RunOutcome,
    RunRecord,
    StageOutcome,
    State,
    Word,
    save_record,
    word_of,
)
from pipeline.engine.runlog import LOG_FILE, Level, LogLine, RunLog, error_id, private_traceback
from pipeline.engine.source import list_source
from pipeline.engine.stage import Findings, Severity, Stage, StrictParams
from pipeline.engine.storage_faults import environment_fault, is_environmental, memory_fault
from pipeline.engine.store import commit_folder, fingerprint, set_aside, sweep
from pipeline.engine.wiring import MANIFEST_FILE, check_flow, findings_artifact, settings_artifact, stage_files
from pipeline.errors import CaseRejected, ConfigError, ExitCode, PipelineError

_BUG = "E-BUG-01"

__all__ = [
    "CaseJob",
    "CaseStatus",
    "Execution",
    "Listener",
    "PlanRow",
    "RunOutcome",
    "StageOutcome",
    "StageStatus",
    "plan_case",
    "read_status",
    "record_refusal",
    "run_case",
    "verify_case",
]


@dataclass
class _Run:
    """One run of one case while it goes on; ``outcomes`` grows with each stage that ends."""

    job: CaseJob
    flow: Sequence[Stage]
    settings: Mapping[str, StrictParams]
    execution: Execution
    listener: Listener
    outcomes: list[StageOutcome] = field(default_factory=list)
    current: Stage | None = None
    since: float = 0.0

    @property
    def log(self) -> RunLog:
        return RunLog(self.job.results / LOG_FILE, self.job.case_id)

    @property
    def seconds(self) -> float:
        """Wall time of the current stage so far."""
        return round(time.perf_counter() - self.since, 3)

    def begin(self, stage: Stage) -> None:
        self.current, self.since = stage, time.perf_counter()

    def announce(self, stage: Stage, reason: str) -> None:
        self.log.write(LogLine("info", f"runs, because: {reason}", stage.name))
        self.listener.stage_started(stage.name, len(self.outcomes) + 1, len(self.flow), reason)

    def end(self, state: State, reason: str, manifest: Manifest | None = None) -> None:
        if self.current is None:
            return
        stage, seconds = self.current, self.seconds
        outcome = StageOutcome(stage.name, stage.number, state, reason, seconds, ())
        if manifest:
            outcome = replace(outcome, findings=manifest.findings, computing_s=manifest.seconds, parts=manifest.parts)
        self.current = None
        self.outcomes.append(outcome)
        level: Level = "error" if state == "failed" else "info"
        self.log.write(LogLine(level, f"{state}: {reason}", outcome.stage, seconds=outcome.seconds))
        self.listener.stage_finished(outcome, len(self.outcomes), len(self.flow))


def run_case(
    job: CaseJob,
    flow: Sequence[Stage],
    settings: Mapping[str, StrictParams],
    execution: Execution,
    listener: Listener,
) -> RunOutcome:
    """Bring every stage of a case up to date.

    Parameters
    ----------
    job : CaseJob
    flow : sequence of Stage
    settings : mapping of str to StrictParams
        Stage name -> its settings, for every stage.
    execution : Execution
    listener : Listener

    Returns
    -------
    RunOutcome
        Also for a run that failed; earlier good results are then still in place.

    Raises
    ------
    KeyboardInterrupt
        After recording it; no half-made result is left.
    ValueError
        For a flow that cannot run, which is a mistake in the program.
    """
    check_flow(flow)
    run = _Run(job, flow, settings, execution, listener)
    try:
        with _case_opened(job):
            return _recorded(run)
    except PipelineError as error:
        return _failure(run, error)


def record_refusal(job: CaseJob, flow: Sequence[Stage], error: PipelineError) -> RunOutcome:
    """Leave in the results of a case why it was refused before its first stage.

    Raises
    ------
    PipelineError
        When another run is at work on the case, or the disk fails.
    """
    outcome = _stopped(job.case_id, (), flow, error)
    with _case_opened(job):
        _close_record(job, outcome)
    return outcome


@contextmanager
def _case_opened(job: CaseJob) -> Iterator[None]:
    source, results = job.source.resolve(), job.results.resolve()
    if results.is_relative_to(source) or source.is_relative_to(results):
        raise ConfigError(
            "E-RES-01",
            f"The results folder of {job.case_id} and its case folder lie inside each other.",
            "Choose a results folder outside the cases folder; what the user brings is never written to.",
        )
    with case_lock(job.results) as alone:
        if alone:
            sweep(job.results)
        yield


def _recorded(run: _Run) -> RunOutcome:
    results = run.job.results
    save_record(results, RunRecord("running", None))
    try:
        outcome = _outcome(run)
    except KeyboardInterrupt:
        run.end("failed", "interrupted")
        with suppress(PipelineError):
            save_record(results, RunRecord("interrupted", None))
        raise
    _close_record(run.job, outcome)
    return outcome


def _close_record(job: CaseJob, outcome: RunOutcome) -> None:
    level: Level = "error" if outcome.problem else "info"
    line = LogLine(level, " ".join(filter(None, [outcome.word, outcome.problem])), code=outcome.code)
    RunLog(job.results / LOG_FILE, job.case_id).write(line)
    save_record(job.results, RunRecord("finished", outcome))


def _outcome(run: _Run) -> RunOutcome:
    try:
        _bring_up_to_date(run)
    except (Exception, SystemExit) as error:  # noqa: BLE001 -- libraries exit too; here all of it ends
        return _failure(run, _understood(run, error))
    word = word_of(run.outcomes)
    return RunOutcome(run.job.case_id, word, ExitCode[word], tuple(run.outcomes), None, None, None)


def _bring_up_to_date(run: _Run) -> None:
    shelf = Shelf(run.job.results, list_source(run.job.case_id, run.job.source))
    for stage in run.flow:
        run.begin(stage)
        found = look_up(run.job.results / stage.folder, stage, run.settings[stage.name], shelf.records)
        manifest = found.manifest or _computed(run, stage, shelf, found)
        shelf.add(stage, manifest)
        run.end("cached" if found.manifest else "ran", found.reason, manifest)


def _computed(run: _Run, stage: Stage, shelf: Shelf, found: Lookup) -> Manifest:
    folder = run.job.results / stage.folder
    if found.damaged:
        set_aside(folder)
    with _begun(run, stage, shelf) as work:
        run.announce(stage, found.reason)
        if stage.limits:
            run.execution.get_ready()
        made = work()
    settings = run.settings[stage.name]
    listed, used = findings_artifact(stage.name), settings_artifact(stage.name)
    own = {listed.name: listed.encode(made.findings), used.name: used.encode(settings.model_dump(mode="json"))}
    files = stage_files(stage, {**made.held, **own})
    recipe, outputs = found.recipe, _output_records(files)
    manifest = Manifest(recipe.key, recipe, outputs, made.findings, run.seconds, found.sources, dict(made.parts))
    data = {name: content for name, (_, content) in files.items()}
    commit_folder(folder, {**data, MANIFEST_FILE: encode_manifest(manifest)})
    _log_findings(run.log, stage, made.findings)
    return manifest


@contextmanager
def _begun(run: _Run, stage: Stage, shelf: Shelf) -> Iterator[Callable[[], Made]]:
    """The work of a stage; in a child process from the moment this is entered where the stage has limits."""
    progress = partial(run.listener.stage_progress, stage.name)
    if stage.limits is None:
        yield partial(_made, run, StageInputs(stage, shelf), progress)
        return

    def work(channel: Channel) -> Made:
        return _made(run, StageInputs(stage, shelf, channel.opened), channel.progress)

    def warn(sentence: str) -> None:
        run.log.write(LogLine("warning", sentence, stage.name))

    folders = (shelf.source.root, shelf.root.resolve())
    with confined(Confinement(stage, folders, shelf.source.files, progress, warn), work) as result:
        yield result


def _made(run: _Run, reads: StageInputs, progress: Callable[[int, int], None]) -> Made:
    out = StageOutputs(reads.stage, run.execution.jobs, progress)
    findings = reads.stage.run(reads, run.settings[reads.stage.name], out)
    return Made(findings, out.complete(), out.parts)


def _output_records(files: Mapping[str, tuple[str, bytes]]) -> dict[str, OutputRecord]:
    prints = {name: (artifact, fingerprint(data)) for name, (artifact, data) in files.items()}
    return {name: OutputRecord(artifact, one.sha256, one.size) for name, (artifact, one) in prints.items()}


def _log_findings(log: RunLog, stage: Stage, findings: Findings) -> None:
    for finding in findings:
        level: Level = "warning" if finding.severity is Severity.REVIEW else "info"
        log.write(LogLine(level, finding.message, stage.name, finding.code))


def _understood(run: _Run, error: BaseException) -> PipelineError:
    if isinstance(error, PipelineError):
        return error
    if isinstance(error, MemoryError):
        return memory_fault()
    stage = run.current.name if run.current else "case"
    if isinstance(error, OSError) and is_environmental(error):
        return environment_fault(error, f"Stage {stage}")
    number, trace = _identified(error)
    run.log.write(LogLine("error", f"error id {number}\n{trace}", stage, _BUG))
    return PipelineError(
        _BUG,
        f"The program made a mistake in stage {stage} (error id {number}); nothing was published from it.",
        f"Send {LOG_FILE} of this case's results folder to the maintainers; it holds no patient data.",
    )


def _identified(error: BaseException) -> tuple[str, str]:
    if isinstance(error, ConfinedBug):
        return error.number, error.trace
    return error_id(error), private_traceback(error)


def _failure(run: _Run, error: PipelineError) -> RunOutcome:
    run.end("failed", error.code)
    return _stopped(run.job.case_id, run.outcomes, run.flow, error)


def _stopped(case_id: str, ended: Sequence[StageOutcome], flow: Sequence[Stage], error: PipelineError) -> RunOutcome:
    rest = [StageOutcome(stage.name, stage.number, "not reached", "", 0.0, ()) for stage in flow[len(ended) :]]
    word: Word = "REJECTED" if isinstance(error, CaseRejected) else "ERROR"
    return RunOutcome(case_id, word, error.exit_code, (*ended, *rest), error.code, error.problem, error.action)
