"""A stage that reads foreign bytes works in a child process with limits, so that a hostile file costs one case.

The child is forked, seals itself (``sandbox``) and answers over a socket: each message is a JSON list, and the contents
of files follow the message that announces them. Nothing is unpickled, and nothing is believed without a look.
"""

from __future__ import annotations

import errno
import json
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NoReturn

from pipeline.engine.artifacts import Artifact, Files
from pipeline.engine.runlog import error_id, printable, private_traceback
from pipeline.engine.sandbox import SEALED, seal, usable_bytes
from pipeline.engine.stage import Findings, Limits, Stage
from pipeline.engine.storage_faults import is_environmental
from pipeline.engine.wiring import findings_artifact
from pipeline.errors import CaseRejected, ConfigError, EnvironmentFault, PipelineError

#: Largest message, and largest sum of all files that a child may hand back.
_MESSAGE_BYTES = 4_000_000
_RESULT_BYTES = 6_000_000_000
#: Longest text of a traceback that is taken into the log.
_TRACE_SIGNS = 20_000
#: Given back when memory ran out, so that there is some to say so.
_RESERVE_BYTES = 32_000_000
#: How long a child that has closed its socket may take to end.
_GRACE_S = 5.0

#: How a child ended that said what nobody understands.
_BABBLE = None
_ERRORS = {kind.__name__: kind for kind in (CaseRejected, ConfigError, EnvironmentFault)}
_EXPORT_AGAIN = "Export the series or the label map again from the PACS or the segmentation program, uncompressed."


class ConfinedBug(Exception):
    """A mistake of the program in the child: the number of the error, and its private traceback."""

    def __init__(self, number: str, trace: str) -> None:
        super().__init__(number)
        self.number, self.trace = number, trace


@dataclass(frozen=True)
class Made:
    """What a stage made: its findings, artifact name -> encoded files, and how long its parts took (seconds).

    Parts of a confined stage stay in its process.
    """

    findings: Findings
    held: Mapping[str, Files]
    parts: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Confinement:
    """The parent's side of a confined stage.

    Attributes
    ----------
    stage : Stage
        With limits.
    readable : sequence of Path
        Folders with data that the child may read.
    files : collection of str
        Names of the case's files, the only ones that a message may name.
    progress : callable
        Told ``(done, total)``.
    warn : callable
        Told a sentence when the system cannot seal the child completely.
    """

    stage: Stage
    readable: Sequence[Path]
    files: Collection[str]
    progress: Callable[[int, int], None]
    warn: Callable[[str], None]

    @property
    def limits(self) -> Limits:
        """Those of the stage."""
        return self.stage.limits or Limits()


@dataclass(frozen=True)
class Channel:
    """The child's side: what it says while it works."""

    connection: Connection

    def opened(self, file: str) -> None:
        """Say which file is read next."""
        self.say("opened", file)

    def progress(self, done: int, total: int) -> None:
        """Say how far the stage is."""
        self.say("progress", done, total)

    def say(self, *words: Any) -> None:
        """Send one message."""
        self.connection.send_bytes(json.dumps(words).encode())

    def hand_over(self, stage: Stage, made: Made) -> None:
        """Send what the stage made; the findings end it."""
        for name, files in made.held.items():
            self.say("artifact", name, list(files))
            for data in files.values():
                self.connection.send_bytes(data)
        self.say("findings")
        self.connection.send_bytes(findings_artifact(stage.name).encode(made.findings)[""])

    def fail(self, error: BaseException) -> None:
        """Send why there is no result."""
        if isinstance(error, PipelineError):
            self.say("error", type(error).__name__, error.code, error.problem, error.action)
        elif isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
            self.say("memory")
        elif isinstance(error, OSError) and is_environmental(error) and not isinstance(error, PermissionError):
            self.say("system", error.errno)  # a permission is what this process gave up, not what the machine lacks
        else:
            self.say("bug", error_id(error), private_traceback(error)[-_TRACE_SIGNS:])


@contextmanager
def confined(confinement: Confinement, work: Callable[[Channel], Made]) -> Iterator[Callable[[], Made]]:
    """A child process that does ``work`` from the moment this is entered; it is gone when this is left.

    Enter it before threads are started: what they hold locked would stay locked in the child.

    Parameters
    ----------
    confinement : Confinement
    work : callable
        Called in the child; it cannot start processes.

    Yields
    ------
    callable
        Waits for the result. Raises what ``work`` raised where it is a PipelineError or speaks of the machine,
        CaseRejected ``E-IO-19`` when the child died, ``E-IO-20`` when it needed too much memory, ``E-IO-21`` when it
        took too long, and ConfinedBug for all else.
    """
    fork = get_context("fork")
    here, there = fork.Pipe()
    process = fork.Process(target=_live, args=(confinement, work, there, os.getpid()))
    try:
        _start(process)
        there.close()
        # once it speaks it holds nothing of the parent's any more, such as the lock
        here.poll(confinement.limits.wall_s)
        yield _Conversation(confinement, here, process).result
    finally:
        _end(process)
        here.close()


