"""One case in a process of its own with limits; what it came to is read from its results, not from its exit code."""

from __future__ import annotations

import errno
import os
import re
import signal
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.cohort.limited_process import Ended, run_limited
from pipeline.cohort.model import CaseEnd, CaseLimits, CohortRequest, ListedCase
from pipeline.engine.lock import case_lock
from pipeline.engine.outcome import RunOutcome, RunRecord, Word, load_record, save_record
from pipeline.engine.runlog import LOG_FILE, LogLine, RunLog, printable
from pipeline.errors import ExitCode, PipelineError

_RECORD = "run.json"
#: What tells libraries how many threads they may use.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "LP_NUM_THREADS")
#: Exit codes of a run that says why it stopped.
_TOLD = (ExitCode.REJECTED, ExitCode.USAGE, ExitCode.ENVIRONMENT, ExitCode.ERROR)
#: The code, the problem and the action at the end of the output: of a run that never began, or of one that did.
_REASON = re.compile(
    r"^(?:(?:REJECTED|ERROR) {3}[\w-]+ {3})?(?P<code>E-[A-Z]+-\d+)(?:  |\n  )(?P<problem>.+)\n(?:  )?(?P<action>.+)$",
    re.MULTILINE,
)
#: How one ends whom somebody stopped, or the system for want of memory.
_STOPPED = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
#: A folder that cannot be written to is as it is at the next attempt.
_LASTING = "E-ENV-02"
_LONGEST = 500


@dataclass(frozen=True)
class CaseWork:
    """What is the same for all cases.

    Attributes
    ----------
    results : Path
        Folder of the results of all cases.
    request : CohortRequest
    program : sequence of str
        Command that stands for ``ct2lut``.
    """

    results: Path
    request: CohortRequest
    program: Sequence[str]


@dataclass(frozen=True)
class _Attempt:
    """A process that ended, and whether ``run.json`` was written since it began."""

    case_id: str
    folder: Path
    limits: CaseLimits
    ended: Ended
    recorded: bool

    @property
    def stopped_by(self) -> str:
        """Name of the signal that ended it, also where a shell or a container passed it on; empty for none."""
        code = self.ended.code
        with suppress(ValueError):
            return signal.Signals(-code if code < 0 else code - 128).name
        return ""


def program() -> tuple[str, ...]:
    """The ``ct2lut`` of this very installation."""
    return (str(Path(sys.executable).with_name("ct2lut")),)


def run_case(case: ListedCase, work: CaseWork) -> CaseEnd:
    """Process one case to its end or to its limit; nothing of it lives afterwards.

    Whatever happens to its process is told in what is returned. Where the process left no reason itself, ``run.json``
    of the case is made to tell it, but not for a fault of the machine.

    Raises
    ------
    KeyboardInterrupt
        After the process has been stopped.
    """
    folder = work.results / case.case_id
    before = _stamp(folder)
    try:
        ended = run_limited(_command(case, work), _environment(work.request.jobs), work.request.limits)
    except OSError as error:
        return _not_started(case.case_id, error)
    attempt = _Attempt(case.case_id, folder, work.request.limits, ended, _stamp(folder) != before)
    end = _from_record(attempt) or _from_output(attempt)
    if end is None:
        end = _from_death(attempt)
        if not end.transient:
            _record(end, folder)
    return replace(end, seconds=ended.seconds, peak_mb=round(ended.peak_mb, 1))


def _command(case: ListedCase, work: CaseWork) -> list[str]:
    request = work.request
    places = ["--folder", str(case.folder), "--results", str(work.results)]
    settings = [word for one in request.overrides for word in ("--set", one)]
    how = ["--protocol", request.protocol, "--jobs", str(request.jobs), *settings]
    return [*work.program, "run", *places, *how, "--", case.case_id]


def _environment(jobs: int) -> Mapping[str, str]:
    threads = str(jobs or len(os.sched_getaffinity(0)))
    return dict.fromkeys(_THREADS, threads) | os.environ


def _stamp(folder: Path) -> tuple[int, ...]:
    """Changes with every writing of ``run.json``, which is always a new file; empty where there is none."""
    with suppress(OSError):
        found = (folder / _RECORD).lstat()
        return found.st_ino, found.st_mtime_ns, found.st_ctime_ns, found.st_size
    return ()


