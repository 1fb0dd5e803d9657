"""A cohort of the stub program: 20 cases in 5 batches, as `ct2lut cohort` lays them out, and what became of them."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.cohort import driver
from pipeline.cohort.place import CohortPlace

CHECKOUT = Path(__file__).resolve().parents[2]
STUB = CHECKOUT / "tests" / "cluster" / "stub_program.py"
CASES = tuple(f"K{number:03d}" for number in range(1, 21))
BATCHES = ("b1", "b2", "b3", "b4", "b5")
MEMORY_MB, MINUTES = 600, 10
#: On a machine with other things to do the start of an engine takes ten seconds, and each job is two more.
DRIVE_SECONDS, END_SECONDS = 400.0, 120.0


@dataclass(frozen=True)
class Behaviour:
    """How the stub does its cases: time of one, which are refused, which batches fail at the first attempt."""

    seconds: float = 0.1
    refused: tuple[str, ...] = ()
    faulty: tuple[str, ...] = ()


@dataclass(frozen=True)
class StubCohort:
    """A cohort in a results folder."""

    place: CohortPlace
    drivers: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def drive(self, profile: str) -> subprocess.Popen[bytes]:
        """Start a driver in a process of its own."""
        command = (sys.executable, "-P", "-m", "tests.cluster.drive", str(self.place.results), profile)
        environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
        self.drivers.append(subprocess.Popen(command, cwd=CHECKOUT, env=environment))
        return self.drivers[-1]

    def finish(self, profile: str) -> None:
        """Drive it to its end; an AssertionError with the engine's last words where it fails."""
        self.wait(self.drive(profile))

    def wait(self, process: subprocess.Popen[bytes]) -> None:
        """Wait until a driver ends well."""
        code = process.wait(DRIVE_SECONDS)
        assert code == 0, f"exit code {code}: {self.place.engine_log.read_text()[-3000:]}"

    def end(self) -> None:
        """Stop the drivers that a failed test left."""
        for process in self.drivers:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                process.wait(END_SECONDS)

    def kill_driver(self, process: subprocess.Popen[bytes]) -> None:
        """SIGKILL for the driver and its engine, as when the login node goes down; jobs of the cluster go on."""
        engine = int(re.findall(r"engine (\d+)", self.place.lock.read_text())[0])
        session = driver._session(engine)
        process.kill()
        process.wait()
        for pid in session:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def words(self) -> dict[str, list[str]]:
        """What became of each case, one word for each time that it was done."""
        found = {}
        for case in CASES:
            with suppress(FileNotFoundError):
                lines = (self.place.results / case / "result.jsonl").read_text().splitlines()
                found[case] = [json.loads(line)["word"] for line in lines]
        return found

    def attempts(self, batch: str) -> list[tuple[int, str]]:
        """Number and job of every attempt at a batch, in their order."""
        path = self.place.files / "ledger" / f"{batch}.attempts"
        lines = path.read_text().splitlines() if path.exists() else []
        return [(fields["attempt"], fields["job"]) for fields in map(json.loads, lines)]

    def running(self) -> list[str]:
        """Batches that were begun and have no result."""
        return [batch for batch in BATCHES if self.attempts(batch) and not self.place.done(batch).exists()]

    def until_begun(self) -> None:
        """Wait until a batch is at work."""
        until(self.running, "a batch is at work")

    def until_some_are_done(self, cases: int = 2) -> None:
        """Wait until so many cases are done and a batch is in the middle of its work."""
        until(lambda: len(self.words()) >= cases and self.running(), "some cases are done")


def stub_cohort(results: Path, behaviour: Behaviour) -> StubCohort:
    """Lay out a cohort."""
    place = CohortPlace(results)
    place.case_list("any").parent.mkdir(parents=True)
    for number, batch in enumerate(BATCHES):
        rows = "".join(f"{case},cases/{case},s,1\n" for case in CASES[number :: len(BATCHES)])
        place.case_list(batch).write_text(f"id,folder,signature,tries\n{rows}")
    config = {
        "key": "k",
        "program": shlex.join([sys.executable, "-I", "-S", str(STUB)]),
        "results": shlex.quote(str(results)),
        "threads": 1,
        "retries": 2,
        "batches": {batch: {"mem_mb": MEMORY_MB, "minutes": MINUTES} for batch in BATCHES},
    }
    (place.workflow / "config.json").write_text(json.dumps(config))
    (results / "stub.json").write_text(json.dumps(vars(behaviour)))
    return StubCohort(place)


def until(happened: Callable[[], object], what: str, seconds: float = 120.0) -> None:
    """Wait for it; an AssertionError where it does not come."""
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end, f"not within {seconds:.0f} s: {what}"
        time.sleep(0.1)