def _start(process: BaseProcess) -> None:
    """Fork; a signal reaches the parent before or after it, and the child never as a Python exception."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        with warnings.catch_warnings():
            # numpy keeps threads that know how to be forked
            warnings.filterwarnings("ignore", "This process .* is multi-threaded", DeprecationWarning)
            process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _live(confinement: Confinement, work: Callable[[Channel], Made], connection: Connection, parent: int) -> None:
    """What the child does from its first to its last moment."""
    channel = Channel(connection)
    reserve = [bytearray(_RESERVE_BYTES)]
    try:
        channel.say("sealed", *seal(confinement.limits, confinement.readable, connection.fileno(), parent))
        channel.hand_over(confinement.stage, work(channel))
    except BaseException as error:  # noqa: BLE001 -- libraries exit too; here all of it is told and ends
        reserve.clear()
        channel.fail(error)


def _end(process: BaseProcess) -> None:
    if process.pid is None:
        return
    with suppress(ProcessLookupError):  # it has not come so far as to lead a group
        os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.join()
    process.close()


def _is_whole(artifact: Artifact[Any], files: Files) -> bool:
    return artifact.is_folder or set(files) == {""}


@dataclass
class _Conversation:
    """What a child has said so far; it may be anything, once a library has been taken over by what it read."""

    confinement: Confinement
    connection: Connection
    process: BaseProcess
    file: str | None = None
    late: bool = False
    sealed: bool = False
    taken: int = 0
    held: dict[str, Files] = field(default_factory=dict)

    def result(self) -> Made:
        """Wait until the child has told all."""
        alarm = threading.Timer(self.confinement.limits.wall_s, self._stop)
        alarm.daemon = True
        alarm.start()
        try:
            while (made := self._take(self._message())) is None:
                pass
            return made
        finally:
            alarm.cancel()
            alarm.join()

    def _stop(self) -> None:
        self.late = True
        self.process.kill()

    def _message(self) -> Any:
        try:
            return json.loads(self._received(_MESSAGE_BYTES))
        except (ValueError, RecursionError) as error:
            raise self._refusal(_BABBLE) from error

    def _content(self) -> bytes:
        data = self._received(_RESULT_BYTES - self.taken)
        self.taken += len(data)
        return data

    def _received(self, most: int) -> bytes:
        try:
            return self.connection.recv_bytes(most)
        except (EOFError, OSError) as error:
            raise self._refusal(self._ending()) from error

    def _ending(self) -> int | None:
        """How the child ended, minus the signal; None while it has not."""
        # not join(): its end of the pipe that tells of its end is closed with all others
        deadline = time.monotonic() + _GRACE_S
        while self.process.exitcode is None and time.monotonic() < deadline:
            time.sleep(0.005)
        return self.process.exitcode

    def _take(self, words: Any) -> Made | None:
        match words:
            case ["opened", str(file)] if file in self.confinement.files:
                self.file = file
            case ["progress", int(done), int(total)]:
                self.confinement.progress(done, total)
            case ["artifact", str(name), [*names]] if all(isinstance(one, str) for one in names):
                self.held[name] = {one: self._content() for one in names}
            case ["sealed", *places] if not self.sealed:
                self.sealed = True
                for place in (one for one in SEALED if one in places):
                    self.confinement.warn(f"what reads foreign files could not be kept from {place}")
            case ["findings"]:
                return self._made()
            case _:
                self._fail(words)
        return None

    def _made(self) -> Made:
        stage, content = self.confinement.stage, self._content()
        try:
            findings = findings_artifact(stage.name).decode({"": content})
        except ValueError as error:
            raise self._refusal(_BABBLE) from error
        if not all(one.name in self.held and _is_whole(one, self.held[one.name]) for one in stage.writes):
            raise self._refusal(_BABBLE)
        return Made(findings, {one.name: self.held[one.name] for one in stage.writes})

    def _fail(self, words: Any) -> NoReturn:
        match words:
            case ["error", str(kind), str(code), str(problem), str(action)]:
                raise _ERRORS.get(kind, PipelineError)(*map(printable, (code, problem, action)))
            case ["memory"]:
                raise self._refusal(-signal.SIGKILL)
            case ["system", int(number)]:
                raise OSError(number, os.strerror(number))
            case ["bug", str(number), str(trace)]:
                raise ConfinedBug(printable(number), trace[-_TRACE_SIGNS:])
        raise self._refusal(_BABBLE)

    def _refusal(self, ending: int | None) -> CaseRejected:
        """Why there is no result, from how the child ended; the kernel kills what needs more memory than there is."""
        where, limits = self.file or "The case folder", self.confinement.limits
        if self.late or ending == -signal.SIGXCPU:
            problem = f"{where} could not be read safely: it took longer than {limits.wall_s / 60:.0f} min."
            return CaseRejected("E-IO-21", problem, _EXPORT_AGAIN)
        if ending == -signal.SIGKILL:
            problem = (
                f"{where} could not be read safely: it needs more than {usable_bytes(limits) / 1e9:.0f} GB of memory."
            )
            return CaseRejected("E-IO-20", problem, "Export only the part of the scan that shows the joint.")
        how = "fell silent" if ending is None or ending >= 0 else f"crashed ({signal.strsignal(-ending) or -ending})"
        problem = f"{where} could not be read safely: the reader {how}."
        return CaseRejected("E-IO-19", problem, _EXPORT_AGAIN)
