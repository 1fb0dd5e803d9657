"""A confined stage: the same result as at home, and whatever happens to its process costs one case."""

from __future__ import annotations

import ctypes
import errno
import json
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from pipeline.engine import confinement, sandbox
from pipeline.engine.artifacts import SOURCE, folder
from pipeline.engine.confinement import Channel, Made
from pipeline.engine.outcome import CaseJob, Execution, RunOutcome
from pipeline.engine.runner import run_case
from pipeline.engine.sandbox import SEALED
from pipeline.engine.stage import Finding, Findings, Inputs, Limits, Outputs, Severity, Stage
from pipeline.errors import CaseRejected, ConfigError, EnvironmentFault, ExitCode, PipelineError
from tests.engine.crash_tools import in_child, wait
from tests.engine.toy_flow import (
    DEFAULTS,
    FLOW,
    GATHER,
    MULTIPLY,
    NUMBERS,
    TOTAL,
    Recorder,
    artifact_bytes,
    leftovers,
    make_case,
    run,
    states,
)

Body = Callable[[Inputs, Any, Outputs], Findings]
LIMITS = Limits(memory_bytes=400_000_000, wall_s=20.0)


@pytest.fixture
def job(tmp_path: Path) -> CaseJob:
    return make_case(tmp_path)


@pytest.fixture(autouse=True)
def nothing_is_left() -> Iterable[None]:
    yield
    assert multiprocessing.active_children() == []


def confined_flow(body: Body = GATHER.run, limits: Limits = LIMITS) -> tuple[Stage, ...]:
    return (replace(GATHER, run=body, limits=limits), MULTIPLY, TOTAL)


def flow_of(act: Callable[[], object], limits: Limits = LIMITS) -> tuple[Stage, ...]:
    """A first stage that reads its file and then acts."""

    def body(reads: Inputs, params: Any, out: Outputs) -> Findings:
        reads[SOURCE].read("numbers.txt")
        act()
        out[NUMBERS] = (1,)
        return ()

    return confined_flow(body, limits)


def log_lines(job: CaseJob) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (job.results / "log.jsonl").read_text().splitlines()]


def test_the_bytes_are_those_of_an_unconfined_run(tmp_path: Path) -> None:
    plain, confined = make_case(tmp_path / "plain"), make_case(tmp_path / "confined")
    run(plain)
    outcome, _ = run(confined, confined_flow())
    assert states(outcome) == ["ran"] * 3
    assert artifact_bytes(confined.results) == artifact_bytes(plain.results)
    assert states(run(confined, confined_flow())[0]) == ["cached"] * 3
    assert states(run(confined)[0]) == ["cached"] * 3, "limits do not change what a result is made of"


def test_every_kind_of_artifact_finding_and_progress_comes_back(job: CaseJob) -> None:
    empty = folder("empty", "empty/")

    def body(reads: Inputs, params: Any, out: Outputs) -> Findings:
        out.progress(1, 2)
        out[NUMBERS], out[empty] = (1, 2), {}
        return (Finding("W-TOY-09", Severity.REVIEW, "größer als 1 µm\n"),)

    stage = replace(GATHER, run=body, limits=LIMITS, writes=(NUMBERS, empty))
    outcome, recorder = run(job, (stage, MULTIPLY, TOTAL))
    assert recorder.progress == [("gather", 1, 2), ("multiply", 2, 2)]
    assert outcome.stages[0].findings == (Finding("W-TOY-09", Severity.REVIEW, "größer als 1 µm\n"),)


def test_large_files_come_back_whole(job: CaseJob) -> None:
    parts = folder("large", "large/")
    data = {"a": os.urandom(3_000_000), "b": b"", "c": os.urandom(17)}

    def body(reads: Inputs, params: Any, out: Outputs) -> Findings:
        out[NUMBERS], out[parts] = (1,), data
        return ()

    run(job, (replace(GATHER, run=body, limits=LIMITS, writes=(NUMBERS, parts)), MULTIPLY, TOTAL))
    assert {path.name: path.read_bytes() for path in (job.results / "10_gather" / "large").iterdir()} == data


