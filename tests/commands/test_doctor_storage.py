"""What the doctor finds of a disk: every refusal is named, and nothing is left behind."""

from __future__ import annotations

import errno
import os
import resource
import shlex
import signal
import stat
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.commands import doctor, doctor_storage
from pipeline.commands.doctor import Check, checked, examine
from pipeline.commands.doctor_answer import Answer, State
from tests.engine.crash_tools import Counter, intercepted

GB = 1_000_000_000
Patch = pytest.MonkeyPatch


def disk(free: int, files: int = 10**6, all_files: int = 10**7) -> Callable[[object], SimpleNamespace]:
    return lambda _: SimpleNamespace(
        f_frsize=4096, f_bavail=free // 4096, f_blocks=100 * GB // 4096, f_favail=files, f_files=all_files
    )


@pytest.mark.parametrize(
    ("free", "state", "room"),
    [(1_000_000, State.FAIL, 0), (299_000_000, State.FAIL, 1), (GB, State.LOOK, 6), (30 * GB, State.OK, 199)],
)
def test_room_for_results(monkeypatch: Patch, tmp_path: Path, free: int, state: State, room: int) -> None:
    monkeypatch.setattr(os, "statvfs", disk(free))
    answer = doctor_storage.room(tmp_path / "it's")
    assert (answer.state, answer.found.rpartition(" ")[2]) == (state, str(room))
    assert (shlex.quote(str(tmp_path)) in answer.action) == (state is not State.OK)


def test_sizes_are_readable(monkeypatch: Patch, tmp_path: Path) -> None:
    monkeypatch.setattr(os, "statvfs", disk(12288))
    assert doctor_storage.room(tmp_path).found.startswith("12 kB of 100.0 GB free; a result takes up to 150 MB: ")


def test_a_disk_may_run_out_of_files(monkeypatch: Patch, tmp_path: Path) -> None:
    monkeypatch.setattr(os, "statvfs", disk(30 * GB, files=1000))
    answer = doctor_storage.room(tmp_path)
    assert (answer.state, answer.found.endswith("room for 5, for only 1000 more files fit")) == (State.LOOK, True)
    monkeypatch.setattr(os, "statvfs", disk(30 * GB, files=0, all_files=0))
    assert doctor_storage.room(tmp_path).state is State.OK


STORAGE = {"results": doctor_storage.keeping, "locks": doctor_storage.locks, "clock": doctor_storage.clock}


@pytest.mark.parametrize("name", STORAGE)
@pytest.mark.parametrize("error", [errno.EIO, errno.ENOSPC, errno.EACCES])
def test_every_refusal_of_the_disk_is_named_and_leaves_nothing(tmp_path: Path, name: str, error: int) -> None:
    probe = partial(STORAGE[name], tmp_path)
    calls = Counter()
    with intercepted(calls):
        assert checked(name, probe).state is State.OK
    assert calls.calls >= 5
    refused = []
    for at in range(1, calls.calls + 1):
        with intercepted(Counter(at, partial(refuse, error))):
            refused.append(checked(name, probe))
        assert list(tmp_path.iterdir()) == [], at
    failed = [check for check in refused if check.state is State.FAIL]
    assert all(f"({errno.errorcode[error]})" in check.found and check.action for check in failed)
    # what is tried again for good: a permission of a lock file that somebody else made
    assert len(refused) - len(failed) <= (name == "locks" and error == errno.EACCES)


def refuse(error: int) -> None:
    raise OSError(error, os.strerror(error), "/secret/place")


@pytest.mark.parametrize(
    ("call", "found"),
    [
        ("mkdir", "Making a temporary folder"),
        ("fsync", "Synchronising a file"),
        ("chmod", "Setting the permissions of a file"),
        ("rename", "Renaming a file"),
        ("unlink", "Deleting a file"),
    ],
)
def test_each_step_is_named(tmp_path: Path, monkeypatch: Patch, call: str, found: str) -> None:
    monkeypatch.setattr(os, call, lambda *_, **__: refuse(errno.EROFS))
    check = checked("results", partial(doctor_storage.keeping, tmp_path))
    assert (check.state, check.found) == (State.FAIL, f"{found} failed: the disk is read-only (EROFS).")


