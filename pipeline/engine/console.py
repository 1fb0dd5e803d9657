"""Listeners that show a run to a person: plain lines, or on a terminal also a bar for the stage at work."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import TYPE_CHECKING

from pipeline.engine.outcome import Listener, StageOutcome
from pipeline.engine.runlog import printable
from pipeline.engine.stage import Severity

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

Write = Callable[[str], object]


def console_listener(write: Write, *, terminal: bool) -> Listener:
    """A listener that shows one line a stage.

    Parameters
    ----------
    write : callable
        Takes text as it is to appear, with its line ends, such as ``sys.stdout.write``.
    terminal : bool
        Whether it appears on a terminal, where a bar can be drawn and wiped.
    """
    return TerminalListener(write) if terminal else PlainListener(write)


def stage_lines(outcome: StageOutcome, index: int, total: int) -> tuple[str, ...]:
    """What to show of a stage that ended: one line, and one for each finding that a person must look at.

    Such as ``[1/8] intake     ok        0.3 s  ran (no result yet)``.
    """
    to_look_at = [finding for finding in outcome.findings if finding.severity is Severity.REVIEW]
    word = "review" if to_look_at else "ok"
    if outcome.state == "failed":
        word = "halted" if outcome.reason == "interrupted" else "failed"
    why = f"ran ({outcome.reason})" if outcome.state == "ran" else outcome.reason
    head = f"[{index}/{total}] {outcome.stage:<10} {word:<6} {outcome.seconds:7.1f} s  {printable(why)}"
    return (head, *(f"      {finding.code} {printable(finding.message)}" for finding in to_look_at))


class PlainListener:
    """Lines only, for files, pipes and schedulers."""

    def __init__(self, write: Write) -> None:
        self._write = write

    def stage_started(self, stage: str, index: int, total: int, reason: str) -> None:
        """Show nothing; the line of a stage comes when it ends."""

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        """Show nothing."""

    def stage_finished(self, outcome: StageOutcome, index: int, total: int) -> None:
        """Show how the stage ended."""
        for line in stage_lines(outcome, index, total):
            self._write(f"{line}\n")


class TerminalListener:
    """The same lines, and below them a bar while a stage computes."""

    def __init__(self, write: Write) -> None:
        self._lines = PlainListener(write)
        self._write = write
        self._progress: Progress | None = None
        self._task: TaskID | None = None

    def stage_started(self, stage: str, index: int, total: int, reason: str) -> None:
        """Draw the bar."""
        self._progress = _bar(self._write)
        self._progress.start()
        self._task = self._progress.add_task(f"[{index}/{total}] {stage:<10} {printable(reason)}", total=None)

    def stage_progress(self, stage: str, done: int, total: int) -> None:  # noqa: ARG002 -- given to every listener
        """Move the bar."""
        if self._progress is not None and self._task is not None:
            self._progress.update(self._task, completed=done, total=total)

    def stage_finished(self, outcome: StageOutcome, index: int, total: int) -> None:
        """Wipe the bar and show how the stage ended."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = self._task = None
        self._lines.stage_finished(outcome, index, total)


class _Sink(io.TextIOBase):
    """A text file for rich that hands everything to a callable."""

    def __init__(self, write: Write) -> None:
        super().__init__()
        self._hand_over = write

    def write(self, text: str, /) -> int:
        self._hand_over(text)
        return len(text)


def _bar(write: Write) -> Progress:
    # Imported here: a run that finds everything up to date draws no bar and should not wait for it.
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import (  # noqa: PLC0415
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (BarColumn(24), TimeElapsedColumn(), TimeRemainingColumn())
    console = Console(file=_Sink(write), force_terminal=True)  # type: ignore[arg-type]
    return Progress(TextColumn("{task.description}", markup=False), *columns, console=console, transient=True)
