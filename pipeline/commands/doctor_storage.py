"""What the doctor asks of the disk of the results: whether it does what a run relies on; nothing is left on it.

A results folder that is not there yet is not made: its nearest parent that is there answers for it.
"""

from __future__ import annotations

import errno
import os
import secrets
import shlex
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.commands.doctor_answer import Answer, State
from pipeline.engine.lock import case_lock, is_running
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import FOLDER_MODE, write_file

#: A result of a large CT: twice that of the phantom CT (docs/guide-server.md).
RESULT_BYTES = 150_000_000
#: Files and folders of a result, rounded up.
RESULT_FILES = 200
#: A new result is complete before the old one goes.
_LEAST_RESULTS = 2
_ENOUGH_RESULTS = 20
#: Clocks that are farther apart are not kept by the same service; the times of some disks are even to 2 s.
MOST_APART_S = 2.0

_TRIAL = b"ct2lut doctor\n" * 1000


def nearest(results: Path) -> Path:
    """The results folder, or the first of its parents that is there.

    Raises
    ------
    FileNotFoundError
        When not even the folder that the user is in is there.
    """
    for place in (results, *results.parents):
        if place.exists() or place.is_symlink():
            return place
    raise FileNotFoundError(errno.ENOENT, "no such folder", str(results))


def room(results: Path) -> Answer:
    """Free space, and files that can still be made, against a result."""
    folder = nearest(results)
    disk = os.statvfs(folder)
    free, total = disk.f_bavail * disk.f_frsize, disk.f_blocks * disk.f_frsize
    fits = free // RESULT_BYTES
    # file systems without a fixed number of files say 0
    if disk.f_files:
        fits = min(fits, disk.f_favail // RESULT_FILES)
    found = f"{_size(free)} of {_size(total)} free; a result takes up to {_size(RESULT_BYTES)}: room for {fits}"
    if disk.f_files and disk.f_favail // RESULT_FILES < _ENOUGH_RESULTS:
        found = f"{found}, for only {disk.f_favail} more files fit"
    if fits >= _ENOUGH_RESULTS:
        return Answer(found)
    action = f"Free space (what takes it: du -sh {shlex.quote(str(folder))}/*), or choose a disk: --results FOLDER"
    return Answer(found, State.FAIL if fits < _LEAST_RESULTS else State.LOOK, action)


def keeping(results: Path) -> Answer:
    """Make, write, synchronise, rename and delete, each named when it fails."""
    folder = nearest(results)
    if not folder.is_dir():
        return Answer(f"{folder} is not a folder", State.FAIL, "Choose another: ct2lut doctor --results FOLDER")
    begun = time.perf_counter()
    with _scratch(folder) as place:
        for doing, step in _steps(place):
            with storage(doing):
                step()
    seconds = time.perf_counter() - begun
    where = "" if folder == results else f"{results} is not there yet; tried in {_shown(folder)}: "
    return Answer(f"{where}written, synchronised, renamed and deleted ({1000 * seconds:.0f} ms)")


def _steps(place: Path) -> Iterator[tuple[str, Callable[[], object]]]:
    """What a run does with the disk, in its order."""
    new, done = place / "new", place / "done"
    yield "Making a folder", lambda: new.mkdir(FOLDER_MODE)
    yield "Writing a file", lambda: (new / "plain").write_bytes(_TRIAL)
    yield "Synchronising a file", lambda: _synchronise(new / "plain")
    yield "Setting the permissions of a file", lambda: (new / "plain").chmod(0o640)
    yield "Writing and reading back a result", lambda: write_file(new / "result", _TRIAL)
    yield "Synchronising a folder", lambda: _synchronise(new)
    yield "Renaming a file", lambda: (new / "plain").rename(new / "renamed")
    yield "Renaming a folder", lambda: new.rename(done)
    yield "Deleting a file", (done / "renamed").unlink
    yield "Deleting a folder", lambda: shutil.rmtree(done)


def locks(results: Path) -> Answer:
    """Whether a second run of a case would notice the first."""
    with _scratch(nearest(results)) as place, case_lock(place) as locked:
        noticed = is_running(place)
    if locked and noticed:
        return Answer("a second run of a case is kept out while the first is at work")
    problem = "this disk has no locks" if not locked else "two locks on one file do not exclude each other"
    action = "Never start two runs of one case at a time; or choose a disk with locks: --results FOLDER"
    return Answer(problem, State.LOOK, action)


def clock(results: Path) -> Answer:
    """The clock of the disk, which a file server may have of its own, against that of this machine."""
    with _scratch(nearest(results)) as place:
        file = place / "now"
        before = _now()
        write_file(file, _TRIAL)
        after, told = _now(), file.stat().st_mtime
    ahead = told - min(max(told, before), after)
    if abs(ahead) <= MOST_APART_S:
        return Answer(f"disk and machine agree ({abs(ahead):.1f} s apart)")
    way = "ahead of" if ahead > 0 else "behind"
    found = f"the disk's clock is {abs(ahead):.0f} s {way} this machine's; results stay right, times in logs do not"
    return Answer(found, State.LOOK, "Let both follow a time server; see: timedatectl status")


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """A folder of our own, which is gone afterwards, whatever happens inside."""
    place = folder / f".ct2lut-doctor.partial-{secrets.token_hex(16)}"
    try:
        with storage("Making a temporary folder"):
            place.mkdir(FOLDER_MODE)
        yield place
        with storage("Deleting a temporary folder"):
            shutil.rmtree(place)
    except BaseException:
        shutil.rmtree(place, ignore_errors=True)
        raise


def _synchronise(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL or path.is_file():  # some network shares cannot synchronise a folder
            raise
    finally:
        os.close(descriptor)


def _now() -> float:
    return time.time()


def _shown(folder: Path) -> str:
    return "the folder you are in" if folder == Path() else str(folder)


def _size(count: int) -> str:
    size, unit = next(((size, unit) for size, unit in ((1e9, "GB"), (1e6, "MB")) if count >= size), (1e3, "kB"))
    return f"{count / size:.{int(unit == 'GB')}f} {unit}"