@pytest.mark.parametrize(
    ("error", "exit_code", "code"),
    [
        (CaseRejected("E-TOY-09", "numbers.txt is odd.", "right it."), ExitCode.REJECTED, "E-TOY-09"),
        (ConfigError("E-CFG-09", "wrong.", "right it."), ExitCode.USAGE, "E-CFG-09"),
        (EnvironmentFault("E-ENV-09", "no renderer.", "install it."), ExitCode.ENVIRONMENT, "E-ENV-09"),
        (PipelineError("E-TOY-08", "wrong.", "tell us."), ExitCode.ERROR, "E-TOY-08"),
        (OSError(errno.EIO, "broken", "/secret"), ExitCode.ENVIRONMENT, "E-ENV-03"),
        (MemoryError(), ExitCode.REJECTED, "E-IO-20"),
        (OSError(errno.ENOMEM, "no memory", "/secret"), ExitCode.REJECTED, "E-IO-20"),
        (FileNotFoundError(errno.ENOENT, "gone", "/secret"), ExitCode.ERROR, "E-BUG-01"),
        (PermissionError(errno.EACCES, "denied", "/secret"), ExitCode.ERROR, "E-BUG-01"),
        (ValueError("bad"), ExitCode.ERROR, "E-BUG-01"),
        (SystemExit(0), ExitCode.ERROR, "E-BUG-01"),
        (KeyboardInterrupt(), ExitCode.ERROR, "E-BUG-01"),
    ],
)
def test_failures_keep_their_meaning(job: CaseJob, error: BaseException, exit_code: ExitCode, code: str) -> None:
    def fail() -> None:
        raise error

    outcome, _ = run(job, flow_of(fail))
    assert (outcome.exit_code, outcome.code) == (exit_code, code)
    assert outcome.problem
    assert "secret" not in f"{outcome.problem}{outcome.action}"
    if isinstance(error, PipelineError):
        assert (outcome.problem, outcome.action) == (error.problem, error.action)
    assert states(outcome) == ["failed", "not reached", "not reached"]


def test_a_bug_leaves_its_traceback_in_the_log_without_what_it_quotes(job: CaseJob) -> None:
    def fail() -> None:
        float("DOE^JOHN")

    outcome, _ = run(job, flow_of(fail))
    number = str(outcome.problem).partition("error id ")[2][:8]
    (line,) = [line for line in log_lines(job) if number in line["msg"] and "could not convert" in line["msg"]]
    assert "ValueError: could not convert string to float: …" in line["msg"]
    assert f"engine/{Path(__file__).name}:" in line["msg"]
    assert number in str(run(job, flow_of(fail))[0].problem), "the same bug keeps its number"


def crash() -> None:
    ctypes.string_at(0)


def kill_itself() -> None:
    signal.signal(signal.SIGABRT, signal.SIG_DFL)
    os.abort()


@pytest.mark.parametrize(
    ("act", "how"),
    [
        (crash, r"crashed \(Segmentation fault\)"),
        (kill_itself, r"crashed \([A-Z].*\)"),
        (lambda: os._exit(0), "fell silent"),
    ],
)
def test_a_crash_costs_the_case_and_names_the_file(job: CaseJob, act: Callable[[], object], how: str) -> None:
    run(job)
    before = artifact_bytes(job.results)
    (job.source / "numbers.txt").write_text("4 5 6")
    outcome, _ = run(job, flow_of(act))
    assert (outcome.word, outcome.code) == ("REJECTED", "E-IO-19")
    with pytest.raises(CaseRejected, match=rf"^E-IO-19 numbers\.txt could not be read safely: the reader {how}\. Exp"):
        raise CaseRejected(outcome.code or "", outcome.problem or "", outcome.action or "")
    assert artifact_bytes(job.results) == before
    assert leftovers(job.results) == []


def test_too_much_memory_costs_the_case(job: CaseJob) -> None:
    outcome, _ = run(job, flow_of(lambda: [bytearray(10_000_000) for _ in range(1000)], replace(LIMITS, wall_s=60.0)))
    assert (outcome.word, outcome.code) == ("REJECTED", "E-IO-20")
    assert str(outcome.problem).startswith("numbers.txt could not be read safely: it needs more than 0 GB of memory")


def test_memory_is_limited_beyond_what_there_was(job: CaseJob) -> None:
    """What is asked for within the limit is given, however large the process of the run already is."""
    held = bytearray(500_000_000)
    outcome, _ = run(job, flow_of(lambda: bytearray(300_000_000)))
    assert outcome.word == "PASS", held[:1]


def spin() -> None:
    while True:
        pass


@pytest.mark.parametrize("act", [lambda: time.sleep(60), spin, lambda: signal.sigwait({signal.SIGUSR1})])
def test_too_long_costs_the_case(job: CaseJob, act: Callable[[], object]) -> None:
    start = time.monotonic()
    outcome, _ = run(job, flow_of(act, Limits(wall_s=0.3)))
    assert (outcome.word, outcome.code) == ("REJECTED", "E-IO-21")
    assert "numbers.txt could not be read safely: it took longer than" in str(outcome.problem)
    assert time.monotonic() - start < 5