def _from_record(attempt: _Attempt) -> CaseEnd | None:
    """What this process wrote into ``run.json`` as its end.

    One that was stopped at a limit may have taken the death of its helpers for a fault of the case: of such a one only
    a complete result counts.
    """
    record = load_record(attempt.folder) if attempt.recorded else None
    last = record.outcome if record and record.state == "finished" else None
    if last is None or last.case_id != attempt.case_id or last.exit_code != attempt.ended.code:
        return None
    if attempt.ended.over and last.code is not None:
        return None
    end = CaseEnd(last.case_id, last.word, last.code or "", last.problem or "", last.action or "")
    return replace(end, transient=_is_transient(last.exit_code, end.code))


def _from_output(attempt: _Attempt) -> CaseEnd | None:
    """What it printed as its last words, where it came to an orderly end before it could write anything."""
    found = [] if attempt.ended.over else list(_REASON.finditer(attempt.ended.output))
    if attempt.ended.code not in _TOLD or not found:
        return None
    code, problem, action = (printable(text)[:_LONGEST] for text in found[-1].group("code", "problem", "action"))
    word: Word = "REJECTED" if attempt.ended.code == ExitCode.REJECTED else "ERROR"
    return CaseEnd(attempt.case_id, word, code, problem, action, transient=_is_transient(attempt.ended.code, code))


def _is_transient(exit_code: int, code: str) -> bool:
    return exit_code == ExitCode.ENVIRONMENT and code != _LASTING


def _from_death(attempt: _Attempt) -> CaseEnd:
    """What is left to say of one that told nothing."""
    name, limits, ended = attempt.case_id, attempt.limits, attempt.ended
    if ended.over == "time":
        problem = f"{name} did not end within {limits.time_s / 60:.3g} min and was stopped."
        action = "Give each case more time (--time-limit-min) and run again; finished stages are kept."
        return CaseEnd(name, "ERROR", "E-JOB-01", problem, action)
    if ended.over == "memory":
        problem = f"{name} needed more than {limits.memory_mb} MB of memory and was stopped."
        action = "Give each case more memory (--memory-mb) or fewer processes (--jobs 1) and run again."
        return CaseEnd(name, "ERROR", "E-JOB-02", problem, action)
    by = attempt.stopped_by
    if by in {one.name for one in _STOPPED}:
        problem = f"{name} was stopped from outside ({by}); most often the computer ran out of memory."
        action = "Run fewer cases at once (--at-once), or limit the memory of each (--memory-mb), and run again."
        return CaseEnd(name, "ERROR", "E-JOB-03", problem, action, transient=True)
    if by:
        problem = f"{name} made the program crash ({by})."
        action = f"Run it alone (ct2lut run {name}); if it crashes again, report this line and the version."
        return CaseEnd(name, "ERROR", "E-JOB-04", problem, action)
    problem = f"{name} ended with exit code {ended.code} and left no result."
    action = f"Run it alone (ct2lut run {name}) and read what it says; report this line if it says nothing."
    return CaseEnd(name, "ERROR", "E-JOB-05", problem, action)


def _not_started(case_id: str, error: OSError) -> CaseEnd:
    """Also a fault of the machine: no case can be started, or this one could not at this moment."""
    problem = f"{case_id} could not be started ({errno.errorcode.get(error.errno or 0, type(error).__name__)})."
    action = "Look whether the program is there (ct2lut doctor) and whether the computer is full; run again."
    return CaseEnd(case_id, "ERROR", "E-JOB-06", problem, action, transient=True)


def _record(end: CaseEnd, folder: Path) -> None:
    """Best effort: ``ct2lut status`` and the overview then show the reason as that of any other run."""
    outcome = RunOutcome(end.case_id, end.word, ExitCode.ERROR, (), end.code, end.problem, end.action)
    with suppress(PipelineError), case_lock(folder):
        save_record(folder, RunRecord("finished", outcome))
        RunLog(folder / LOG_FILE, end.case_id).write(LogLine("error", f"ERROR {end.problem}", code=end.code))
