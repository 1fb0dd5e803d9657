"""The driver of the workflow engine: with the engine itself, and with small programs in its place."""

from __future__ import annotations

import fcntl
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from pipeline.cohort import driver
from pipeline.cohort.driver import Engine, find_engine, is_driven, run_engine, wait_for_driver
from pipeline.cohort.place import CohortPlace
from pipeline.errors import ConfigError, EnvironmentFault
from tests.cohort.stub_driver import stub, write_plan

CHECKOUT = Path(__file__).resolve().parents[2]
ENGINE = CHECKOUT / ".venv-cohort" / "bin" / "snakemake"
with_engine = pytest.mark.skipif(not ENGINE.exists(), reason="the engine is not installed (make setup-cohort)")


def nothing() -> None:
    """Nobody looks."""


def lines(place: CohortPlace, log: str) -> list[str]:
    """What the stub noted."""
    path = place.results / log
    return path.read_text().splitlines() if path.exists() else []


def until(happened: Callable[[], object], seconds: float = 60.0) -> None:
    """Wait for it."""
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)


@pytest.fixture
def place(tmp_path: Path) -> CohortPlace:
    """A results folder with three batches, whose name needs quotes in a shell."""
    results = tmp_path / "the results"
    results.mkdir()
    found = CohortPlace(results)
    write_plan(found, ("b1", "b2", "b3"))
    stub(found)
    return found


@pytest.fixture
def driving(place: CohortPlace) -> Iterator[Callable[[], subprocess.Popen[bytes]]]:
    """Start a driver in a process of its own; nothing of it outlives the test."""
    drivers: list[subprocess.Popen[bytes]] = []

    def start() -> subprocess.Popen[bytes]:
        drivers.append(
            subprocess.Popen([sys.executable, "-m", "tests.cohort.stub_driver", place.results], cwd=CHECKOUT)
        )
        return drivers[-1]

    yield start
    for process in drivers:
        process.kill()
        process.wait()
    with suppress(LookupError, OSError):
        kill(driver._session(engine_of(place)))


def engine_of(place: CohortPlace) -> int:
    """The engine's process, as the lock says."""
    return int(re.findall(r"engine (\d+)", place.lock.read_text())[0])


def kill(processes: Iterable[int]) -> None:
    """End processes at once."""
    for pid in processes:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def in_place_of_it(place: CohortPlace, script: str) -> Engine:
    """A shell script that takes the place of the engine, with a profile of this machine."""
    program = place.results / "engine.sh"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    return Engine("workstation", 0, program)


def cluster_profile(place: CohortPlace) -> str:
    """A profile of a cluster, by its path."""
    folder = place.results / "profile"
    folder.mkdir()
    (folder / "config.yaml").write_text("executor: slurm\njobs: 7\n")
    return str(folder)


