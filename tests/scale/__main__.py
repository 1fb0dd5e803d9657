"""Prints what a cohort of stub cases costs: plan, first run, nothing to do, one case more, overview, memory, files.

Everything is real but the cases: each takes some milliseconds and leaves the results of one real case as hard links.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.cohort.ledger import events
from pipeline.cohort.place import CohortPlace
from tests.scale import jobs

CT2LUT = Path(sys.executable).with_name("ct2lut")
#: What of a command line tells the part that a process plays.
ROLES = {"cohort-summary": "summary", " batch ": "batch", "snakemake": "engine", f"{CT2LUT} cohort": "driver"}
EVERY_S = 0.5
#: So many stub cases by themselves tell what one takes.
STUBS = 100


@dataclass
class Measured:
    """What one command took; ``peak_mb`` by the part that a process played."""

    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_mb: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Simulation:
    """Where it happens, and how large it is."""

    work: Path
    template: Path
    cases: int
    batch_size: int

    @property
    def listed(self) -> Path:
        """Folder of the cases."""
        return self.work / "cases"

    @property
    def place(self) -> CohortPlace:
        """Where the results are."""
        return CohortPlace(self.work / "results")

    def add_cases(self, numbers: range) -> None:
        """Make folders of cases, each with one small file."""
        for number in numbers:
            folder = self.listed / f"C{number:06d}"
            folder.mkdir(parents=True)
            (folder / "case.yaml").write_text("side: right\n")

    def cohort(self) -> Measured:
        """The real command."""
        program = f"{sys.executable} -P {Path(jobs.__file__)} {self.template}"
        words = ["--cases", str(self.listed), "--results", str(self.place.results), "--protocol", "demo"]
        size = ["--batch-size", str(self.batch_size)] if self.batch_size else []
        return measured([str(CT2LUT), "cohort", *words, *size, "--at-once", "2", "--program", program], self.work)

    def stub_cpu_s(self) -> float:
        """Processor seconds of the process of one stub case, by itself."""
        words = ["/bin/sh", str(jobs.STUB), str(self.template), "run", "--results", str(self.work / "stubs"), "--"]
        (self.work / "stubs").mkdir()
        before = os.times()
        for number in range(STUBS):
            subprocess.run([*words, f"S{number}"], check=True)
        after = os.times()
        used = after.children_user + after.children_system - before.children_user - before.children_system
        return used / STUBS

    def step(self, name: str) -> dict[str, float]:
        """One step in a process of its own."""
        words = [sys.executable, "-m", "tests.scale.steps", name, str(self.listed), str(self.place.results)]
        done = subprocess.run(words, check=True, capture_output=True, text=True)
        return dict(json.loads(done.stdout))


def measured(words: Sequence[str], work: Path) -> Measured:
    """Run a command to its end, which must be good, and look at its processes, which all name its folder."""
    found, begun, before = Measured(), time.perf_counter(), os.times()
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
    while process.poll() is None:
        for role, peak in peaks(str(work)):
            found.peak_mb[role] = max(found.peak_mb.get(role, 0.0), peak)
        time.sleep(EVERY_S)
    if process.returncode:
        raise SystemExit(f"exit code {process.returncode}: {' '.join(words)}")
    after = os.times()
    found.wall_s = time.perf_counter() - begun
    found.cpu_s = after.children_user + after.children_system - before.children_user - before.children_system
    return found


def peaks(work: str) -> Iterator[tuple[str, float]]:
    """The most memory that each process with a part has had so far, MB."""
    for entry in Path("/proc").iterdir():
        with suppress(OSError, StopIteration):
            words = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode() if entry.name.isdigit() else ""
            role = next(role for mark, role in ROLES.items() if mark in words and work in words)
            lines = (entry / "status").read_text().splitlines()
            yield role, next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) * 1024 / 1e6


def case_seconds(place: CohortPlace) -> list[float]:
    """Wall time of every process of a case, as its batch saw it."""
    ledgers = sorted(place.ledger("any").parent.glob("*.jsonl"))
    return [event.end.seconds for path in ledgers for event in events(path.read_bytes()) if event.end]


def made_template(folder: Path) -> Path:
    """The results of one real case, with every artifact and the report."""
    subprocess.run([str(CT2LUT), "phantom", str(folder / "cases"), "--id", "real"], check=True)
    words = ["--cases", str(folder / "cases"), "--results", str(folder / "results"), "--protocol", "demo"]
    subprocess.run([str(CT2LUT), "run", "real", *words], check=True)
    return folder / "results" / "real"


def tree(folder: Path) -> tuple[int, int, int]:
    """Files, folders and bytes below a folder, which counts too."""
    found = [(len(names), sum((Path(at) / name).stat().st_size for name in names)) for at, _, names in os.walk(folder)]
    return sum(count for count, _ in found), len(found), sum(size for _, size in found)


def say(name: str, value: float, unit: str, remark: str = "") -> None:
    """One row."""
    sys.stdout.write(f"{name:<40}{value:>12.4g} {unit:<8}{remark}\n")
    sys.stdout.flush()


def say_run(name: str, found: Measured) -> None:
    """The rows of a command."""
    say(f"{name}_wall", found.wall_s, "s")
    say(f"{name}_cpu", found.cpu_s, "s", "of all its processes")
    for role, peak in sorted(found.peak_mb.items()):
        say(f"{name}_peak_{role}", peak, "MB", f"sampled every {EVERY_S} s")


def simulate(one: Simulation) -> None:
    """Everything, in its order."""
    files, folders, size = tree(one.template)
    say("case_files", files, "files", f"{folders} folders, {size / 1e6:.1f} MB; what every case leaves")
    one.add_cases(range(one.cases))
    if not one.batch_size:
        say_step("plan", one.step("plan"))
        say_step("plan_again", one.step("plan"))
    first = one.cohort()
    say_run("first_run", first)
    seconds = case_seconds(one.place)
    assert len(seconds) == one.cases
    say("stub_case", 1e3 * sum(seconds) / one.cases, "ms", "wall time of its process")
    say("overhead", 1e3 * (first.cpu_s / one.cases - one.stub_cpu_s()), "CPU ms", "a case, all beside its process")
    say_run("nothing_to_do", one.cohort())
    assert len(case_seconds(one.place)) == one.cases
    one.add_cases(range(one.cases, one.cases + 1))
    say_run("one_case_more", one.cohort())
    say("one_case_more_cases", len(case_seconds(one.place)) - one.cases, "cases", "run again: those of its batch")
    say_overview(one)


def say_overview(one: Simulation) -> None:
    """What the summary and the progress cost, by themselves."""
    for step in ("watcher", "looks"):
        say_step(step, one.step(step))
    (one.place.results / "index.json").unlink()
    (one.place.results / "index.html").unlink()
    shutil.rmtree(one.place.results / "index.files")
    say_step("overview_first", one.step("summary"))
    say_step("overview_again", one.step("summary"))
    for name in (
        "index.html",
        "index.json",
        "cohort.csv",
        "cohort.files/plan.json",
        "cohort.files/workflow/config.json",
    ):
        say(Path(name).name, (one.place.results / name).stat().st_size / 1e6, "MB")
    files, folders, size = tree(one.place.files)
    say("cohort_files", files, "files", f"{folders} folders, {size / 1e6:.1f} MB; what the cohort itself keeps")


def say_step(name: str, found: dict[str, float]) -> None:
    """The rows of a step."""
    say(name, found["wall_s"], "s", f"{found['cpu_s']:.1f} s of CPU with start, {found['peak_mb']:.0f} MB")


def main() -> None:
    """Measure and print each row as soon as it is known."""
    parser = argparse.ArgumentParser(prog="python -m tests.scale", description=__doc__)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--batch-size", type=int, default=0, help="0 leaves it to the program")
    parser.add_argument("--template", type=Path, help="results of one finished case that passed; made where not given")
    parser.add_argument("--work", type=Path, help="an empty folder on the disk to be measured; removed at the end")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=asked.work) as name:
        template = asked.template or made_template(Path(name) / "template")
        own = Path(name) / "one"
        # hard links cannot cross disks, and the simulation must not touch what it was given
        shutil.copytree(template, own)
        simulate(Simulation(Path(name), own.resolve(), asked.cases, asked.batch_size))


if __name__ == "__main__":
    main()