def test_a_fifo_that_takes_the_place_of_a_file_cannot_hold_the_run(job: CaseJob) -> None:
    def body(reads: Inputs, params: Any, out: Outputs) -> Findings:
        reads[SOURCE].read("numbers.txt")
        return ()

    class Swap(Recorder):
        def stage_started(self, stage: str, index: int, total: int, reason: str) -> None:
            (job.source / "numbers.txt").unlink(missing_ok=True)

    def swapped(reads: Inputs, params: Any, out: Outputs) -> Findings:
        while (job.source / "numbers.txt").exists():
            time.sleep(0.01)
        return body(reads, params, out)

    outcome = run_case(job, confined_flow(swapped), DEFAULTS, Execution(jobs=1), Swap())
    assert outcome.code == "E-BUG-01"  # gone altogether: the reader of the case's files refuses that with a code
    os.mkfifo(job.source / "pipe")
    source = job.source / "pipe"
    outcome, _ = run(job, flow_of(source.read_bytes, Limits(wall_s=0.3)))
    assert outcome.code == "E-IO-03", "a folder with a FIFO alone is an empty one"
    (job.source / "numbers.txt").write_text("1")
    outcome, _ = run(job, flow_of(source.read_bytes, Limits(wall_s=0.3)))
    assert outcome.code == "E-IO-21"


@dataclass
class Watching(Recorder):
    """Hands over the process number that a stage reports as its progress."""

    act: Callable[[int], None] = lambda _: None

    def __post_init__(self) -> None:
        self.progress, self.started, self.finished = [], [], []

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        self.act(done)


def tell_and_sleep(reads: Inputs, params: Any, out: Outputs) -> Findings:
    reads[SOURCE].read("numbers.txt")
    out.progress(os.getpid(), 1)
    time.sleep(60)
    return ()


def watched(job: CaseJob, act: Callable[[int], None]) -> RunOutcome:
    return run_case(job, confined_flow(tell_and_sleep), DEFAULTS, Execution(jobs=1), Watching(act=act))


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_a_child_killed_by_the_system_ran_out_of_memory(job: CaseJob) -> None:
    outcome = watched(job, lambda pid: os.kill(pid, signal.SIGKILL))
    assert (outcome.word, outcome.code) == ("REJECTED", "E-IO-20")


def test_a_listener_that_fails_is_not_taken_for_the_child(job: CaseJob) -> None:
    def fail(pid: int) -> None:
        raise ValueError("no terminal")

    assert watched(job, fail).code == "E-BUG-01"


def test_an_interrupt_of_the_run_ends_the_child(job: CaseJob) -> None:
    pids: list[int] = []

    def interrupt(pid: int) -> None:
        pids.append(pid)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        watched(job, interrupt)
    assert not is_alive(pids[0])


def test_a_run_that_is_killed_takes_the_child_along(job: CaseJob, tmp_path: Path) -> None:
    def note(pid: int) -> None:
        (tmp_path / "pid").write_text(f"{pid}\n")

    run_of_it = in_child(lambda: watched(job, note))
    deadline = time.monotonic() + 20
    while not (tmp_path / "pid").exists() or not (tmp_path / "pid").read_text().endswith("\n"):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    pid = int((tmp_path / "pid").read_text())
    assert is_alive(pid)
    os.kill(run_of_it, signal.SIGKILL)
    assert wait(run_of_it) == -signal.SIGKILL
    while is_alive(pid):
        assert time.monotonic() < deadline
        time.sleep(0.01)


# a child that a hostile file has taken over may say anything


def saying(*messages: bytes) -> Callable[[Channel, Stage, Made], None]:
    def hand_over(self: Channel, stage: Stage, made: Made) -> None:
        for message in messages:
            self.connection.send_bytes(message)
        time.sleep(60)

    return hand_over


FINDINGS = b'["findings"]'
NUMBERS_FILE = (b'["artifact", "numbers", [""]]', b"[1]")


