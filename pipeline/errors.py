"""The exception tree, and the one place where exit codes are decided.

    PipelineError
    |- ConfigError        usage or settings, found before any work            exit 20
    |- EnvironmentFault   disk, permission, renderer: not the case's fault    exit 30
    |- CaseRejected       the input cannot be used; a cohort goes on          exit 10
    `- anything else      a bug: traceback in the log, one line on screen     exit 70

A case that was computed but has a finding of severity ``review`` is not an exception: it is kept, flagged, and
exits 11. An interrupt exits 130.
"""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """What the process returns; the words are those of the report."""

    PASS = 0
    REJECTED = 10
    REVIEW = 11
    USAGE = 20
    ENVIRONMENT = 30
    ERROR = 70
    INTERRUPTED = 130


class PipelineError(Exception):
    """A failure we understand.

    Parameters
    ----------
    code : str
        Short stable name, such as ``E-LBL-01``; documented in ``docs/messages.md``.
    problem : str
        One sentence: what, in which file, expected, got.
    action : str
        One sentence: what to do next.
    """

    exit_code = ExitCode.ERROR

    def __init__(self, code: str, problem: str, action: str) -> None:
        super().__init__(f"{code} {problem} {action}")
        self.code = code
        self.problem = problem
        self.action = action

    def __reduce__(self) -> tuple[type[PipelineError], tuple[str, str, str]]:
        """How a worker process sends it home."""
        return type(self), (self.code, self.problem, self.action)


class ConfigError(PipelineError):
    """Usage or settings are wrong; nothing was done."""

    exit_code = ExitCode.USAGE


class EnvironmentFault(PipelineError):
    """The machine, not the case: disk, permission, renderer, lock."""

    exit_code = ExitCode.ENVIRONMENT


class CaseRejected(PipelineError):
    """The input of this case cannot be used."""

    exit_code = ExitCode.REJECTED
