"""Hostile files through the whole of intake: each costs its own case, in time, and the program goes on.

Ids such as D17 are those of the list of faults. What no program can notice: a flipped bit of an uncompressed pixel
that leaves a CT number which a scanner may give (``test_flipped_bits_of_pixels``); only checksums of the sender tell.
"""

from __future__ import annotations

import ctypes
import gzip
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts import CT
from pipeline.engine.artifacts import SourceFolder
from pipeline.engine.outcome import RunOutcome
from pipeline.engine.sandbox import _drop_capabilities  # the powers of root would make every file readable
from pipeline.engine.source import list_source
from pipeline.engine.stage import Limits, Stage
from pipeline.errors import CaseRejected, ExitCode
from pipeline.files import dicom_series, volumes
from pipeline.files.dicom_writer import SeriesSpec
from pipeline.stages import intake
from tests.end_to_end.knee_runs import left, run
from tests.engine.crash_tools import in_child, wait
from tests.files.dicom_samples import deflated, headers_of, leg, series
from tests.files.label_samples import knee_like, nifti_bytes, nrrd_bytes

#: How many spoilt series of each kind; more of them on request: HOSTILE_MUTATIONS=1000.
MUTATIONS = int(os.environ.get("HOSTILE_MUTATIONS", "8"))
DECLARATION = "side: right\njoint: knee\nlabels: {femur: 5, tibia: 6}\n"
#: Enough for the small samples and the libraries that read them, far less than what a bomb unfolds to.
TIGHT = Limits(memory_bytes=400_000_000, wall_s=30.0)
BOMB_BYTES = 500_000_000
MIDDLE = "IM0006.dcm"


def case_of(folder: Path, files: Mapping[str, bytes]) -> Path:
    """A case folder with a declaration and files."""
    folder.mkdir(parents=True)
    for name, data in {"case.yaml": DECLARATION.encode(), **files}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def ct_case(folder: Path, files: Mapping[str, bytes]) -> Path:
    return case_of(folder, {f"ct/{name}": data for name, data in files.items()})


def taken_in(case: Path, limits: Limits = TIGHT) -> RunOutcome:
    """Intake of a case, results beside the folder of cases."""
    stage = replace(intake.STAGE, limits=limits)
    return run(case, case.parents[1] / "results", (stage,))


def good_case(base: Path) -> Path:
    return case_of(base / "cases" / "good", {"labels.nrrd": nrrd_bytes(knee_like())})


def is_refused(outcome: RunOutcome, code: str, words: str = "") -> bool:
    return (outcome.word, outcome.code) == ("REJECTED", code) and words in str(outcome.problem)


def flipped(data: bytes, places: range, random: np.random.Generator, count: int = 1) -> bytes:
    out = bytearray(data)
    for place in random.integers(places.start, places.stop, count):
        out[place] ^= 1 << int(random.integers(0, 8))
    return bytes(out)


def pixels_of(name: str, data: bytes) -> range:
    return range(*headers_of({name: data})[0].pixels)


# bombs and lies about size


@pytest.mark.fault("D17")
def test_a_deflated_bomb_is_not_inflated(tmp_path: Path) -> None:
    files = series()
    bomb = deflated(files[MIDDLE], surplus=BOMB_BYTES)
    assert len(bomb) < BOMB_BYTES // 500
    outcome = taken_in(ct_case(tmp_path / "cases" / "bomb", {**files, MIDDLE: bomb}))
    assert is_refused(outcome, "E-DCM-04", "deflated")


