"""A queue of a few lines, behind the three commands that the profile `generic` wants of a site.

python local_queue.py FOLDER submit MEMORY_MB MINUTES PROCESSORS SCRIPT | status JOB | cancel JOB...
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

#: Leaves its exit code in a file.
RUNNER = 'sh "$1" > "$2.log" 2>&1; echo $? > "$2.part"; mv "$2.part" "$2.code"'


def submit(folder: Path, asked: list[str], script: str) -> str:
    """Start a script, at once; its number is that of its session."""
    job = folder / str(len(list(folder.glob("*.asked"))))
    job.with_suffix(".asked").write_text(" ".join(asked))
    process = subprocess.Popen(
        ["/bin/sh", "-c", RUNNER, "job", script, str(job)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    job.with_suffix(".pid").write_text(str(process.pid))
    return job.name


def status(folder: Path, job: str) -> str:
    """How a job is doing."""
    path = folder / f"{job}.code"
    if path.exists():
        return "success" if path.read_text().strip() == "0" else "failed"
    alive = Path(f"/proc/{(folder / f'{job}.pid').read_text()}/stat")
    return "running" if alive.exists() and ") Z " not in alive.read_text() else "failed"


def cancel(folder: Path, jobs: list[str]) -> None:
    """End jobs with all that they started."""
    for job in jobs:
        with suppress(ProcessLookupError):
            os.killpg(int((folder / f"{job}.pid").read_text()), signal.SIGTERM)


if __name__ == "__main__":
    place = Path(sys.argv[1])
    match sys.argv[2:]:
        case ["submit", *asked, script]:
            sys.stdout.write(f"{submit(place, asked, script)}\n")
        case ["status", job]:
            sys.stdout.write(f"{status(place, job)}\n")
        case ["cancel", *jobs]:
            cancel(place, jobs)
