"""What the doctor asks of the machine: memory, processors, limits, temporary files (Linux)."""

from __future__ import annotations

import os
import resource
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pipeline.commands.doctor_answer import Answer, State

#: What a patient takes at most with two processes: peak of `make bench`, 1.19 GB (docs/validation.md), rounded up.
PATIENT_BYTES = 1_200_000_000
#: What each process beyond two adds: the same patient with six takes 2.4 GB.
PROCESS_BYTES = 300_000_000

_PROC = Path("/proc")
_CGROUPS = Path("/sys/fs/cgroup")
#: Microseconds, where a group of processes does not say how long the period of its quota is.
_PERIOD_US = 100_000.0


@dataclass(frozen=True)
class Need:
    """What a user must be allowed to have at a time.

    Attributes
    ----------
    kind : int
        Of ``resource.getrlimit``.
    name : str
    least : int
    command : str
        What to type to have more.
    """

    kind: int
    name: str
    least: int
    command: str


#: A patient with two processes: 18 open files and 1.9 GB of addresses in one process, 24 threads in all.
NEEDS = (
    Need(resource.RLIMIT_NOFILE, "open files", 256, "ulimit -n 1024 (container: --ulimit nofile=1024:1024)"),
    Need(resource.RLIMIT_NPROC, "processes and threads", 128, "ulimit -u 4096 (container: --ulimit nproc=4096:4096)"),
    Need(resource.RLIMIT_FSIZE, "bytes in a file", 1_000_000_000, "ulimit -f unlimited"),
    Need(resource.RLIMIT_AS, "bytes of addresses", 4_000_000_000, "ulimit -v unlimited"),
)


def total_memory() -> int:
    """Bytes of memory of this machine, or what a container or a batch system leaves of it."""
    limits = [int(text) for text in _of_groups("memory.max", "memory", "memory.limit_in_bytes") if text != "max"]
    return min([_told("MemTotal"), *limits])


def usable_processors() -> int:
    """Processors that this process may use at a time, at least one."""
    return max(1, int(min([float(_jobs()), *_shares()])))


def memory() -> Answer:
    """Memory of this machine, or what a container or a batch system leaves of it, against what a patient takes."""
    total, jobs = total_memory(), _jobs()
    free = min(_told("MemAvailable"), total)
    taken = PATIENT_BYTES + PROCESS_BYTES * max(0, jobs - 2)
    found = f"{_gb(total)}, {_gb(free)} of it free; with --jobs {jobs} a patient takes up to {_gb(taken)} (make bench)"
    if total < PATIENT_BYTES:
        return Answer(found, State.FAIL, "Give this computer, container or batch job more memory, such as 4 GB.")
    if free < PATIENT_BYTES:
        return Answer(found, State.LOOK, "Close other programs; the largest are shown by: ps aux --sort=-rss | head")
    if free < taken:
        fewer = 2 + (free - PATIENT_BYTES) // PROCESS_BYTES
        return Answer(found, State.LOOK, f"Name the number of processes in every run: --jobs {fewer}")
    return Answer(found)


def processors() -> Answer:
    """How many processes a run starts by itself, against the processors that it may use."""
    jobs = _jobs()
    found = f"{jobs} of {os.cpu_count()}; a run starts {jobs} processes"
    share = min([float(jobs), *_shares()])
    if share < jobs:
        action = f"Name the number of processes in every run: --jobs {usable_processors()}"
        return Answer(f"{found} but may use only {share:g} processors at a time", State.LOOK, action)
    return Answer(found)


def limits() -> Answer:
    """What the user may have of this machine at a time, where that could be too little."""
    allowed = {need: _allowed(need) for need in NEEDS}
    low = {need: most for need, most in allowed.items() if most is not None and most < need.least}
    if low:
        found = "; ".join(f"{need.name} {most}, expected at least {need.least}" for need, most in low.items())
        return Answer(found, State.LOOK, f"Raise it before a run: {'; '.join(need.command for need in low)}")
    shown = (f"{need.name} {'unlimited' if most is None else most}" for need, most in list(allowed.items())[:2])
    return Answer(", ".join(shown))


def temporary() -> Answer:
    """Whether temporary files can be made where worker processes meet."""
    try:
        with tempfile.TemporaryDirectory(prefix="ct2lut-doctor-"):
            return Answer("a temporary folder can be made")
    except OSError:
        action = "Give it a writable /tmp (container: --tmpfs /tmp), or name a folder: export TMPDIR=FOLDER"
        return Answer("no temporary folder can be made; several processes cannot work together", State.FAIL, action)


def _told(key: str) -> int:
    """Bytes of memory that the kernel tells under this name."""
    told = dict(line.split(":", 1) for line in (_PROC / "meminfo").read_text().splitlines())
    return int(told[key].split()[0]) * 1024


def _jobs() -> int:
    """Processes that a run starts by itself."""
    return len(os.sched_getaffinity(0))


def _allowed(need: Need) -> int | None:
    """The limit in force; None where there is none."""
    most = resource.getrlimit(need.kind)[0]
    groups = _of_groups("pids.max", "pids", "pids.max") if need.kind == resource.RLIMIT_NPROC else ()
    known = [int(text) for text in groups if text != "max"] + ([] if most == resource.RLIM_INFINITY else [most])
    return min(known, default=None)


def _shares() -> Iterator[float]:
    """Processors that this process may use at a time, by each quota that holds for it."""
    for text in _of_groups("cpu.max", "cpu", "cpu.cfs_quota_us"):
        quota, _, period = text.partition(" ")
        if quota not in ("max", "-1"):
            yield float(quota) / float(period or _PERIOD_US)


def _of_groups(name: str, controller: str, old_name: str) -> Iterator[str]:
    """A limit as control groups state it, for this process's group and all above it.

    Parameters
    ----------
    name : str
        File of version 2 of the interface.
    controller, old_name : str
        Folder and file of version 1.

    Yields
    ------
    str
        Content of each file that is there.
    """
    with suppress(OSError):
        for line in (_PROC / "self" / "cgroup").read_text().splitlines():
            number, controllers, path = line.split(":", 2)
            folders = [PurePosixPath(path), *PurePosixPath(path).parents]
            if number == "0":
                yield from _contents([_CGROUPS / str(one).lstrip("/") / name for one in folders])
            elif controller in controllers.split(","):
                yield from _contents([_CGROUPS / controller / str(one).lstrip("/") / old_name for one in folders])


def _contents(files: list[Path]) -> Iterator[str]:
    for file in files:
        with suppress(OSError):
            yield file.read_text().strip()


def _gb(count: int) -> str:
    return f"{count / 1e9:.1f} GB"
