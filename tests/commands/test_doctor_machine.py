"""What the doctor finds of memory, processors and limits, on pretended machines and containers."""

from __future__ import annotations

import os
import resource
import tempfile
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipeline.commands import doctor_machine
from pipeline.commands.doctor import checked
from pipeline.commands.doctor_answer import Answer, State

GB = 1_000_000_000
Patch = pytest.MonkeyPatch


@dataclass(frozen=True)
class Machine:
    """A pretended machine: files of /proc and of control groups below a folder, and a number of processors."""

    root: Path
    patch: Patch

    def has(self, memory: float, free: float, processors: int = 2) -> None:
        text = f"MemTotal: {int(memory * GB / 1024)} kB\nMemFree: 1 kB\nMemAvailable: {int(free * GB / 1024)} kB\n"
        self.write("proc/meminfo", text)
        self.patch.setattr(os, "sched_getaffinity", lambda _: set(range(processors)))
        self.patch.setattr(os, "cpu_count", lambda: 64)

    def write(self, name: str, text: str) -> None:
        (self.root / name).parent.mkdir(parents=True, exist_ok=True)
        (self.root / name).write_text(text)


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: Patch) -> Machine:
    monkeypatch.setattr(doctor_machine, "_PROC", tmp_path / "proc")
    monkeypatch.setattr(doctor_machine, "_CGROUPS", tmp_path / "cgroup")
    return Machine(tmp_path, monkeypatch)


def test_enough_memory(machine: Machine) -> None:
    machine.has(memory=16, free=8)
    found = "16.0 GB, 8.0 GB of it free; with --jobs 2 a patient takes up to 1.2 GB (make bench)"
    assert doctor_machine.memory() == Answer(found)


def test_memory_in_use_is_worth_a_look(machine: Machine) -> None:
    machine.has(memory=16, free=0.5)
    answer = doctor_machine.memory()
    assert (answer.state, "ps aux" in answer.action) == (State.LOOK, True)


def test_too_little_memory_cannot_work(machine: Machine) -> None:
    machine.has(memory=1, free=1)
    assert doctor_machine.memory().state is State.FAIL


def test_many_processes_take_more_memory(machine: Machine) -> None:
    machine.has(memory=16, free=8, processors=64)
    answer = doctor_machine.memory()
    assert answer.state is State.LOOK
    assert "with --jobs 64 a patient takes up to 19.8 GB" in answer.found
    assert answer.action.endswith("--jobs 24")


@pytest.mark.parametrize(
    ("groups", "files"),
    [
        ("0::/slice/job\n", {"slice/job/memory.max": "max\n", "slice/memory.max": f"{GB}\n"}),
        ("0::/\n", {"memory.max": f"{GB}\n"}),
        ("3:cpu:/\n4:memory,other:/job\n", {"memory/job/memory.limit_in_bytes": f"{GB}\n"}),
        # inside a container the path is that of the machine outside
        ("4:memory:/job\n", {"memory/memory.limit_in_bytes": f"{GB}\n"}),
    ],
)
def test_a_container_has_the_memory_that_it_is_given(machine: Machine, groups: str, files: dict[str, str]) -> None:
    machine.has(memory=64, free=60)
    machine.write("proc/self/cgroup", groups)
    for name, text in files.items():
        machine.write(f"cgroup/{name}", text)
    answer = doctor_machine.memory()
    assert (answer.state, answer.found[:21]) == (State.FAIL, "1.0 GB, 1.0 GB of it ")


def test_a_group_without_limits_limits_nothing(machine: Machine) -> None:
    machine.has(memory=64, free=60)
    machine.write("proc/self/cgroup", "0::/job\n4:memory:/\n1:cpu:/\n")
    for name, text in {"job/memory.max": "max", "job/cpu.max": "max 100000", "cpu/cpu.cfs_quota_us": "-1"}.items():
        machine.write(f"cgroup/{name}", text)
    machine.write("cgroup/memory/memory.limit_in_bytes", "9223372036854771712")
    assert doctor_machine.memory().found.startswith("64.0 GB, 60.0 GB of it free")
    assert doctor_machine.processors() == Answer("2 of 64; a run starts 2 processes")


@pytest.mark.parametrize(
    ("groups", "name", "text", "share"),
    [
        ("0::/job\n", "job/cpu.max", "250000 100000\n", "2.5"),
        ("0::/job\n", "cpu.max", "25000 50000\n", "0.5"),
        ("1:cpu,cpuacct:/job\n", "cpu/job/cpu.cfs_quota_us", "300000\n", "3"),
    ],
)
def test_a_share_of_the_processors(machine: Machine, groups: str, name: str, text: str, share: str) -> None:
    machine.has(memory=64, free=60, processors=8)
    machine.write("proc/self/cgroup", groups)
    machine.write(f"cgroup/{name}", text)
    answer = doctor_machine.processors()
    assert answer.found == f"8 of 64; a run starts 8 processes but may use only {share} processors at a time"
    assert (answer.state, answer.action.rpartition("--jobs ")[2]) == (State.LOOK, str(max(1, int(float(share)))))


def test_a_machine_that_does_not_tell_is_a_failed_check(machine: Machine) -> None:
    check = checked("memory", doctor_machine.memory)
    assert (check.state, check.found) == (State.FAIL, "The check failed: the operating system refused (ENOENT).")


@pytest.mark.parametrize("need", doctor_machine.NEEDS, ids=lambda need: need.name)
def test_low_limits_are_named(machine: Machine, monkeypatch: Patch, need: doctor_machine.Need) -> None:
    allowed = dict.fromkeys((one.kind for one in doctor_machine.NEEDS), resource.RLIM_INFINITY)
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (allowed[kind], resource.RLIM_INFINITY))
    assert doctor_machine.limits() == Answer("open files unlimited, processes and threads unlimited")
    allowed[need.kind] = need.least
    assert doctor_machine.limits().state is State.OK
    allowed[need.kind] = need.least - 1
    answer = doctor_machine.limits()
    assert (answer.state, answer.action) == (State.LOOK, f"Raise it before a run: {need.command}")
    assert answer.found == f"{need.name} {need.least - 1}, expected at least {need.least}"


def test_a_container_limits_processes_too(machine: Machine) -> None:
    machine.write("proc/self/cgroup", "0::/\n")
    machine.write("cgroup/pids.max", "32\n")
    answer = doctor_machine.limits()
    assert (answer.state, answer.found) == (State.LOOK, "processes and threads 32, expected at least 128")


def test_no_place_for_temporary_files(monkeypatch: Patch, tmp_path: Path) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    answer = doctor_machine.temporary()
    assert (answer.state, "--tmpfs /tmp" in answer.action) == (State.FAIL, True)
