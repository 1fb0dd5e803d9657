"""``log.jsonl``: the history of a case, one JSON object a line, without patient data.

The log is history, never truth: nothing is decided by reading it, and a line that cannot be written stops nothing.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import traceback
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePath
from typing import Literal

from pipeline.engine.store import open_or_create

LOG_FILE = "log.jsonl"

Level = Literal["info", "warning", "error"]

# Libraries quote file contents and paths in their messages, and those may hold names.
_PRIVATE = re.compile(r"'[^']*'|\"[^\"]*\"|(?:/[^\s/:,;'\"]+){2,}")


@dataclass(frozen=True)
class LogLine:
    """One event; ``seconds`` is how long it took, where that means something."""

    level: Level
    msg: str
    stage: str | None = None
    code: str | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class RunLog:
    """The log of one case."""

    path: Path
    case_id: str

    def write(self, line: LogLine) -> None:
        """Append one event, in one system call."""
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        fields = {"ts": now, "id": self.case_id, "stage": line.stage, "level": line.level, "code": line.code}
        event = {**fields, "msg": line.msg, "seconds": None if line.seconds is None else round(line.seconds, 3)}
        with suppress(OSError):
            append_line(self.path, event)


def printable(text: str) -> str:
    """Text with control characters and other non-printing signs escaped, so that it cannot steer a terminal."""
    return "".join(sign if sign.isprintable() else sign.encode("unicode_escape").decode() for sign in text)


def private_traceback(error: BaseException) -> str:
    """A traceback whose messages have quoted text and absolute paths blotted out.

    Frames show the last three parts of the file name, the line and the function; source lines are not quoted.
    """
    return "\n".join(line for one in _chain(error) for line in _lines(one))


def error_id(error: BaseException) -> str:
    """Eight hexadecimal digits that are the same each time the same line fails in the same way."""
    return hashlib.sha256("\n".join(_frames(error)).encode()).hexdigest()[:8]


def append_line(path: Path, event: Mapping[str, object]) -> None:
    """Append a JSON object as one line, in one system call; the file is made where it is not there.

    Raises
    ------
    OSError
    """
    line = json.dumps(event).replace("\x7f", "\\u007f").encode() + b"\n"
    descriptor = open_or_create(path, os.O_RDWR | os.O_APPEND)
    try:
        size = os.fstat(descriptor).st_size
        torn = size > 0 and os.pread(descriptor, 1, size - 1) != b"\n"  # a run was killed in the middle of a line
        os.write(descriptor, b"\n" * torn + line)
    finally:
        os.close(descriptor)


def _chain(error: BaseException) -> Iterator[BaseException]:
    # First the error that started it, as Python prints it.
    earlier = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    if earlier is not None:
        yield from _chain(earlier)
    yield error


def _lines(error: BaseException) -> Iterator[str]:
    yield from _frames(error)
    yield f"{type(error).__name__}: {_PRIVATE.sub('…', str(error))}"


def _frames(error: BaseException) -> list[str]:
    frames = traceback.extract_tb(error.__traceback__)
    return [f"{'/'.join(PurePath(frame.filename).parts[-3:])}:{frame.lineno} in {frame.name}" for frame in frames]
