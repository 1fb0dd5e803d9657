"""A run that is killed or refused by the disk at any system call leaves old or new results, and resumes."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipeline.engine import runner
from pipeline.engine.artifacts import Files
from pipeline.engine.cache import altered_outputs
from pipeline.engine.manifest import Unusable, load_manifest
from pipeline.engine.outcome import CaseJob
from pipeline.engine.stage import StrictParams
from pipeline.errors import ExitCode
from tests.engine.crash_tools import Counter, in_child, intercepted, kill_self, wait
from tests.engine.toy_flow import (
    FLOW,
    GatherParams,
    MultiplyParams,
    SumParams,
    artifact_bytes,
    copy_case,
    leftovers,
    make_case,
    run,
)

#: Changes the bytes of every stage.
CHANGED: Mapping[str, StrictParams] = {
    "gather": GatherParams(keep=2),
    "multiply": MultiplyParams(factor=5.0),
    "total": SumParams(title="total"),
}


@dataclass(frozen=True)
class Prepared:
    """A finished case, the bytes of both settings, and the number of calls from one to the other."""

    job: CaseJob
    old: Files
    new: Files
    calls: int

    def copies(self, step: int) -> Iterator[tuple[int, CaseJob]]:
        for at in range(1, self.calls + 1, step):
            yield at, copy_case(self.job, self.job.source.parents[2] / f"at{at}")


@pytest.fixture
def prepared(tmp_path: Path) -> Prepared:
    job = make_case(tmp_path / "reference")
    run(job)
    old = artifact_bytes(job.results)
    twin = copy_case(job, tmp_path / "twin")
    counter = Counter()
    with intercepted(counter):
        run(twin, settings=CHANGED)
    return Prepared(job, old, artifact_bytes(twin.results), counter.calls)


def damage(prepared: Prepared, results: Path) -> list[str]:
    """Stages whose folder is neither absent nor exactly the old or the new result."""
    found = artifact_bytes(results)
    return [stage.folder for stage in FLOW if _is_damaged(prepared, results / stage.folder, found)]


def _is_damaged(prepared: Prepared, folder: Path, found: Files) -> bool:
    if not folder.exists():
        return False
    manifest = load_manifest(folder)
    if isinstance(manifest, Unusable) or list(altered_outputs(folder, manifest)):
        return True
    wanted = [_below(files, folder.name) for files in (prepared.old, prepared.new)]
    return _below(found, folder.name) not in wanted


def _below(files: Files, folder: str) -> Files:
    return {name: data for name, data in files.items() if name.startswith(f"{folder}/")}


def killed_at(at: int, job: CaseJob) -> int:
    def work() -> None:
        with intercepted(Counter(at, kill_self)):
            run(job, settings=CHANGED)

    return wait(in_child(work))


def assert_resumes(prepared: Prepared, job: CaseJob) -> None:
    outcome, _ = run(job, settings=CHANGED)
    assert outcome.word == "PASS"
    assert artifact_bytes(job.results) == prepared.new
    assert leftovers(job.results) == []


def test_a_kill_at_any_call_leaves_old_or_new_and_resumes(prepared: Prepared) -> None:
    assert prepared.calls > 60
    for at, job in prepared.copies(step=2):
        assert killed_at(at, job) == -9
        assert damage(prepared, job.results) == [], f"killed at call {at}"
        assert_resumes(prepared, job)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
@pytest.mark.parametrize("sticky", [False, True])
def test_a_refusing_disk_is_an_environment_fault_and_loses_nothing(
    prepared: Prepared, number: int, *, sticky: bool
) -> None:
    def refuse() -> None:
        raise OSError(number, os.strerror(number), "/secret/path")

    for at, job in prepared.copies(step=5):
        with intercepted(Counter(at, refuse, sticky=sticky)):
            outcome, _ = run(job, settings=CHANGED)
        assert outcome.exit_code in {ExitCode.ENVIRONMENT, ExitCode.PASS}, outcome
        assert outcome.exit_code == ExitCode.PASS or "secret" not in f"{outcome.problem}"
        assert damage(prepared, job.results) == [], f"refused at call {at}"
        assert_resumes(prepared, job)


def test_an_interrupt_at_any_call_leaves_old_or_new_and_resumes(prepared: Prepared) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    for at, job in prepared.copies(step=5):
        with pytest.raises(KeyboardInterrupt, match=r"^$"), intercepted(Counter(at, interrupt)):
            run(job, settings=CHANGED)
        assert damage(prepared, job.results) == [], f"interrupted at call {at}"
        assert not list(job.results.glob(".*.partial-*"))
        assert_resumes(prepared, job)


def test_a_disk_that_is_full_all_the_time_fails_every_run(prepared: Prepared) -> None:
    def refuse() -> None:
        raise OSError(errno.ENOSPC, "full")

    with intercepted(Counter(1, refuse, sticky=True)):
        outcome, _ = run(prepared.job, settings=CHANGED)
    assert outcome.exit_code == ExitCode.ENVIRONMENT
    assert artifact_bytes(prepared.job.results) == prepared.old


def test_the_same_harness_breaks_a_naive_writer(prepared: Prepared, monkeypatch: pytest.MonkeyPatch) -> None:
    def naive(folder: Path, files: Mapping[str, bytes]) -> None:
        for name, data in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(folder / name, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
            os.write(descriptor, data)
            os.close(descriptor)

    monkeypatch.setattr(runner, "commit_folder", naive)
    broken = 0
    for at, job in prepared.copies(step=4):
        killed_at(at, job)
        broken += bool(damage(prepared, job.results))
    assert broken >= 3