@with_engine
def test_every_batch_is_done_once_and_again_only_when_something_changed(
    place: CohortPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HOME", raising=False)
    stub(place, b2=1)
    ticks: list[float] = []
    engine = find_engine("workstation", 2)
    assert run_engine(place, engine, lambda: ticks.append(time.monotonic())).ok
    assert sorted(lines(place, "done.log")) == ["b1", "b2", "b3"]
    assert sorted(line.rpartition(" ")[0] for line in lines(place, "started.log")) == ["b1 1", "b2 1", "b2 2", "b3 1"]
    assert lines(place, "leaks.log") == [], "the lock went on to a job"
    assert lines(place, "summaries.log") == ["summary"]
    assert ticks
    assert "\x1b" not in place.engine_log.read_text()
    assert not is_driven(place)

    write_plan(place, ("b1", "b2", "b3", "b4"))
    for name in ("b1", "b2", "b3"):  # a list that did not change is not written again
        os.utime(place.case_list(name), (1e9, 1e9))
    (place.workflow / ".snakemake" / "locks").mkdir(exist_ok=True)
    (place.workflow / ".snakemake" / "locks" / "0.output.lock").write_text("done/b4.csv\n")
    assert run_engine(place, engine, nothing).ok
    assert lines(place, "done.log")[3:] == ["b4"]
    assert len(lines(place, "started.log")) == 5
    assert lines(place, "summaries.log") == ["summary"] * 2


@with_engine
def test_a_batch_that_fails_is_named_and_stops_no_other_and_memory_is_shared(
    place: CohortPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    stub(place, seconds=0.1, b1=3)
    monkeypatch.setattr(driver, "total_memory", lambda: 10_000_000_000)
    write_plan(place, ("b1", "b2", "b3"), mem_mb=20_000)
    end = run_engine(place, find_engine("workstation", 3), nothing)
    assert lines(place, "order.log") == ["begin", "end"] * 5, "never two at once"
    assert not end.ok
    assert end.said == "Batch b1 returned non-zero exit status 30."
    assert sorted(lines(place, "done.log")) == ["b2", "b3"]
    assert sorted(path.stem for path in place.done("any").parent.iterdir()) == ["b2", "b3"]


@pytest.mark.fault("S03")
@with_engine
def test_an_interrupt_ends_the_engine_and_its_jobs(
    place: CohortPlace, driving: Callable[[], subprocess.Popen[bytes]]
) -> None:
    stub(place, seconds=60)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell starts what runs in the background
    try:
        wrapper = driving()
    finally:
        signal.signal(signal.SIGINT, before)
    until(lambda: len(lines(place, "started.log")) == 2)
    engine = engine_of(place)
    since = time.monotonic()
    wrapper.terminate()
    assert wrapper.wait(timeout=60) == 130
    assert sorted(lines(place, "stopped.log")) == sorted(line.split()[0] for line in lines(place, "started.log"))
    assert time.monotonic() - since < driver.LOCAL_PATIENCE_S, "it was not killed"
    assert "Trying to restart" not in place.engine_log.read_text()
    assert not driver._session(engine)
    assert not is_driven(place)


@pytest.mark.fault("S16")
@with_engine
@pytest.mark.parametrize("killed", ["wrapper", "wrapper and engine", "everything"])
def test_after_a_kill_the_next_driver_brings_every_case_to_its_end_once(
    place: CohortPlace, driving: Callable[[], subprocess.Popen[bytes]], killed: str
) -> None:
    stub(place, seconds=1.0)
    wrapper = driving()
    until(lambda: len(lines(place, "started.log")) == 2)
    engine = engine_of(place)
    wrapper.kill()
    wrapper.wait()
    if killed == "wrapper and engine":
        kill([engine])
    elif killed == "everything":
        kill(driver._session(engine))
        assert lines(place, "done.log") == []
    until(lambda: killed == "wrapper" or not is_driven(place))
    assert is_driven(place) == (killed == "wrapper")
    assert driving().wait(timeout=120) == 0
    assert sorted(lines(place, "done.log")) == ["b1", "b2", "b3"]
    assert bool(lines(place, "waited.log")) == (killed == "wrapper")
    assert lines(place, "summaries.log") == ["summary"]


def test_one_driver_at_a_time_and_another_can_be_followed(place: CohortPlace) -> None:
    with place.lock.open("w") as other:
        other.write("since 2026-01-01 00:00:00 UTC on elsewhere (pid 12, engine 13)\n")
        other.flush()
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(
            EnvironmentFault, match=r"E-ENG-02 .* at work .* since 2026.* on elsewhere \(pid 12, engine 13\)"
        ):
            run_engine(place, in_place_of_it(place, "exit 0"), nothing)
        assert is_driven(place)
        wait_for_driver(place, other.close)
    assert not is_driven(place)


def test_a_driver_is_not_refused_by_one_that_only_looks(place: CohortPlace) -> None:
    with place.lock.open("w") as other:
        fcntl.flock(other, fcntl.LOCK_SH)
        release = threading.Timer(0.15, other.close)
        release.start()
        assert run_engine(place, in_place_of_it(place, "exit 0"), nothing).ok
        release.join()


def test_what_the_engine_is_told(place: CohortPlace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "total_memory", lambda: 10_000_000_000)
    monkeypatch.setattr(driver, "usable_processors", lambda: 6)
    monkeypatch.setenv("HOME", "/nonexistent")
    write_plan(place, ("b1",), threads=3)
    engine = in_place_of_it(place, 'echo "$@"; echo "$HOME"; echo "$XDG_CACHE_HOME"; umask; cat /dev/stdin; exit 0')
    run_engine(place, engine, nothing)
    words, home, cache, mask = place.engine_log.read_text().splitlines()
    assert words.endswith("--nocolor --cores 6 --resources mem_mb=8000")
    assert home == cache == str(place.files / "engine.cache")
    assert mask == "0027"

    run_engine(place, Engine("workstation", 2, engine.snakemake), nothing)
    assert "--cores 6 " in place.engine_log.read_text(), "two batches of three threads"
    monkeypatch.setenv("HOME", str(place.results))
    run_engine(place, Engine(cluster_profile(place), 4, engine.snakemake), nothing)
    words, home, *_ = place.engine_log.read_text().splitlines()
    assert words.endswith("--nocolor --jobs 4")
    assert home == str(place.results)


@pytest.mark.parametrize(("names", "told"), [({os.getuid(): ["me"]}, "none"), ({}, str(os.getuid()))])
def test_a_user_without_a_name_is_given_one(
    place: CohortPlace, monkeypatch: pytest.MonkeyPatch, names: dict[int, list[str]], told: str
) -> None:
    """As any user of a container; the engine asks for it and would end with a KeyError."""
    for variable in ("LOGNAME", "USER", "LNAME", "USERNAME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr("pwd.getpwuid", names.__getitem__)
    run_engine(place, in_place_of_it(place, 'echo "${LOGNAME-none}"'), nothing)
    assert place.engine_log.read_text() == f"{told}\n"


def test_what_the_engine_says_is_kept_within_limits(place: CohortPlace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "LOG_BYTES", 1000)
    monkeypatch.setattr(driver, "TICK_S", 0.05)
    logs = place.workflow / ".snakemake" / "log"
    logs.mkdir(parents=True)
    for number in range(9):
        (logs / f"{number}.snakemake.log").touch()
    run_engine(place, in_place_of_it(place, "echo first"), nothing)
    assert place.engine_log.read_text() == "first\n"
    long = "seq 1000; sleep 0.5; echo last; exit 1"
    assert run_engine(place, in_place_of_it(place, long), nothing).said == "last"
    assert place.engine_log.read_text() == "last\n"
    assert place.engine_log.with_name("engine.log.1").read_text().endswith("1000\n")
    assert sorted(path.name[0] for path in logs.iterdir()) == ["5", "6", "7", "8"]


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("echo 'WorkflowError:'; echo 'Rule \033[31m x is missing'; exit 1", "Rule \\x1b[31m x is missing"),
        ("echo 'Building DAG of jobs...'; exit 3", "It ended with exit code 3 and said nothing."),
        ("kill -9 $$", "It was ended by signal 9."),
        (
            "echo \"Command 'set -e; exec x cohort-summary --results /r' died with <Signals.SIGKILL: 9>.\"; exit 1",
            "The summary died with <Signals.SIGKILL: 9>.",
        ),
    ],
)
def test_what_a_person_is_told_of_an_engine_that_failed(place: CohortPlace, script: str, said: str) -> None:
    end = run_engine(place, in_place_of_it(place, script), nothing)
    assert (end.ok, end.said) == (False, said)


def test_nothing_outlives_the_engine(place: CohortPlace) -> None:
    left = "sh -c 'trap \"echo asked; exit\" TERM; echo $$; while :; do sleep 0.02; done' & sleep 0.2; kill -9 $$"
    run_engine(place, in_place_of_it(place, left), nothing)
    pid, asked = place.engine_log.read_text().splitlines()
    assert asked == "asked"
    assert int(pid) not in driver._session(engine_of(place))


def interrupted() -> None:
    """Ctrl-C."""
    raise KeyboardInterrupt


def test_an_engine_that_does_not_end_is_killed(place: CohortPlace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "LOCAL_PATIENCE_S", 0.3)
    monkeypatch.setattr(driver, "TICK_S", 0.1)
    with pytest.raises(KeyboardInterrupt):
        run_engine(place, in_place_of_it(place, "trap '' INT TERM; while :; do sleep 0.02; done"), interrupted)
    assert not driver._session(engine_of(place))
    assert not is_driven(place)


def test_on_a_cluster_the_engine_is_given_time_to_cancel_its_jobs(
    place: CohortPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "TICK_S", 0.1)
    script = "trap 'sh -c \"sleep 0.3; echo cancelled\"; exit 1' INT; while :; do sleep 0.02; done"
    engine = Engine(cluster_profile(place), 0, in_place_of_it(place, script).snakemake)
    with pytest.raises(KeyboardInterrupt):
        run_engine(place, engine, interrupted)
    assert place.engine_log.read_text() == "cancelled\n"


def test_without_locks_the_mark_of_the_engine_is_believed(place: CohortPlace, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(_: int, __: int) -> None:
        raise OSError(37, "no locks available")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    engine = in_place_of_it(place, "exit 0")
    assert run_engine(place, engine, nothing).ok
    mark = place.workflow / ".snakemake" / "locks" / "0.output.lock"
    mark.parent.mkdir(parents=True)
    mark.touch()
    with pytest.raises(
        EnvironmentFault, match=r"E-ENG-05 .* remove the folder cohort\.files/workflow/\.snakemake/locks"
    ):
        run_engine(place, engine, nothing)


def test_an_engine_that_is_not_there(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(driver.PROGRAM_VARIABLE, str(tmp_path / "snakemake"))
    with pytest.raises(EnvironmentFault, match="E-ENG-01 CT2LUT_SNAKEMAKE names no program"):
        find_engine("workstation", 1)
    monkeypatch.delenv(driver.PROGRAM_VARIABLE)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("pipeline.__file__", str(tmp_path / "site" / "pipeline" / "__init__.py"))
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "venv"))
    with pytest.raises(EnvironmentFault, match=r"E-ENG-01 .*type: make setup-cohort"):
        find_engine("workstation", 1)


def test_where_the_engine_is_looked_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("pipeline.__file__", str(tmp_path / "site" / "pipeline" / "__init__.py"))
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "venv"))
    monkeypatch.setenv("PATH", str(tmp_path / "path"))
    monkeypatch.delenv(driver.PROGRAM_VARIABLE, raising=False)
    for folder in ("path", "venv-cohort/bin", "site/.venv-cohort/bin"):  # the later, the sooner taken
        (tmp_path / folder).mkdir(parents=True)
        program = tmp_path / folder / "snakemake"
        program.touch(mode=0o755)
        assert find_engine("workstation", 1) == Engine("workstation", 1, program)
    monkeypatch.setenv(driver.PROGRAM_VARIABLE, str(tmp_path / "path" / "snakemake"))
    assert find_engine("workstation", 1).snakemake == tmp_path / "path" / "snakemake"


def test_a_profile_that_cannot_be_used(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r'E-ENG-03 There is no profile "workstatoin" \(did you mean \'workstation\'\?\)'
    ):
        find_engine("workstatoin", 1)
    with pytest.raises(ConfigError, match=r'E-ENG-03 There is no profile "\\u001b\[2J"'):
        find_engine("\x1b[2J", 1)
    for content in ("- executor", "a: [", "\x00"):
        (tmp_path / "config.yaml").write_text(content)
        with pytest.raises(ConfigError, match=r"E-ENG-04 .* cannot be read as YAML"):
            find_engine(str(tmp_path), 1)


def test_a_damaged_plan_is_told(place: CohortPlace) -> None:
    (place.workflow / "config.json").write_text("{")
    with pytest.raises(ConfigError, match=r"E-ENG-06 .* config\.json cannot be read"):
        run_engine(place, Engine("workstation", 2, Path("/bin/false")), nothing)