@pytest.mark.fault("V22")
def test_a_gzip_bomb_is_not_inflated(tmp_path: Path) -> None:
    head = bytearray(nifti_bytes(knee_like(), compressed=False))
    piece = gzip.compress(bytes(10_000_000))
    bomb = gzip.compress(bytes(head)) + piece * (BOMB_BYTES // 10_000_000)
    outcome = taken_in(case_of(tmp_path / "cases" / "bomb", {"labels.nii.gz": bomb}))
    assert is_refused(outcome, "E-IO-11", "more than the")
    struct.pack_into("<4h", head, 40, 3, 10_000, 10_000, 10_000)
    outcome = taken_in(case_of(tmp_path / "cases" / "liar", {"labels.nii.gz": gzip.compress(bytes(head)) + piece}))
    assert is_refused(outcome, "E-IO-14", "10000 x 10000 x 10000")


# flipped bits


@pytest.mark.fault("D19")
def test_flipped_bits_of_pixels(tmp_path: Path) -> None:
    """Of a plain slice: refused, to be looked at, or one CT number differs, which nobody can know."""
    files, random = series(), np.random.default_rng(19)
    for number in range(MUTATIONS):
        case = ct_case(tmp_path / "cases" / f"P{number}", files)
        spoilt = flipped(files[MIDDLE], pixels_of(MIDDLE, files[MIDDLE]), random)
        (case / "ct" / MIDDLE).write_bytes(spoilt)
        outcome = taken_in(case)
        assert outcome.word in ("PASS", "REVIEW", "REJECTED"), outcome
        if outcome.word == "PASS":
            found = left(tmp_path / "results" / f"P{number}", CT)
            assert found is not None
            different = np.argwhere(found.values != leg().values)
            assert len(different) == 1
            assert different[0][2] == 5


SYNTAXES = ("explicit little endian", "RLE", "JPEG lossless", "JPEG-LS lossless", "JPEG 2000 lossless")


@pytest.mark.fault("D20", "D23")
@pytest.mark.parametrize("syntax", SYNTAXES)
@pytest.mark.parametrize("part", ["header", "pixels"])
def test_spoilt_slices_are_contained(syntax: str, part: str, tmp_path: Path) -> None:
    files = series(SeriesSpec(syntax=syntax))
    pixels = pixels_of(MIDDLE, files[MIDDLE])
    places = pixels if part == "pixels" else range(132, pixels.start)
    random = np.random.default_rng([SYNTAXES.index(syntax), part == "pixels"])
    for number in range(MUTATIONS):
        case = ct_case(tmp_path / "cases" / f"P{number}", files)
        (case / "ct" / MIDDLE).write_bytes(flipped(files[MIDDLE], places, random, int(random.integers(1, 9))))
        outcome = taken_in(case)
        assert outcome.word in ("PASS", "REVIEW", "REJECTED"), (number, outcome)
        if outcome.word != "REJECTED":
            found = left(tmp_path / "results" / f"P{number}", CT)
            assert found is not None
            same = np.delete(found.values == leg().values, 5, axis=2)
            assert same.all(), "a spoilt slice may differ itself, and spoils no other"


# folders


@pytest.mark.fault("D25")
def test_folders_full_of_traps_are_taken_in(tmp_path: Path) -> None:
    case = good_case(tmp_path)
    (case / "a" / "b" / "c").mkdir(parents=True)
    (case / "a" / "b" / "c" / "up").symlink_to("../../..")
    (case / "again").symlink_to("a")
    os.mkfifo(case / "pipe.dcm")
    with socket.socket(socket.AF_UNIX) as address:
        address.bind(str(case / "socket"))
        assert taken_in(case).exit_code in (ExitCode.PASS, ExitCode.REVIEW)


@pytest.mark.fault("D25")
@pytest.mark.parametrize("target", ["/dev/zero", "/dev/tty", "/proc/self/mem", "../other/labels.nrrd", "labels.nrrd"])
def test_links_out_of_the_case_and_loops_are_refused(tmp_path: Path, target: str) -> None:
    case_of(tmp_path / "cases" / "other", {"labels.nrrd": nrrd_bytes(knee_like())})
    case = case_of(tmp_path / "cases" / "P1", {})
    (case / "labels.nrrd").symlink_to(target)
    assert is_refused(taken_in(case), "E-IO-02", "labels.nrrd is a link")


@pytest.mark.fault("D25")
def test_an_unreadable_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = good_case(tmp_path)
    (case / "labels.nrrd").chmod(0)
    monkeypatch.setattr("pipeline.engine.sandbox._CAPABILITIES", (0x20080522, 0))

    def work() -> None:
        _drop_capabilities(ctypes.CDLL(None))
        assert is_refused(taken_in(case), "E-IO-04", "labels.nrrd cannot be read")

    assert wait(in_child(work)) == 0


@pytest.mark.fault("D25")
def test_very_many_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dicom_series, "MAX_FILES", 2_000)
    case = ct_case(tmp_path / "cases" / "P1", {f"{number}.dcm": b"" for number in range(2_001)})
    assert is_refused(taken_in(case), "E-IO-14", "holds 2001 files")