@pytest.mark.parametrize(
    ("error", "state", "found"),
    [
        (errno.EIO, State.FAIL, "Synchronising a folder failed: the disk or network share reported an error (EIO)."),
        # what some network shares say
        (errno.EINVAL, State.OK, "written, synchronised, renamed and deleted"),
    ],
)
def test_a_folder_that_cannot_be_synchronised(
    tmp_path: Path, monkeypatch: Patch, error: int, state: State, found: str
) -> None:
    real = os.fsync

    def fsync(descriptor: int) -> None:
        real(descriptor) if stat.S_ISREG(os.fstat(descriptor).st_mode) else refuse(error)

    monkeypatch.setattr(os, "fsync", fsync)
    check = checked("results", partial(doctor_storage.keeping, tmp_path))
    assert (check.state, check.found[: len(found)]) == (state, found)


def test_a_disk_that_forgets_is_told(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr("pipeline.engine.store.fingerprint_on_disk", lambda _: None)
    check = checked("results", partial(doctor_storage.keeping, tmp_path))
    assert (check.state, check.found) == (State.FAIL, "The disk did not keep what was written to result.")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_on_a_real_file(tmp_path: Path, monkeypatch: Patch) -> None:
    """A limit of the process on the size of a file stands for a disk that is full in the middle of writing."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
        check = checked("results", partial(doctor_storage.keeping, tmp_path))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    assert (check.state, check.found[:22]) == (State.FAIL, "Writing a file failed:")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["file", "dangling link"])
def test_results_that_are_no_folder(tmp_path: Path, kind: str) -> None:
    place = tmp_path / "results"
    place.write_text("text") if kind == "file" else place.symlink_to("nowhere")
    checks = {check.name: check for check in storage_checks(place)}
    assert checks["results"].state is State.FAIL
    assert checks["results"].found == f"{place} is not a folder"
    assert all(checks[name].found == "not tried: the results folder cannot be used" for name in ("locks", "clock"))
    assert [path.name for path in tmp_path.iterdir()] == ["results"]


def storage_checks(results: Path) -> Iterator[Check]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(doctor, "PROBES", {})
        yield from examine(results)


def test_a_disk_without_locks_is_worth_a_look(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr("fcntl.flock", lambda *_: refuse(errno.ENOLCK))
    answer = doctor_storage.locks(tmp_path)
    assert (answer.state, answer.found) == (State.LOOK, "this disk has no locks")


def test_locks_that_do_not_exclude_are_worth_a_look(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr("fcntl.flock", lambda *_: None)
    answer = doctor_storage.locks(tmp_path)
    assert (answer.state, answer.found) == (State.LOOK, "two locks on one file do not exclude each other")


@pytest.mark.parametrize(("shift_s", "words"), [(3600, "3600 s behind"), (-90, "90 s ahead of")])
def test_a_clock_that_is_off(tmp_path: Path, monkeypatch: Patch, shift_s: float, words: str) -> None:
    now = doctor_storage._now
    monkeypatch.setattr(doctor_storage, "_now", lambda: now() + shift_s)
    answer = doctor_storage.clock(tmp_path)
    assert (answer.state, words in answer.found, "timedatectl" in answer.action) == (State.LOOK, True, True)


def test_clocks_that_are_as_even_as_those_of_a_memory_card(tmp_path: Path, monkeypatch: Patch) -> None:
    now = doctor_storage._now
    monkeypatch.setattr(doctor_storage, "_now", lambda: now() + 1.5)
    assert doctor_storage.clock(tmp_path) == Answer("disk and machine agree (1.5 s apart)")


def interrupt(_: Path) -> None:
    raise KeyboardInterrupt("stop")


def test_an_interrupt_leaves_nothing(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr(doctor_storage, "_synchronise", interrupt)
    with pytest.raises(KeyboardInterrupt, match="stop"):
        checked("results", partial(doctor_storage.keeping, tmp_path))
    assert list(tmp_path.iterdir()) == []
