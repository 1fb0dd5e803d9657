"""Only what runs leave behind goes, only when it is old by the disk's own clock, and never through a link."""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline import __version__
from pipeline.cohort import cleaning
from pipeline.cohort.cleaning import Cleaned, Leftover, clean, cleaned_lines, leftovers, remove
from pipeline.commands.cohort_index import FORMAT, Entry, Index
from pipeline.commands.repair import repair_case
from pipeline.engine.inspection import verify_case
from pipeline.engine.lock import case_lock
from pipeline.engine.outcome import CaseJob
from pipeline.engine.records import record_artifact
from pipeline.engine.store import commit_folder
from pipeline.errors import ConfigError, EnvironmentFault
from pipeline.report.cohort_page import CaseRow
from tests.engine.crash_tools import Counter, in_child, intercepted, kill_self, wait
from tests.engine.toy_flow import FLOW, make_case, run

HEX = "0123456789abcdef" * 2
DAY_S = 86_400


@pytest.fixture
def job(tmp_path: Path) -> CaseJob:
    made = make_case(tmp_path)
    assert run(made)[0].word == "PASS"
    return made


@pytest.fixture
def later(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Let the disk say that so many days have gone by since everything was written."""
    disk_time = cleaning._disk_time

    def pass_days(days: float) -> None:
        monkeypatch.setattr(cleaning, "_disk_time", lambda folder: disk_time(folder) + days * DAY_S)

    return pass_days


def names(results: Path, days: float = 7.0) -> list[str]:
    return sorted(one.path.relative_to(results).as_posix() for one in leftovers(results, days))


def everything(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def fill(results: Path) -> list[str]:
    """Leftovers of every kind and place; their names."""
    files = [
        f".index.html.partial-{HEX}",
        f".ct2lut-doctor.partial-{HEX}/new",
        f"cohort.files/.plan.json.partial-{HEX}",
        f"cohort.files/workflow/.config.json.partial-{HEX}",
        f"cohort.files/workflow/batches/.P1.csv.partial-{HEX}",
        "cohort.files/workflow/.snakemake/log/2026-11-22T163705.123456.snakemake.log",
        "cohort.files/engine.log.1",
        f"index.files/{HEX}.jpg",
        f"index.files/.{HEX}.jpg.partial-{HEX}",
        f"P1/.run.json.partial-{HEX}",
        f"P1/.20_multiply.old-{HEX}/stage.json",
        ".quarantine-x-01234567",
    ]
    for name in files:
        (results / name).parent.mkdir(parents=True, exist_ok=True)
        (results / name).write_bytes(b"x" * 1000)
    folders = {f".ct2lut-doctor.partial-{HEX}/new": "new", f"P1/.20_multiply.old-{HEX}/stage.json": "stage.json"}
    return sorted(name.removesuffix(f"/{folders.get(name, '')}") for name in files)


def write_index(results: Path, *pictures: str) -> None:
    entries = {f"P{n}": Entry("k", CaseRow(f"P{n}", "PASS", pictures=one)) for n, one in enumerate(pictures)}
    index = record_artifact("cohort_index", "index.json", Index)
    (results / "index.json").write_bytes(index.encode(Index(FORMAT, __version__, entries))[""])


def test_every_kind_is_found_when_it_is_old_and_the_rest_stays(job: CaseJob, later: Callable[[float], None]) -> None:
    results = job.results.parent
    (results / "cohort.files").mkdir()
    (results / "cohort.files/engine.log").write_text("of the engine at work")
    (results / "cohort.csv").write_text("id")
    write_index(results, "f" * 32 + ".jpg")
    before = everything(results)
    made = fill(results)
    (results / "index.files" / ("f" * 32 + ".jpg")).write_bytes(b"shown")
    (results / "index.files/mine.jpg").write_bytes(b"of somebody else")
    assert names(results) == []
    later(6.9)
    assert names(results) == []
    later(7.1)
    assert names(results) == made
    clean(results)
    assert names(results) == []
    kept = {f"index.files/{'f' * 32}.jpg": b"shown", "index.files/mine.jpg": b"of somebody else"}
    assert everything(results) == before | kept
    assert verify_case(job.results, FLOW) == ()


def test_the_clock_of_this_machine_decides_nothing(
    job: CaseJob, monkeypatch: pytest.MonkeyPatch, later: Callable[[float], None]
) -> None:
    results = job.results.parent
    fill(results)
    monkeypatch.setattr("time.time", lambda: 4e9)
    assert names(results) == []
    later(8)
    monkeypatch.setattr("time.time", lambda: 0.0)
    assert len(names(results)) == 11


def test_times_of_files_in_the_future_or_in_1970_remove_nothing_early(
    job: CaseJob, later: Callable[[float], None]
) -> None:
    results = job.results.parent
    old, new = results / f".a.partial-{HEX}", results / f".b.partial-{HEX}"
    for path, time in ((old, 0), (new, 4e9)):
        path.write_bytes(b"x")
        os.utime(path, (time, time))
    assert names(results) == []
    later(8)
    assert names(results) == [old.name]


def test_a_damaged_stage_that_was_set_aside_counts_from_then_on(job: CaseJob, later: Callable[[float], None]) -> None:
    stage = job.results / "20_multiply"
    (stage / "stage.json").write_bytes(b"{")
    for path in (*stage.rglob("*"), stage):
        os.utime(path, (0, 0))
    repair_case(job.results, FLOW)
    run(job)
    assert names(job.results.parent) == []
    later(7.5)
    (name,) = names(job.results.parent)
    assert name.startswith("P1/.quarantine-20_multiply-")
    (removed,) = clean(job.results.parent).removed
    assert removed.bytes > 100
    assert removed.kind == "quarantine"
    assert verify_case(job.results, FLOW) == ()


def test_the_only_copy_of_a_result_is_never_removed(job: CaseJob, later: Callable[[float], None]) -> None:
    """Killed between moving the old result away and renaming the new one: the next run puts the old one back."""
    stage = job.results / "20_multiply"
    stage.rename(stage.with_name(f".20_multiply.old-{HEX}"))
    later(1000)
    assert names(job.results.parent) == []
    assert [one.state for one in run(job)[0].stages] == ["cached"] * 3


def test_what_a_killed_commit_leaves_is_known(tmp_path: Path, later: Callable[[float], None]) -> None:
    """The names of the store and those that are looked for are the same."""
    case = tmp_path / "P1"
    case.mkdir()
    for kill_at in range(1, 60):

        def work(at: int = kill_at) -> None:
            with intercepted(Counter(at, kill_self)):
                commit_folder(case / "10_a", {"x": b"1", "deep/y": b"2"})

        if wait(in_child(work)) == 0:
            break
    else:
        pytest.fail("the commit never came to its end")
    left = {path.name for path in case.iterdir()} - {"10_a"}
    assert len(left) > 3
    later(8)
    assert {one.path.name for one in leftovers(tmp_path)} == left
    clean(tmp_path)
    assert [path.name for path in case.iterdir()] == ["10_a"]


def test_a_case_that_runs_is_left_alone(job: CaseJob, later: Callable[[float], None]) -> None:
    results = job.results.parent
    path = job.results / f".run.json.partial-{HEX}"
    path.write_bytes(b"x")
    later(8)
    (found,) = leftovers(results)
    with case_lock(job.results):
        assert names(results) == []
        assert not remove(found)
    assert path.exists()
    assert remove(found)
    assert not remove(found)


def test_unfinished_things_stay_for_an_hour_whatever_is_asked(job: CaseJob, later: Callable[[float], None]) -> None:
    results = job.results.parent
    (results / f".index.html.partial-{HEX}").write_bytes(b"x")
    (results / "P1/.quarantine-20_multiply-01234567").mkdir()
    assert names(results, 0) == ["P1/.quarantine-20_multiply-01234567"]
    later(0.9 / 24)
    assert names(results, 0) == ["P1/.quarantine-20_multiply-01234567"]
    later(1.1 / 24)
    assert names(results, 0) == [f".index.html.partial-{HEX}", "P1/.quarantine-20_multiply-01234567"]


def test_links_are_removed_as_links_and_never_followed(job: CaseJob, later: Callable[[float], None]) -> None:
    results = job.results.parent
    victim = results.parent / "victim"
    (victim / f".x.partial-{HEX}").mkdir(parents=True)
    (victim / "precious").write_bytes(b"x" * 100_000)
    (results / "P2").symlink_to(victim)
    (results / "index.files").symlink_to(victim)
    inside = job.results / ".quarantine-20_multiply-01234567"
    inside.mkdir()
    (inside / "link").symlink_to(victim)
    (job.results / f".x.partial-{HEX}").symlink_to(victim)
    later(8)
    assert names(results) == ["P1/.quarantine-20_multiply-01234567", f"P1/.x.partial-{HEX}"]
    assert all(one.bytes < 10_000 for one in leftovers(results))
    clean(results)
    assert names(results) == []
    assert sorted(path.name for path in victim.iterdir()) == [f".x.partial-{HEX}", "precious"]


def test_a_folder_that_became_a_link_meanwhile_is_not_followed(job: CaseJob, later: Callable[[float], None]) -> None:
    (job.results / f".x.partial-{HEX}").write_bytes(b"x")
    later(8)
    (found,) = leftovers(job.results.parent)
    job.results.rename(job.results.with_name("moved"))
    job.results.symlink_to(job.results.with_name("moved"))
    with pytest.raises(EnvironmentFault, match=r"E-ENV-03 Removing what is left in P1 failed"):
        remove(found)
    assert (job.results / f".x.partial-{HEX}").exists()


@pytest.mark.parametrize("index", [None, b"{", b'{"format": 1}'])
def test_no_picture_goes_while_it_is_not_known_which_are_shown(
    job: CaseJob, later: Callable[[float], None], index: bytes | None
) -> None:
    results = job.results.parent
    (results / "index.files").mkdir()
    (results / f"index.files/{HEX}.jpg").write_bytes(b"x")
    if index:
        (results / "index.json").write_bytes(index)
    later(8)
    assert names(results) == []


def test_names_that_are_not_ours_are_never_touched(job: CaseJob, later: Callable[[float], None]) -> None:
    results = job.results.parent
    for name in (".quarantine-x", f".x.partial-{HEX}0", f"x.partial-{HEX}", ".nfs0000", "P1/.quarantine", "notes.log"):
        (results / name).write_bytes(b"x")
    later(8)
    assert names(results) == []


def test_a_dry_run_changes_nothing_and_says_what_would_go(job: CaseJob, later: Callable[[float], None]) -> None:
    results = job.results.parent
    made = fill(results)
    later(8)
    before = everything(results)
    lines = list(cleaned_lines(clean(results, dry_run=True)))
    assert everything(results) == before
    assert lines[:2] == [
        "1 damaged result that was set aside, 0.0 MB",
        f"{len(made) - 4} unfinished files and folders of killed runs, 0.0 MB",
    ]
    assert lines[-1] == "0.0 MB would be free again; without --dry-run it is"
    write_index(results)
    lines = list(cleaned_lines(clean(results)))
    assert lines[2:] == [
        "1 picture that the overview does not show, 0.0 MB",
        "2 old logs of the workflow engine, 0.0 MB",
        "0.0 MB are free again",
    ]
    assert list(cleaned_lines(clean(results))) == ["nothing to remove: nothing that is left over is older than 7 days"]


def test_megabytes_are_those_of_all_files(tmp_path: Path) -> None:
    done = Cleaned(
        (Leftover(tmp_path, "log", 1_500_000), Leftover(tmp_path, "log", 1_000_000)), ("E-ENV-02 No.",), False, 7.0
    )
    assert list(cleaned_lines(done)) == [
        "2 old logs of the workflow engine, 2.5 MB",
        "2.5 MB are free again",
        "E-ENV-02 No.",
    ]


def test_what_cannot_be_removed_is_told_once_and_stops_nothing(
    job: CaseJob, later: Callable[[float], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    results = job.results.parent
    for _ in range(2):
        (results / f".a.partial-{secrets.token_hex(16)}").mkdir()
        (results / f".b.partial-{secrets.token_hex(16)}").write_bytes(b"x")

    def refuse(*args: Any, **kwargs: Any) -> None:
        raise PermissionError(errno.EACCES, "no")

    later(8)
    monkeypatch.setattr("shutil.rmtree", refuse)
    done = clean(results)
    assert len(done.removed) == 2
    assert done.refused == ("E-ENV-02 Removing what is left in results failed: permission denied (EACCES).",)


@pytest.mark.parametrize("days", [-1.0, float("nan"), float("inf"), 1e9])
def test_a_number_of_days_that_cannot_be_is_refused(tmp_path: Path, days: float) -> None:
    with pytest.raises(ConfigError, match=r"E-CLN-03 The number of days is"):
        clean(tmp_path, days)


def test_without_a_results_folder_nothing_is_made(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"E-CLN-01 The results folder does not exist\."):
        clean(tmp_path / "nowhere")
    assert list(tmp_path.iterdir()) == []