@pytest.mark.fault("D26")
@pytest.mark.parametrize("name", ["labels.nrrd", "ct/IM0006.dcm"])
def test_a_file_that_changes_after_it_was_listed(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    files = {f"ct/{file}": data for file, data in series().items()}
    case = case_of(tmp_path / "cases" / "P1", {**files, "labels.nrrd": nrrd_bytes(knee_like())})

    def list_then_change(case_id: str, root: Path) -> SourceFolder:
        listed = list_source(case_id, root)
        with (root / name).open("ab") as stream:
            stream.write(b"still being copied")
        return listed

    monkeypatch.setattr("pipeline.engine.runner.list_source", list_then_change)
    assert is_refused(taken_in(case), "E-IO-17", f"{name} changed")


# a reader that was taken over by what it read, or cannot end


def with_reader(monkeypatch: pytest.MonkeyPatch, act: Callable[[], object]) -> None:
    """The reader of label maps does something else first."""
    reader = volumes.read_label_map

    def reading(data: bytes, file: str) -> volumes.LabelMap:
        act()
        return reader(data, file)

    monkeypatch.setattr(intake, "read_label_map", reading)


def test_a_reader_that_was_taken_over_reaches_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # X15
    case = good_case(tmp_path)
    other = case_of(tmp_path / "cases" / "other", {"labels.nrrd": b"of another patient"})
    acts: dict[str, Callable[[], object]] = {
        "network": lambda: socket.create_connection(("127.0.0.1", 9)),
        "another patient": (other / "labels.nrrd").read_bytes,
        "all patients": lambda: list(other.parent.iterdir()),
        "own input": lambda: (case / "labels.nrrd").write_bytes(b""),
        "other input": (other / "labels.nrrd").unlink,
        "results": (tmp_path / "results" / "good" / "80_qa").mkdir,
        "program": lambda: subprocess.run(["true"], check=False),
        "parent": lambda: os.kill(os.getppid(), signal.SIGTERM),
    }

    def attack() -> None:
        reached = []
        for name, act in acts.items():
            try:
                act()
                reached.append(name)
            except PermissionError:
                pass
            except OSError as error:
                reached.append(f"{name} ({error.strerror})")
        raise CaseRejected("E-TOY-01", f"reached: {', '.join(reached)}", "none")

    with_reader(monkeypatch, attack)
    outcome = taken_in(case)
    log = (tmp_path / "results" / "good" / "log.jsonl").read_text()
    if "could not be kept from" in log:
        pytest.skip("this system cannot seal a process")
    assert (outcome.code, outcome.problem) == ("E-TOY-01", "reached: ")
    assert (other / "labels.nrrd").read_bytes() == b"of another patient"


def never_end() -> None:
    while True:
        time.sleep(1)


def take_all_memory() -> None:
    _ = [np.ones(10_000_000) for _ in range(100)]


def end_the_process() -> None:
    ctypes.string_at(0)


@pytest.mark.parametrize(
    ("act", "wall_s", "code"),
    [(never_end, 0.5, "E-IO-21"), (take_all_memory, 30.0, "E-IO-20"), (end_the_process, 30.0, "E-IO-19")],
)
def test_the_program_goes_on_with_the_next_case(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, act: Callable[[], object], wall_s: float, code: str
) -> None:  # X16
    case = good_case(tmp_path)
    with monkeypatch.context() as patch:
        with_reader(patch, act)
        outcome = taken_in(case, replace(TIGHT, wall_s=wall_s))
    assert is_refused(outcome, code, "labels.nrrd could not be read safely")
    assert outcome.action
    record = json.loads((tmp_path / "results" / "good" / "run.json").read_text())
    assert record["outcome"]["code"] == code
    assert not (tmp_path / "results" / "good" / "10_intake").exists()
    assert taken_in(case).exit_code in (ExitCode.PASS, ExitCode.REVIEW)


PROGRAM = """
import dataclasses, time
from pipeline import cli
from pipeline.stages import intake
intake.read_label_map = lambda data, file: time.sleep(60)
cli.main()
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_a_signal_leaves_no_process(tmp_path: Path, number: signal.Signals) -> None:
    case = good_case(tmp_path)
    command = [sys.executable, "-P", "-c", PROGRAM, "run", "good", "--cases", str(case.parent)]
    log = tmp_path / "results" / "good" / "log.jsonl"
    with subprocess.Popen(
        [*command, "--results", str(tmp_path / "results")], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as process:
        deadline = time.monotonic() + 30
        while not (log.exists() and "runs, because" in log.read_text()):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        started = time.monotonic()
        process.send_signal(number)
        process.communicate(timeout=20)
    assert time.monotonic() - started < 5
    assert process.returncode == (-signal.SIGKILL if number == signal.SIGKILL else ExitCode.INTERRUPTED)
    assert children  # what reads the case, and what gets ready for later stages
    while any(Path(f"/proc/{child}").exists() for child in children):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_intake_is_confined() -> None:
    stage: Stage = intake.STAGE
    assert stage.limits == Limits()
