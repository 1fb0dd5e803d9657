"""What a sealed process cannot do any more, and what it still can."""

from __future__ import annotations

import errno
import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import pytest

from pipeline.engine import sandbox
from pipeline.engine.sandbox import SEALED, seal, usable_bytes
from pipeline.engine.stage import Limits
from tests.engine.crash_tools import in_child, wait

LIMITS = Limits(memory_bytes=300_000_000, wall_s=30.0)


def answers(readable: Path, acts: Mapping[str, Callable[[], object]], limits: Limits = LIMITS) -> dict[str, str]:
    """Name of an act -> ``done`` or the error that it met in a sealed child; and what could not be sealed."""
    receiving, sending = os.pipe()
    parent = os.getpid()

    def work() -> None:
        found = {"open still": " ".join(seal(limits, [readable], sending, parent))}
        for name, act in acts.items():
            try:
                found[name] = f"done {act()}"
            except (OSError, ValueError, MemoryError) as error:
                number = error.errno if isinstance(error, OSError) else None
                found[name] = errno.errorcode[number] if number else type(error).__name__
        os.write(sending, json.dumps(found).encode())

    child = in_child(work)
    os.close(sending)
    with os.fdopen(receiving) as stream:
        found: dict[str, str] = json.loads(stream.read() or "{}")
    assert wait(child) == 0
    return found


@pytest.fixture
def case(tmp_path: Path) -> Path:
    for name in ("P1", "P2"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "scan.txt").write_text(f"of {name}")
    return tmp_path / "P1"


def needs(found: Mapping[str, str], what: str) -> None:
    if what in found["open still"]:
        pytest.skip(f"this system cannot take away {what}")


def test_no_network_no_other_program_no_other_process(case: Path) -> None:
    parent = os.getpid()
    acts: dict[str, Callable[[], object]] = {
        "internet": lambda: socket.socket(socket.AF_INET),
        "local": lambda: socket.socket(socket.AF_UNIX),
        "pair": socket.socketpair,
        "fork": os.fork,
        "exec": lambda: os.execv("/bin/true", ["true"]),
        "signal": lambda: os.kill(parent, signal.SIGTERM),
        "program": lambda: subprocess.run([sys.executable, "-c", ""], check=False),
    }
    found = answers(case, acts)
    needs(found, SEALED[0])
    assert {name: found[name] for name in acts} == dict.fromkeys(acts, "EACCES")


def test_nothing_can_be_changed(case: Path) -> None:
    scan = case / "scan.txt"
    acts: dict[str, Callable[[], object]] = {
        "write": lambda: scan.write_text("x"),
        "append": lambda: scan.open("a"),
        "read and write": lambda: os.open(scan, os.O_RDWR),
        "empty": lambda: os.open(scan, os.O_RDONLY | os.O_TRUNC),
        "new": (case / "new").touch,
        "new elsewhere": (case.parent / "P2" / "new").touch,
        "truncate": lambda: os.truncate(scan, 0),
        "rename": lambda: scan.rename(case / "other"),
        "remove": scan.unlink,
        "folder": (case / "folder").mkdir,
        "mode": lambda: scan.chmod(0o777),
        "mode of what is open": lambda: os.fchmod(os.open(scan, os.O_RDONLY), 0o777),
        "owner": lambda: os.chown(scan, os.getuid(), os.getgid()),
        "times": lambda: os.utime(scan, (1, 1)),
        "link": lambda: (case / "link").symlink_to(scan),
        "hard link": lambda: (case / "link").hardlink_to(scan),
        "pipe": lambda: os.mkfifo(case / "pipe"),
    }
    before = (scan.stat(), sorted(case.parent.rglob("*")))
    found = answers(case, acts)
    needs(found, SEALED[0])
    assert {name: found[name] for name in acts} == dict.fromkeys(acts, "EACCES")
    assert (scan.stat().st_mode, scan.stat().st_mtime_ns) == (before[0].st_mode, before[0].st_mtime_ns)
    assert (scan.read_text(), sorted(case.parent.rglob("*"))) == ("of P1", before[1])


def test_other_patients_cannot_be_read(case: Path) -> None:
    other = case.parent / "P2"
    acts: dict[str, Callable[[], object]] = {
        "file": (other / "scan.txt").read_text,
        "folder": lambda: list(other.iterdir()),
        "above": lambda: list(case.parent.iterdir()),
        "another process": lambda: Path(f"/proc/{os.getppid()}/environ").read_bytes(),
        "own": (case / "scan.txt").read_text,
        "library": lambda: Path(os.__file__).read_bytes()[:3],
    }
    found = answers(case, acts)
    needs(found, SEALED[1])
    denied = {name: found[name] for name in ("file", "folder", "above", "another process")}
    assert denied == dict.fromkeys(denied, "EACCES")
    assert found["own"] == "done of P1"
    assert found["library"].startswith("done")


def test_a_place_of_the_program_that_holds_the_case_is_not_laid_open(
    case: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(case.parent))
    places = list(sandbox._of_the_program([case]))
    assert case.parent not in places
    assert Path(os.__file__).parent.resolve() in places


