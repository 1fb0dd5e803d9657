"""One case in a process with limits: whatever it does, it ends as one result, and nothing of it lives on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from pipeline.cohort import case_process, limited_process
from pipeline.cohort.case_process import CaseWork, program, run_case
from pipeline.cohort.descendants import Descendants, process_ids
from pipeline.cohort.limited_process import OUTPUT_BYTES, run_limited
from pipeline.cohort.model import CaseEnd, CaseLimits, CohortRequest, ListedCase
from pipeline.commands.cohort_case import case_on_disk, read_row
from pipeline.commands.run_report import write_run_page
from pipeline.commands.summary import closing, status_lines
from pipeline.engine.inspection import read_status
from pipeline.engine.lock import case_lock
from pipeline.engine.outcome import RunOutcome, RunRecord, Word, load_record, save_record
from pipeline.errors import ExitCode
from tests.source_code import CHECKOUT
from tests.toy_flow import TOY_FLOW

MISBEHAVING = str(Path(__file__).with_name("misbehaving.py"))
PASS = RunOutcome("finishes", "PASS", ExitCode.PASS, (), None, None, None)
#: More than a busy machine needs, less than what would otherwise have to be waited for.
SOON_S = 4.0


@pytest.fixture(autouse=True)
def short_grace(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limited_process, "GRACE_S", 0.3)


@dataclass
class Bench:
    """A place to run one case, and what is left of it."""

    folder: Path
    results: Path
    request: CohortRequest = field(default_factory=lambda: CohortRequest("cases", "demo"))

    def run(self, name: str) -> CaseEnd:
        work = CaseWork(self.results, self.request, (sys.executable, "-S", MISBEHAVING))
        return run_case(ListedCase(name, self.folder), work)

    def limit(self, *, memory_mb: int = 0, time_s: float = 0.0) -> Bench:
        return replace(self, request=replace(self.request, limits=CaseLimits(memory_mb, time_s)))

    def will_leave(self, outcome: RunOutcome | None, *, state: str = "finished", code: int | None = None) -> Bench:
        """What the case writes as its record, and the exit code of its process, by default the same."""
        save_record(self.folder, RunRecord(state, outcome))  # type: ignore[arg-type]
        (self.folder / "run.json").rename(self.folder / "leaves.json")
        (self.folder / "exit").write_text(str(outcome.exit_code if code is None and outcome else code))
        return self

    def pids(self) -> list[int]:
        path = self.folder / "pids"
        return [int(line) for line in path.read_text().split()] if path.exists() else []

    def recorded(self, name: str) -> RunOutcome | None:
        record = load_record(self.results / name)
        return record.outcome if record else None


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    (tmp_path / "case").mkdir()
    (tmp_path / "results").mkdir()
    return Bench(tmp_path / "case", tmp_path / "results")


def lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def zombie_children() -> list[str]:
    """Of this process."""
    stats = (path.read_text().rpartition(")") for path in Path("/proc").glob("[0-9]*/stat") if path.exists())
    return [name for name, _, words in stats if words.split()[:2] == ["Z", str(os.getpid())]]


def are_gone(pids: Sequence[int], within_s: float = 0.0) -> bool:
    until = time.monotonic() + within_s
    while any(map(lives, pids)) and time.monotonic() < until:
        time.sleep(0.01)
    return not any(map(lives, pids))


def stopped(word: Word, code: str, exit_code: ExitCode, name: str = "finishes") -> RunOutcome:
    return RunOutcome(name, word, exit_code, (), code, "What is wrong.", "What to do.")


# what is believed of a process that says how it ended


@pytest.mark.parametrize("word", ["PASS", "REVIEW"])
def test_a_finished_case_has_a_record_of_this_run(bench: Bench, word: Word) -> None:
    end = bench.will_leave(replace(PASS, word=word, exit_code=ExitCode[word])).run("finishes")
    assert (end.case_id, end.word, end.code, end.transient) == ("finishes", word, "", False)
    assert 0 < end.seconds < 30


@pytest.mark.parametrize(
    ("outcome", "transient"),
    [
        (stopped("REJECTED", "E-LBL-02", ExitCode.REJECTED), False),
        (stopped("ERROR", "E-BUG-01", ExitCode.ERROR), False),
        (stopped("ERROR", "E-ENV-01", ExitCode.ENVIRONMENT), True),
        (stopped("ERROR", "E-ENV-02", ExitCode.ENVIRONMENT), False),
    ],
)
def test_the_reason_is_that_of_the_record(bench: Bench, outcome: RunOutcome, *, transient: bool) -> None:
    end = bench.will_leave(outcome).run("finishes")
    assert (end.word, end.code, end.transient) == (outcome.word, outcome.code, transient)
    assert (end.problem, end.action) == ("What is wrong.", "What to do.")


def test_the_record_of_an_earlier_run_is_never_taken_for_this_one(bench: Bench) -> None:
    (bench.results / "exit0").mkdir()
    save_record(bench.results / "exit0", RunRecord("finished", replace(PASS, case_id="exit0")))
    end = bench.run("exit0")
    assert (end.word, end.code) == ("ERROR", "E-JOB-05")


def test_a_record_that_is_written_again_in_the_same_words_counts(bench: Bench) -> None:
    bench.will_leave(PASS)
    assert [bench.run("finishes").word for _ in range(3)] == ["PASS"] * 3


@pytest.mark.parametrize(
    ("outcome", "state", "code"),
    [
        (PASS, "running", 0),
        (PASS, "finished", 11),
        (PASS, "finished", 70),
        (replace(PASS, case_id="another"), "finished", 0),
        (None, "running", 0),
        (None, "interrupted", 0),
    ],
)
def test_a_record_that_does_not_fit_the_process_is_not_believed(
    bench: Bench, outcome: RunOutcome | None, state: str, code: int
) -> None:
    end = bench.will_leave(outcome, state=state, code=code).run("finishes")
    assert (end.word, end.code) == ("ERROR", "E-JOB-05")


def test_the_last_words_count_where_there_is_no_record(bench: Bench) -> None:
    refused, full, denied = (bench.run(name) for name in ("refused", "disk", "denied"))
    assert (refused.word, refused.code, refused.problem, refused.action) == (
        "REJECTED",
        "E-LBL-02",
        "No tibia.",
        "Label it.",
    )
    assert (full.word, full.code, full.problem, full.action) == (
        "ERROR",
        "E-ENV-01",
        "The disk is full.",
        "Free space.",
    )
    assert [end.transient for end in (refused, full, denied)] == [False, True, False]
    assert bench.recorded("disk") is None


# what misbehaves: faults.md S17, in the order of its list, and more


@pytest.mark.fault("S17")
def test_segmentation_fault(bench: Bench) -> None:
    end = bench.run("segv")
    assert (end.word, end.code, end.transient) == ("ERROR", "E-JOB-04", False)
    assert "SIGSEGV" in end.problem


@pytest.mark.fault("S17")
def test_abort(bench: Bench) -> None:
    end = bench.run("abort")
    assert (end.code, end.transient) == ("E-JOB-04", False)
    assert "SIGABRT" in end.problem


@pytest.mark.fault("S17")
def test_one_that_hangs_ends_at_its_limit_of_time(bench: Bench) -> None:
    end = bench.limit(time_s=0.3).run("hangs")
    assert (end.word, end.code, end.transient) == ("ERROR", "E-JOB-01", False)
    assert 0.3 <= end.seconds < 0.3 + SOON_S
    assert 1 < end.peak_mb < 200
    assert "0.005 min" in end.problem
    assert are_gone(bench.pids())


def test_one_of_our_own_group_is_killed_alone() -> None:
    family = Descendants(os.getpid(), process_ids())
    with subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(60)"]) as process:
        family.awaited = process.pid
        family.kill()
        assert process.wait(10) == -signal.SIGKILL


def test_the_signal_that_ended_it_is_told() -> None:
    sleeping = (sys.executable, "-S", "-c", "import time; time.sleep(60)")
    ended = run_limited(sleeping, os.environ, CaseLimits(time_s=0.2))
    assert (ended.over, ended.code, ended.output) == ("time", -signal.SIGTERM, "")


@pytest.mark.fault("S17")
def test_one_that_is_deaf_to_sigterm_is_killed(bench: Bench) -> None:
    end = bench.limit(time_s=1.0).run("deaf")
    assert end.code == "E-JOB-01"
    assert 1.3 <= end.seconds < 1.3 + SOON_S
    assert are_gone(bench.pids())


@pytest.mark.fault("S17")
def test_what_it_started_counts_for_the_limit_of_memory(bench: Bench) -> None:
    end = bench.limit(memory_mb=150).run("memory")
    assert (end.word, end.code, end.transient) == ("ERROR", "E-JOB-02", False)
    assert 150 < end.peak_mb < 1000
    assert "150 MB" in end.problem
    assert "--memory-mb" in end.action


def test_one_that_goes_on_taking_memory_has_no_grace(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limited_process, "GRACE_S", 30.0)
    end = bench.limit(memory_mb=200).run("endless")
    assert end.code == "E-JOB-02"
    assert end.seconds < 10


@pytest.mark.fault("S17")
@pytest.mark.parametrize("name", ["systemexit", "exit0", "exit11", "exit70"])
def test_an_exit_without_a_result(bench: Bench, name: str) -> None:
    end = bench.run(name)
    assert (end.word, end.code, end.transient) == ("ERROR", "E-JOB-05", False)


@pytest.mark.fault("S17")
def test_a_flood_of_output_is_read_and_its_end_kept(bench: Bench) -> None:
    end = bench.run("loud")
    assert (end.word, end.code) == ("ERROR", "E-CFG-01")
    assert end.problem == "A stage is called \\x1b[2J."
    ended = run_limited((sys.executable, "-S", "-c", "print('x' * 100_000 + 'end')"), os.environ, CaseLimits())
    assert len(ended.output) == OUTPUT_BYTES
    assert ended.output.endswith("xend\n")


@pytest.mark.fault("S17")
def test_nothing_of_a_bomb_survives(bench: Bench) -> None:
    end = bench.limit(time_s=2.5).run("bomb")
    assert end.code == "E-JOB-01"
    assert len(bench.pids()) == 41
    assert are_gone(bench.pids())


@pytest.mark.fault("S17")
def test_zombies_are_no_obstacle_and_none_is_left(bench: Bench) -> None:
    assert bench.will_leave(replace(PASS, case_id="zombies")).run("zombies").word == "PASS"
    assert zombie_children() == []


# what others do to it


@pytest.mark.parametrize("name", ["killed", "ended", "exit130", "exit137"])
def test_one_that_was_stopped_from_outside_is_tried_again(bench: Bench, name: str) -> None:
    end = bench.run(name)
    assert (end.word, end.code, end.transient) == ("ERROR", "E-JOB-03", True)
    assert bench.recorded(name) is None


def test_a_case_that_another_run_holds_keeps_its_record(bench: Bench) -> None:
    with case_lock(bench.results / "segv"):
        assert bench.run("segv").code == "E-JOB-04"
    assert bench.recorded("segv") is None


def test_a_program_that_is_not_there_is_a_fault_of_the_machine(bench: Bench) -> None:
    work = CaseWork(bench.results, bench.request, (str(bench.folder / "nothing"),))
    end = run_case(ListedCase("P1", bench.folder), work)
    assert (end.word, end.code, end.transient) == ("ERROR", "E-JOB-06", True)
    assert "ENOENT" in end.problem
    assert str(bench.folder) not in end.problem


# what is left behind


def test_a_child_that_keeps_the_pipe_holds_nobody_up(bench: Bench) -> None:
    end = bench.will_leave(replace(PASS, case_id="orphan")).run("orphan")
    assert end.word == "PASS"
    assert end.seconds < 1 + SOON_S
    assert len(bench.pids()) == 2
    assert are_gone(bench.pids())


def test_the_reason_becomes_the_record_of_the_case(bench: Bench) -> None:
    (bench.results / "segv").mkdir()
    save_record(bench.results / "segv", RunRecord("finished", replace(PASS, case_id="segv")))
    end = bench.run("segv")
    assert bench.recorded("segv") == RunOutcome(
        "segv", "ERROR", ExitCode.ERROR, (), "E-JOB-04", end.problem, end.action
    )


def test_the_reason_is_shown_wherever_cases_are(bench: Bench, tmp_path: Path) -> None:
    reason = f"E-JOB-04  {bench.run('segv').problem}"
    folder = bench.results / "segv"
    row = read_row(case_on_disk(folder, TOY_FLOW), tmp_path)
    status = read_status(folder, TOY_FLOW)
    assert (row.state, row.reasons, row.report) == ("ERROR", (reason,), "")
    assert status_lines(status)[-1] == f"last run: ERROR {reason.split('  ')[1]}"
    assert status.last is not None
    assert closing(status.last, write_run_page(status.last, folder, TOY_FLOW))[0] == "ERROR   segv   E-JOB-04"
    assert sorted(path.name for path in folder.iterdir() if path.name[0] != ".") == ["log.jsonl", "run.json"]


def test_what_a_stopped_process_says_of_its_case_is_not_believed(bench: Bench) -> None:
    bench.will_leave(stopped("REJECTED", "E-IO-19", ExitCode.REJECTED, "blames"))
    end = bench.limit(time_s=0.3).run("blames")
    assert (end.word, end.code) == ("ERROR", "E-JOB-01")
    last = bench.recorded("blames")
    assert last is not None
    assert last.code == "E-JOB-01"


# how it is started


def test_the_command_line_of_a_case(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[Sequence[str]] = []

    def run(command: Sequence[str], environment: object, limits: CaseLimits) -> limited_process.Ended:
        started.append(command)
        return limited_process.Ended(0, "", "", 0.0, 0.0)

    monkeypatch.setattr(case_process, "run_limited", run)
    request = CohortRequest("cases", "demo", ("sweep.a=1", "mesh.b=-2"), 2)
    run_case(ListedCase("P1", Path("/cases/P1")), CaseWork(bench.results, request, ("ct2lut",)))
    places = ["--folder", "/cases/P1", "--results", str(bench.results), "--protocol", "demo"]
    settings = ["--jobs", "2", "--set", "sweep.a=1", "--set", "mesh.b=-2", "--", "P1"]
    assert started == [["ct2lut", "run", *places, *settings]]


def test_threads_are_as_many_as_processes_unless_somebody_says_otherwise(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setenv("LP_NUM_THREADS", "5")
    bench.request = replace(bench.request, jobs=3)
    assert "exit code 53 " in bench.run("threads").problem


def test_the_program_is_that_of_this_installation() -> None:
    (name,) = program()
    done = subprocess.run([name, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("ct2lut ")


# the one that watches


def supervised(bench: Bench, name: str) -> tuple[subprocess.Popen[bytes], list[int]]:
    words = ["supervise", str(bench.results), str(bench.folder), name]
    process = subprocess.Popen([sys.executable, "-m", "tests.cohort.misbehaving", *words], cwd=CHECKOUT)
    until = time.monotonic() + 20
    while not bench.pids() and time.monotonic() < until:
        time.sleep(0.02)
    time.sleep(0.1)
    pids = bench.pids()
    assert all(map(lives, pids))
    assert pids
    return process, pids


@pytest.mark.fault("S03")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_stops_the_case_first(bench: Bench, number: signal.Signals) -> None:
    process, pids = supervised(bench, "hangs")
    process.send_signal(number)
    assert process.wait(10) == 130
    assert are_gone(pids)
    assert bench.recorded("hangs") is None


def test_a_second_interrupt_ends_the_grace(bench: Bench) -> None:
    process, pids = supervised(bench, "deaf")
    process.send_signal(signal.SIGTERM)
    time.sleep(0.3)
    assert all(map(lives, pids))
    process.send_signal(signal.SIGTERM)
    since = time.monotonic()
    assert process.wait(10) == 130
    assert time.monotonic() - since < SOON_S
    assert are_gone(pids)


@pytest.mark.fault("S16")
def test_no_case_survives_the_death_of_the_one_that_watches_it(bench: Bench) -> None:
    process, pids = supervised(bench, "deaf")
    process.kill()
    process.wait(10)
    assert are_gone(pids, 1.0)


def test_those_that_were_there_before_are_left_alone(bench: Bench) -> None:
    bystander = subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(60)"])
    try:
        assert bench.limit(time_s=0.2).run("hangs").code == "E-JOB-01"
        assert bystander.poll() is None
    finally:
        bystander.kill()
        bystander.wait()