@pytest.mark.parametrize(
    "messages",
    [
        [b""],
        [b"\xff\xfe"],
        [b"not json"],
        [b"[" * 1_000_000],
        [b" " * (confinement._MESSAGE_BYTES + 1)],
        [b"null"],
        [b'["unheard of"]'],
        [b'["error", "CaseRejected", "E-TOY-01"]'],
        [b'["error", 1, 2, 3, 4]'],
        [b'["progress", "1", null]'],
        [b'["sealed", "an invented warning"]'],
        [b'["opened", "../../etc/passwd"]'],
        [b'["artifact", "numbers", [1]]'],
        [FINDINGS, b"not findings"],
        [FINDINGS, b'[{"code": 1}]'],
        [FINDINGS, b"[]"],
        [b'["artifact", "numbers", []]', FINDINGS, b"[]"],
        [b'["artifact", "numbers", ["", "other"]]', b"[1]", b"x", FINDINGS, b"[]"],
        [b'["artifact", "numbers", ["../escape.txt"]]', b"x", FINDINGS, b"[]"],
    ],
)
def test_an_answer_that_means_nothing_is_refused(
    job: CaseJob, messages: Sequence[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(confinement, "_GRACE_S", 0.1)
    monkeypatch.setattr(Channel, "hand_over", saying(*messages))
    outcome, _ = run(job, confined_flow())
    assert (outcome.word, outcome.code) == ("REJECTED", "E-IO-19")
    assert outcome.problem == "numbers.txt could not be read safely: the reader fell silent."


def test_a_folder_cannot_be_left(job: CaseJob, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = folder("parts_of_it", "parts/")
    words = (*NUMBERS_FILE, b'["artifact", "parts_of_it", ["../../escape.txt"]]', b"x", FINDINGS, b"[]")
    monkeypatch.setattr(Channel, "hand_over", saying(*words))
    stage = replace(GATHER, limits=LIMITS, writes=(NUMBERS, parts))
    assert run(job, (stage, MULTIPLY, TOTAL))[0].code == "E-BUG-01"
    assert not (job.results / "10_gather").exists()
    assert not list(job.results.parent.rglob("escape.txt"))


def test_what_was_not_declared_is_dropped(job: CaseJob, monkeypatch: pytest.MonkeyPatch) -> None:
    extra = (b'["artifact", "other", ["x"]]', b"x", *NUMBERS_FILE, FINDINGS, b"[]")
    monkeypatch.setattr(Channel, "hand_over", saying(*extra))
    outcome, _ = run(job, confined_flow())
    assert outcome.word == "PASS"
    assert not list(job.results.rglob("x"))


def test_results_beyond_all_measure_are_refused(job: CaseJob, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(confinement, "_GRACE_S", 0.1)
    monkeypatch.setattr(confinement, "_RESULT_BYTES", 5)
    monkeypatch.setattr(Channel, "hand_over", saying(b'["artifact", "numbers", ["", "b"]]', b"1234", b"56", FINDINGS))
    assert run(job, confined_flow())[0].code == "E-IO-19"


def test_signs_that_steer_a_terminal_are_escaped(job: CaseJob, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["error", "CaseRejected", "E-TOY-01", "red \x1b[31m alert", "do\nit"]
    monkeypatch.setattr(Channel, "hand_over", saying(json.dumps(words).encode()))
    outcome, _ = run(job, confined_flow())
    assert (outcome.problem, outcome.action) == (r"red \x1b[31m alert", r"do\nit")


@pytest.mark.parametrize(
    ("lacking", "words"),
    [
        (["_filter_calls"], SEALED[:1]),
        (["_restrict_folders"], SEALED[1:]),
        (["_filter_calls", "_restrict_folders"], SEALED),
    ],
)
def test_what_the_system_cannot_seal_is_told_once(
    job: CaseJob, lacking: Sequence[str], words: Sequence[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in lacking:
        monkeypatch.setattr(sandbox, name, lambda *_: False)
    assert run(job, confined_flow())[0].word == "PASS"
    told = [line["msg"] for line in log_lines(job) if line["level"] == "warning"]
    assert told == [f"what reads foreign files could not be kept from {word}" for word in words]
    assert states(run(job, confined_flow())[0]) == ["cached"] * 3
    assert len([line for line in log_lines(job) if line["level"] == "warning"]) == len(words)


def test_the_flow_is_the_toy_flow() -> None:
    assert [stage.name for stage in confined_flow()] == [stage.name for stage in FLOW]


def test_what_later_stages_need_is_begun_while_the_child_works(job: CaseJob) -> None:
    """The child waits for what its parent begins meanwhile; a cached run begins nothing."""
    signs = job.source / ".begun"  # hidden, so no part of the case
    begun: list[bool] = []

    def body(reads: Inputs, params: Any, out: Outputs) -> Findings:
        until = time.monotonic() + 10.0
        while not signs.exists() and time.monotonic() < until:
            time.sleep(0.01)
        assert signs.exists()
        return GATHER.run(reads, params, out)

    def get_ready() -> None:
        begun.append(True)
        signs.touch()

    for expected in (["ran"] * 3, ["cached"] * 3):
        outcome = run_case(job, confined_flow(body), DEFAULTS, Execution(1, get_ready), Recorder())
        assert states(outcome) == expected
        signs.unlink(missing_ok=True)
    assert begun == [True]
