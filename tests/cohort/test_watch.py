"""The watch folder: complete cases are run, half-copied ones never; time, disk and runs are played, nothing sleeps."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from pipeline.cohort.model import CaseEnd, ListedCase
from pipeline.cohort.place import CohortPlace
from pipeline.cohort.watching import watch as watching
from pipeline.cohort.watching.inbox import BACK_OFF_S, Inbox, Listing, Snapshot, Watch, list_inbox, snapshot
from pipeline.cohort.watching.watch import Pace, check_watch, watch
from pipeline.engine.lock import hold
from pipeline.engine.store import replace_file
from pipeline.errors import ConfigError, EnvironmentFault
from tests.source_code import CHECKOUT

MENDED = "The watch goes on by itself when that is mended."
FULL = ("E-ENV-01", "Writing 30_mesh failed: the disk is full (ENOSPC).", "Free space.")


@dataclass
class Clock:
    """Time that passes only when somebody waits; before each wait of a watch the next of ``steps`` happens."""

    time: float = 1000.0
    steps: Iterator[Callable[[], object]] = field(default_factory=lambda: iter(()))
    ended: bool = False
    slept: list[float] = field(default_factory=list)

    def now(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.time += seconds
        step = next(self.steps, None)
        if step is None:
            self.ended = True
        else:
            step()

    def pace(self) -> Pace:
        return Pace(self.now, self.sleep, lambda: self.ended)


def nothing() -> None:
    """One look more."""


@pytest.fixture
def cases(tmp_path: Path) -> Path:
    folder = tmp_path / "inbox"
    folder.mkdir()
    return folder


def put(cases: Path, name: str, text: str = "data", file: str = "ct/0001.dcm") -> Path:
    path = cases / name / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def ids(ready: tuple[ListedCase, ...]) -> list[str]:
    return [case.case_id for case in ready]


@dataclass
class Table:
    """An inbox whose folders are named in the test: case -> signature, or signature and what it lacks."""

    clock: Clock = field(default_factory=Clock)
    folders: dict[str, str | Snapshot] = field(default_factory=dict)
    unusable: tuple[str, ...] = ()

    def inbox(self, settle_s: float = 60.0, done: dict[str, str] | None = None) -> Inbox:
        return Inbox(Watch(Path("inbox"), settle_s), done or {}, self.listing, self.clock.now)

    def listing(self, asked: Watch) -> Listing:
        found = {name: one if isinstance(one, Snapshot) else Snapshot(one) for name, one in self.folders.items()}
        return Listing(found, self.unusable)

    def look(self, inbox: Inbox, after: float = 0.0) -> list[str]:
        self.clock.time += after
        return ids(inbox.look())


def test_a_case_is_ready_once_it_was_the_same_for_the_whole_time() -> None:
    table = Table(folders={"P1": "a"})
    inbox = table.inbox()
    assert [table.look(inbox, after) for after in (0, 30, 29.9, 0.1, 5)] == [[], [], [], ["P1"], ["P1"]]
    assert inbox.look()[0] == ListedCase("P1", Path("inbox/P1"))


def test_a_growing_case_waits_from_its_last_change_on() -> None:
    table = Table(folders={"P1": "a"})
    inbox = table.inbox()
    for size in "bcdefgh":
        table.folders["P1"] = size
        assert table.look(inbox, 59) == []
    assert [table.look(inbox, after) for after in (59, 1)] == [[], ["P1"]]


def test_the_time_between_looks_counts_from_the_end_of_the_first_to_the_begin_of_the_second() -> None:
    table = Table(folders={"P1": "a"})
    inbox, listing = table.inbox(), table.listing

    def slow(asked: Watch) -> Listing:
        table.clock.time += 50
        return listing(asked)

    inbox.listing = slow
    assert [table.look(inbox), table.look(inbox, 15), table.look(inbox)] == [[], [], ["P1"]]


def test_a_case_that_was_run_is_run_again_only_when_it_changes() -> None:
    table = Table(folders={"P1": "a"})
    inbox = table.inbox()
    table.look(inbox)
    assert table.look(inbox, 60) == ["P1"]
    assert inbox.ended(CaseEnd("P1", "REJECTED", "E-SIDE-01")) is None
    assert table.look(inbox, 1e6) == []
    table.folders["P1"] = "b"
    assert [table.look(inbox, after) for after in (1, 59, 1)] == [[], [], ["P1"]]
    inbox.ended(CaseEnd("P1", "PASS"))
    assert inbox.done == {"P1": "b"}


def test_a_case_that_changes_while_it_runs_is_run_again() -> None:
    table = Table(folders={"P1": "a"})
    inbox = table.inbox()
    table.look(inbox)
    table.look(inbox, 60)
    table.folders["P1"] = "b"
    inbox.ended(CaseEnd("P1", "PASS"))
    assert [table.look(inbox, after) for after in (600, 60)] == [[], ["P1"]]


def test_a_case_that_goes_is_forgotten_and_an_empty_folder_forgets_nothing() -> None:
    table = Table(folders={"P1": "a", "P2": "a"})
    inbox = table.inbox(done={"P1": "a", "P2": "a"})
    folders, table.folders = table.folders, {}
    assert table.look(inbox) == []
    assert set(inbox.done) == {"P1", "P2"}
    table.folders = {"P2": "a"}
    table.look(inbox)
    assert inbox.done == {"P2": "a"}
    table.folders = folders
    assert [table.look(inbox, after) for after in (0, 60)] == [[], ["P1"]]


def test_a_case_that_went_for_a_moment_has_to_be_quiet_again() -> None:
    table = Table(folders={"P1": "a"})
    inbox = table.inbox()
    table.look(inbox)
    table.folders = {}
    table.look(inbox, 30)
    table.folders = {"P1": "a"}
    assert [table.look(inbox, after) for after in (30, 30, 30)] == [[], [], ["P1"]]


def test_the_case_that_is_complete_longest_comes_first() -> None:
    table = Table(folders={"P9": "a"})
    inbox = table.inbox()
    table.look(inbox)
    table.folders |= {"P2": "a", "P1": "a"}
    table.look(inbox, 1)
    assert table.look(inbox, 100) == ["P9", "P1", "P2"]


def test_a_fault_of_the_machine_is_tried_again_ever_later_and_then_not() -> None:
    table = Table(folders={"P1": "a"})
    inbox, fault = table.inbox(), CaseEnd("P1", "ERROR", *FULL, transient=True)
    table.look(inbox)
    table.clock.time += 60
    for pause in BACK_OFF_S:
        assert table.look(inbox) == ["P1"]
        assert inbox.ended(fault) == pause
        assert [table.look(inbox, pause - 1), table.look(inbox, 1)] == [[], ["P1"]]
    assert BACK_OFF_S == (60, 300, 1500)
    assert inbox.ended(fault) is None
    assert table.look(inbox, 1e6) == []
    table.folders["P1"] = "b"
    table.look(inbox)
    assert table.look(inbox, 60) == ["P1"]
    assert inbox.ended(fault) == BACK_OFF_S[0]


def test_what_a_case_lacks_is_told_once_and_only_when_it_is_quiet() -> None:
    table = Table(folders={"P1": Snapshot("a", "it holds no file yet.")}, unusable=("x is not run",))
    inbox = table.inbox()
    assert (table.look(inbox), inbox.news()) == ([], ("x is not run",))
    assert (table.look(inbox, 60), inbox.news()) == ([], ("P1 waits: it holds no file yet.",))
    assert (table.look(inbox, 60), inbox.news()) == ([], ())
    table.folders["P1"] = "b"
    table.look(inbox)
    assert table.look(inbox, 60) == ["P1"]


def test_a_listing_reads_no_content_and_tells_changes_of_every_kind(cases: Path) -> None:
    file = put(cases, "P1")
    file.chmod(0)  # never opened
    seen = {snapshot(cases / "P1").signature}
    for change in (
        lambda: os.utime(file, (0, 0)),
        lambda: os.utime(file, (2e9, 4e9)),
        lambda: put(cases, "P1", "", "ct/0002.dcm"),
        lambda: (cases / "P1/ct/0002.dcm").rename(cases / "P1/ct/0003.dcm"),
        lambda: put(cases, "P1", "longer", "ct/0003.dcm"),
        lambda: (cases / "P1/link").symlink_to("nowhere"),
    ):
        change()
        seen.add(snapshot(cases / "P1").signature)
    assert len(seen) == 7
    assert snapshot(cases / "P1") == snapshot(cases / "P1")


def test_links_to_folders_are_not_followed_and_a_case_may_be_a_link(cases: Path, tmp_path: Path) -> None:
    put(tmp_path, "away")
    (cases / "P1").symlink_to(tmp_path / "away")
    (tmp_path / "away/loop").symlink_to(tmp_path / "away")
    before = list_inbox(Watch(cases)).cases["P1"]
    assert before.lacks == ""
    put(tmp_path, "away", "more")
    assert list_inbox(Watch(cases)).cases["P1"].signature == snapshot(tmp_path / "away").signature


UNFINISHED = (
    "0001.dcm.part",
    "0001.PARTIAL",
    "a.filepart",
    "b.crdownload",
    "c.nii.gz.tmp",
    ".0001.dcm.Xy3kQ1",
    ".~tmp~/a",
)


@pytest.mark.parametrize("name", UNFINISHED)
def test_a_case_with_the_name_of_an_unfinished_file_is_never_ready(cases: Path, name: str) -> None:
    put(cases, "P1")
    put(cases, "P1", "half", f"ct/{name}")
    lacks = snapshot(cases / "P1").lacks
    assert lacks.endswith(", as programs that copy make them. When the copy is complete, remove it.")
    assert "0001" not in lacks


@pytest.mark.parametrize("name", [".DS_Store", "._0001.dcm", ".nfs000000000012", "Thumbs.db", "partial.dcm", "tmp"])
def test_what_file_managers_leave_and_plain_names_hold_nothing_up(cases: Path, name: str) -> None:
    put(cases, "P1")
    put(cases, "P1", "junk", name)
    assert snapshot(cases / "P1").lacks == ""


def test_a_case_needs_a_file_and_the_marker_that_was_asked_for(cases: Path) -> None:
    (cases / "P1/ct").mkdir(parents=True)
    assert snapshot(cases / "P1").lacks == "it holds no file yet."
    put(cases, "P1", "", ".complete")
    assert snapshot(cases / "P1", ".complete").lacks == "it holds no file yet."
    put(cases, "P1")
    assert snapshot(cases / "P1", ".complete").lacks == ""
    assert snapshot(cases / "P1", "ready.txt").lacks.startswith("it holds a hidden file")
    (cases / "P1/.complete").unlink()
    put(cases, "P1", "", "ct/.complete")
    (cases / "P1/ct/.complete").rename(cases / "P1/ct/complete")
    assert snapshot(cases / "P1", ".complete").lacks == 'it does not hold the file ".complete" yet.'


def test_too_many_files_are_left_to_the_run_to_refuse(cases: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.cohort.watching.inbox.MAX_FILES", 3)
    for number in range(5):
        put(cases, "P1", "data", f"{number}.dcm")
    assert snapshot(cases / "P1") == Snapshot("too many files")


def test_what_cannot_be_a_case_is_told_without_the_names_of_patients(cases: Path) -> None:
    for name in ("P1", "Muster Hans", "Q", "q", ".hidden", "con", "\x1b[2J"):
        put(cases, name)
    (cases / "Muster.zip").write_text("")
    found = list_inbox(Watch(cases))
    assert list(found.cases) == ["P1"]
    twin = "another case folder differs only in upper and lower case. Rename one of them."
    assert found.unusable == (
        f"Q is not run: {twin}",
        f"q is not run: {twin}",
        "not run: folders whose names are no case IDs (1 to 64 of A-Z a-z 0-9 - _): 3. Rename them.",
        "not run: files beside the case folders: 1. A case is a folder of its own.",
    )


@dataclass
class Scene:
    """A watch that is played to the end of its steps."""

    cases: Path
    clock: Clock = field(default_factory=Clock)
    said: list[str] = field(default_factory=list)
    ran: list[str] = field(default_factory=list)
    ends: dict[str, CaseEnd] = field(default_factory=dict)

    @property
    def place(self) -> CohortPlace:
        return CohortPlace(self.cases.parent / "results")

    def run(self, case: ListedCase) -> CaseEnd:
        assert case.folder == self.cases / case.case_id
        self.ran.append(case.case_id)
        self.clock.time += 20
        return self.ends.get(case.case_id, CaseEnd(case.case_id, "PASS", seconds=20))

    def play(self, *steps: Callable[[], object], **asked: float) -> list[str]:
        self.clock.steps, self.clock.ended = iter(steps), False
        watch(Watch(self.cases, **asked), self.place, self.run, self.said.append, self.clock.pace())  # type: ignore[arg-type]
        return self.said


@pytest.fixture(autouse=True)
def quick_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


@pytest.fixture
def scene(cases: Path) -> Scene:
    return Scene(cases)


def test_a_case_is_copied_completed_run_corrected_and_run_again(scene: Scene) -> None:
    put(scene.cases, "P1", "half")
    steps = [nothing] * 5 + [lambda: put(scene.cases, "P1", "whole")] + [nothing] * 13
    said = scene.play(*steps)
    assert scene.ran == ["P1"]
    assert set(scene.clock.slept) == {5.0}
    assert said == [
        "watching; a case is run when its folder has not changed for 60 s",
        "P1  complete, runs now",
        "P1  PASS  20 s",
    ]
    scene.play(lambda: put(scene.cases, "P1", "corrected"), *[nothing] * 13)
    assert scene.ran == ["P1", "P1"]


def test_what_was_run_is_remembered_over_a_restart_unless_the_record_is_damaged(scene: Scene) -> None:
    put(scene.cases, "P1")
    scene.play(*[nothing] * 14)
    scene.play(*[nothing] * 14)
    assert scene.ran == ["P1"]
    memory = scene.place.watch_memory
    for content in (memory.read_text().replace('"format": 1', '"format": 2'), "{", None):
        memory.write_text(content) if content else memory.unlink()
        scene.play(*[nothing] * 14)
    assert scene.ran == ["P1"] * 4


def test_an_interrupt_passes_through_and_the_case_is_run_by_the_next_watch(scene: Scene) -> None:
    put(scene.cases, "P1")

    def stopped(case: ListedCase) -> CaseEnd:
        raise KeyboardInterrupt

    scene.clock.steps = iter([nothing] * 20)
    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        watch(Watch(scene.cases), scene.place, stopped, scene.said.append, scene.clock.pace())
    scene.play(*[nothing] * 14)
    assert scene.ran == ["P1"]


def test_one_watch_at_a_time(scene: Scene) -> None:
    pattern = r"E-WCH-01 Another watch is at work on this results folder since .* UTC on \S+ \(pid \d+\)\. Leave it to"
    scene.play()
    with hold(scene.place.watch_lock), pytest.raises(EnvironmentFault, match=pattern):
        scene.play(nothing)
    assert scene.play(nothing) == ["watching; a case is run when its folder has not changed for 60 s"] * 2


def test_a_cases_folder_that_goes_is_told_once_and_waited_for(scene: Scene) -> None:
    put(scene.cases, "P1")
    away = scene.cases.with_name("away")
    scene.play(*[nothing] * 14)
    scene.play(lambda: scene.cases.rename(away), nothing, nothing, lambda: away.rename(scene.cases), *[nothing] * 14)
    assert scene.said[-2:] == [
        f"waiting: E-WCH-04 The cases folder is not there, or its disk is not mounted. {MENDED}",
        "goes on",
    ]
    assert scene.ran == ["P1"]
    assert scene.clock.slept.count(60.0) == 3


def test_nothing_is_run_while_the_results_folder_is_gone(scene: Scene) -> None:
    put(scene.cases, "P1")
    away = scene.place.results.with_name("away")
    scene.play(
        lambda: scene.place.results.rename(away),
        *[nothing] * 20,
        lambda: away.rename(scene.place.results),
        *[nothing] * 2,
    )
    assert scene.said[1:] == [
        f"waiting: E-WCH-05 The results folder is gone, or its disk is not mounted. {MENDED}",
        "goes on",
        "P1  complete, runs now",
        "P1  PASS  20 s",
    ]


def test_nothing_is_run_while_the_results_disk_is_full_or_refuses(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(scene.cases, "P1")
    usage = type(shutil.disk_usage("/"))
    free = iter([200_000_000, 100_000_000, None, *[9_000_000_000] * 9])

    def disk_usage(path: Path) -> object:
        found = next(free)
        if found is None:
            raise OSError(5, "Input/output error")
        return usage(found, 0, found)

    monkeypatch.setattr(shutil, "disk_usage", disk_usage)
    scene.play(*[nothing] * 16)
    waits = [line for line in scene.said if line.startswith("waiting")]
    assert len(waits) == 2
    assert waits[0].startswith("waiting: E-BAT-01 The results disk has 200 MB left")
    assert waits[1].startswith(
        "waiting: E-ENV-03 Looking at the results disk failed: the disk or network share reported"
    )
    assert scene.ran == ["P1"]


def test_a_results_folder_that_cannot_be_written_to_is_waited_for(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(scene.cases, "P1")
    refusals = iter([True, True, True])

    def refuse(path: Path, data: bytes) -> None:
        if next(refusals, False):
            raise EnvironmentFault("E-ENV-02", "Writing watch.json failed: the disk is read-only (EROFS).", "Mend it.")
        replace_file(path, data)

    monkeypatch.setattr("pipeline.cohort.watching.watch.replace_file", refuse)
    scene.play(*[nothing] * 16)
    assert scene.said[1].startswith("waiting: E-ENV-02 Writing watch.json failed: the disk is read-only (EROFS).")
    assert scene.said[2:] == ["goes on", "P1  complete, runs now", "P1  PASS  20 s"]


def test_a_fault_that_the_run_raises_is_one_of_the_machine(scene: Scene) -> None:
    put(scene.cases, "P1")
    run, scene.ends = scene.run, {}

    def failing(case: ListedCase) -> CaseEnd:
        run(case)
        if len(scene.ran) == 1:
            raise EnvironmentFault(*FULL)
        return CaseEnd("P1", "PASS")

    scene.clock.steps = iter([nothing] * 30)
    watch(Watch(scene.cases), scene.place, failing, scene.said.append, scene.clock.pace())
    assert scene.said[2:5] == [
        "P1  ERROR  0 s  E-ENV-01 Writing 30_mesh failed: the disk is full (ENOSPC).",
        "    Free space.",
        "    The machine is at fault, not the case: it is tried again in 1 min.",
    ]
    assert scene.ran == ["P1", "P1"]


def test_three_cases_in_a_row_with_the_same_error_pause_the_watch(scene: Scene) -> None:
    for number in range(5):
        put(scene.cases, f"P{number}")
        scene.ends[f"P{number}"] = CaseEnd(f"P{number}", "ERROR", "E-JOB-04", "It crashed.", "Look.")
    scene.play(*[nothing] * 100)
    assert scene.ran == ["P0", "P1", "P2"]
    assert scene.said[-1] == "3 cases in a row ended with E-JOB-04: pause of 10 min. Look."
    scene.play(*[nothing] * 140)
    assert scene.ran == [f"P{number}" for number in range(5)]


def test_three_refusals_in_a_row_are_no_fault_of_the_machine(scene: Scene) -> None:
    for number in range(5):
        put(scene.cases, f"P{number}")
        scene.ends[f"P{number}"] = CaseEnd(f"P{number}", "REJECTED", "E-SIDE-01", "No side.", "Add it.")
    scene.play(*[nothing] * 14)
    assert len(scene.ran) == 5


def test_a_look_that_takes_long_is_rare(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(asked: Watch) -> Listing:
        scene.clock.time += 3
        return Listing({})

    monkeypatch.setattr(watching, "list_inbox", slow)
    scene.play(nothing)
    assert scene.clock.slept == [27.0, 27.0]


def test_a_look_at_a_thousand_slices_is_quick(cases: Path) -> None:
    for number in range(1000):
        put(cases, "P1", "x", f"ct/{number:04d}.dcm")
    begun = os.times()
    snapshot(cases / "P1")
    ended = os.times()
    assert ended.user + ended.system - begun.user - begun.system < 0.5


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        (Watch(Path("results/inbox")), "E-WCH-02"),
        (Watch(Path()), "E-WCH-02"),
        (Watch(Path("inbox"), settle_s=0), "E-WCH-03"),
        (Watch(Path("inbox"), every_s=float("nan")), "E-WCH-03"),
        (Watch(Path("inbox"), marker="../done"), "E-WCH-06"),
        (Watch(Path("inbox"), marker="a\nb"), "E-WCH-06"),
    ],
)
def test_a_watch_that_cannot_work_is_refused(asked: Watch, code: str) -> None:
    with pytest.raises(ConfigError, match=rf"{code} .*"):
        check_watch(asked, CohortPlace(Path("results")))


def test_a_copy_in_another_process_is_never_taken_half(scene: Scene) -> None:
    """A real copy, slower than the looks and quicker than the time to settle; every look sees another state."""
    source = scene.cases.parent / "source"
    for number in range(30):
        put(source, "P1", "x" * 1000, f"ct/{number:04d}.dcm")
    seen: list[int] = []
    inbox = Inbox(Watch(scene.cases, settle_s=2.5), {}, list_inbox, scene.clock.now)
    program = (
        "import sys, shutil, pathlib\n"
        "source, target = map(pathlib.Path, sys.argv[1:])\n"
        "(target / 'ct').mkdir(parents=True)\n"
        "for path in sorted(source.glob('ct/*')):\n"
        "    shutil.copy(path, target / 'ct')\n"
        "    print(flush=True)\n"
        "    sys.stdin.readline()\n"
    )
    command = [sys.executable, "-c", program, str(source / "P1"), str(scene.cases / "P1")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=CHECKOUT) as copying:
        assert copying.stdin
        assert copying.stdout
        for _ in range(30):
            copying.stdout.readline()
            scene.clock.time += 1
            assert inbox.look() == ()
            seen.append(len(list((scene.cases / "P1/ct").iterdir())))
            copying.stdin.write("\n")
            copying.stdin.flush()
    assert seen == list(range(1, 31))
    scene.clock.time += 2.5
    assert ids(inbox.look()) == ["P1"]
    shutil.rmtree(scene.cases / "P1")
    assert inbox.look() == ()