def test_computing_goes_on(case: Path) -> None:
    def threads() -> str:
        seen: list[str] = []
        worker = threading.Thread(target=lambda: seen.append("worked"))
        worker.start()
        worker.join(5)
        return seen[0]

    def numbers() -> float:
        import numpy as np  # noqa: PLC0415 - in the sealed process
        from scipy import ndimage  # noqa: PLC0415 - the first import may well happen there

        return float(ndimage.gaussian_filter(np.ones((5, 5)), 1.0).sum())

    acts = {"threads": threads, "numbers": numbers, "memory": lambda: len(bytearray(100_000_000))}
    found = answers(case, acts, Limits(memory_bytes=1_000_000_000))
    assert found["threads"] == "done worked"
    assert float(found["numbers"].removeprefix("done ")) == pytest.approx(25.0)
    assert found["memory"] == "done 100000000"


def test_limits_hold_and_cannot_be_raised(case: Path) -> None:
    kinds = {
        "time": resource.RLIMIT_CPU,
        "file": resource.RLIMIT_FSIZE,
        "files": resource.RLIMIT_NOFILE,
        "core": resource.RLIMIT_CORE,
    }
    acts: dict[str, Callable[[], object]] = {
        name: partial(lambda kind: resource.getrlimit(kind)[1], kind) for name, kind in kinds.items()
    }
    acts["memory"] = lambda: bytearray(400_000_000)
    acts["raised"] = lambda: resource.setrlimit(resource.RLIMIT_CORE, (1000, 1000))
    found = answers(case, acts)
    assert {name: found[name] for name in kinds} == {
        "time": "done 31",
        "file": "done 0",
        "files": "done 256",
        "core": "done 0",
    }
    assert (found["memory"], found["raised"]) == ("MemoryError", "ValueError")


def test_no_descriptor_of_the_parent_stays_open(case: Path) -> None:
    with (case.parent / "P2" / "scan.txt").open() as stream:
        found = answers(case, {"open": lambda: os.fstat(stream.fileno()), "leads": lambda: os.getsid(0) == os.getpid()})
    assert found["open"] == "EBADF"
    assert found["leads"] == "done True"


def test_usable_memory_is_never_all_of_the_computer() -> None:
    physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    assert usable_bytes(Limits(memory_bytes=10)) == 10
    assert usable_bytes(Limits(memory_bytes=10 * physical)) == int(0.75 * physical)


# the filter of system calls, read as the kernel reads it

_AUDIT_X86_64, _AUDIT_AARCH64 = 0xC000003E, 0xC00000B7


def verdict(mark: int, number: int, arguments: tuple[int, ...] = (), processor: int | None = None) -> int:
    """What the filter for one processor returns."""
    column = {_AUDIT_X86_64: 0, _AUDIT_AARCH64: 1}[mark]
    words = {0: number, 4: mark if processor is None else processor}
    words |= {16 + 8 * index: value for index, value in enumerate(arguments)}
    steps = list(sandbox._filter_steps(mark, column))
    at = loaded = 0
    while True:
        operation, so, otherwise, value = steps[at]
        at += 1
        if operation == sandbox._LOAD:
            loaded = words.get(value, 0)
        elif operation == sandbox._RETURN:
            return value
        else:
            tests = {
                sandbox._IF_EQUAL: loaded == value,
                sandbox._IF_AT_LEAST: loaded >= value,
                sandbox._IF_ANY_BIT: bool(loaded & value),
            }
            at += so if tests[operation] else otherwise


DENIED = 0x00050000 | errno.EACCES
WRITES = [os.O_WRONLY, os.O_RDWR, os.O_CREAT, os.O_TRUNC, os.O_RDWR | os.O_CLOEXEC]


@pytest.mark.parametrize(("mark", "openat", "clone"), [(_AUDIT_X86_64, 257, 56), (_AUDIT_AARCH64, 56, 220)])
def test_the_filter_of_each_processor(mark: int, openat: int, clone: int) -> None:
    assert {verdict(mark, openat, (0, 0, flags)) for flags in WRITES} == {DENIED}
    assert verdict(mark, openat, (0, 0, os.O_RDONLY | os.O_CLOEXEC)) == 0x7FFF0000
    assert verdict(mark, clone, (0x11,)) == DENIED
    assert verdict(mark, clone, (0x3D0F00,)) == 0x7FFF0000
    assert verdict(mark, 435) == 0x00050000 | errno.ENOSYS
    assert verdict(mark, 63) == 0x7FFF0000
    assert verdict(mark, 63, processor=0x40000003) == 0x80000000
    assert verdict(mark, 0x40000000 + 41) == 0x80000000


HEADERS = {
    0: ("/usr/include/x86_64-linux-gnu/asm/unistd_64.h", r"#define __NR_(\w+) (\d+)"),
    1: ("/usr/include/asm-generic/unistd.h", r"#define __NR(?:3264)?_(\w+) (\d+)"),
}


@pytest.mark.parametrize("column", HEADERS)
def test_the_numbers_are_those_of_the_kernel(column: int) -> None:
    file, pattern = HEADERS[column]
    if not Path(file).exists():
        pytest.skip("the headers of the kernel are not installed")
    known = {name: int(number) for name, number in re.findall(pattern, Path(file).read_text())}
    tables = sandbox._NETWORK | sandbox._PROCESSES | sandbox._CHANGES | sandbox._UNKNOWN
    for name, numbers in tables.items():
        if name in known:  # older headers lack the newest calls
            assert numbers[column] == known[name], name
        else:
            assert numbers[column] in (None, 452), name
