"""A segmentation program of the site: what it is given, what is taken from it, and how it may fail."""

from __future__ import annotations

import signal
import sys
import tempfile
import time
from pathlib import Path
from types import FrameType

import numpy as np
import pytest

from pipeline.adapters.site_command import CommandCall, filled_in, label_map_of, last_words, run_limited
from pipeline.errors import CaseRejected, EnvironmentFault
from pipeline.geometry.volume import CtVolume
from tests import fake_segmenter
from tests.files.label_samples import oblique_matrix

SCRIPT = str(Path(fake_segmenter.__file__))


def block(matrix: np.ndarray | None = None) -> CtVolume:
    """A block of bone in soft tissue, nowhere symmetric."""
    values = np.full((40, 30, 24), 40, dtype=np.int16)
    values[8:30, 6:20, 3:9] = 900
    return CtVolume(values, oblique_matrix() if matrix is None else matrix)


def call(mode: str, *more: str, limit_s: float = 60.0) -> CommandCall:
    words = (sys.executable, SCRIPT, mode, "{ct}", "{labels}", "{side}", *more)
    return CommandCall(words, f"fake {mode}", limit_s)


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of our own for temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def has_ended(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def ends_soon(pid: int) -> bool:
    deadline = time.monotonic() + 10
    while not has_ended(pid) and time.monotonic() < deadline:
        time.sleep(0.02)
    return has_ended(pid)


def test_the_label_map_lies_where_the_ct_does(temporary: Path) -> None:
    labels = label_map_of(call("threshold"), block(), "right")
    np.testing.assert_array_equal(labels.volume.values, block().values > 250)
    np.testing.assert_allclose(labels.volume.lps_from_index, block().lps_from_index, atol=1e-4)
    assert not list(temporary.iterdir())


def test_a_ct_far_from_the_origin_keeps_its_place_within_the_tolerance() -> None:
    matrix = oblique_matrix((0.9882813, 0.9882813, 1.2500001))
    matrix[:3, 3] = (-1234.5678, 987.6543, -1999.9999)
    assert label_map_of(call("threshold"), block(matrix), "left").counts[1] == 22 * 14 * 6


@pytest.mark.parametrize(
    ("mode", "problem"),
    [
        ("fail", r'E-SEG-03 fake fail failed: it ended with code 3 and said "no model in … or … \(out of memory\)"\.'),
        ("silent", r"E-SEG-05 fake silent ended well but left no label map\."),
        ("garbage", r"E-IO-1\d fake garbage: labels\.nii\.gz is "),
        ("shifted", r"E-SEG-06 The label map that fake shifted left lies up to 2\.5 mm off the CT, expected at most 0"),
        ("cropped", r"E-SEG-06 The label map that fake cropped left has 39 x 30 x 24 voxels, the CT 40 x 30 x 24\."),
    ],
)
def test_what_goes_wrong_is_said_plainly(mode: str, problem: str, temporary: Path) -> None:
    with pytest.raises(CaseRejected, match=problem) as caught:
        label_map_of(call(mode), block(), "right")
    assert "/" not in caught.value.problem
    assert "\x1b" not in str(caught.value)
    assert not list(temporary.iterdir())


def test_a_program_that_is_not_there(tmp_path: Path) -> None:
    words = (str(tmp_path / "segment_all"), "{ct}", "{labels}")
    with pytest.raises(
        EnvironmentFault, match=r"E-SEG-02 fake cannot be started: No such file or directory\."
    ) as caught:
        label_map_of(CommandCall(words, "fake", 60.0), block(), "right")
    assert str(tmp_path) not in str(caught.value)
    (tmp_path / "segment_all").write_text("no program")
    with pytest.raises(EnvironmentFault, match=r"E-SEG-02 fake cannot be started: Permission denied\."):
        label_map_of(CommandCall(words, "fake", 60.0), block(), "right")


def test_the_limit_ends_the_whole_group(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    with pytest.raises(CaseRejected, match=r"E-SEG-04 fake hang took longer than 3 s and was ended\."):
        label_map_of(call("hang", str(pid_file), limit_s=3.0), block(), "right")
    assert ends_soon(int(pid_file.read_text()))


def test_an_interrupt_ends_the_whole_group(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"

    def interrupt(number: int, frame: FrameType | None) -> None:
        if pid_file.exists() and pid_file.read_text():
            signal.setitimer(signal.ITIMER_REAL, 0)
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.2, 0.2)
    try:
        with pytest.raises(KeyboardInterrupt, match=r"^$"):
            label_map_of(call("hang", str(pid_file)), block(), "right")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert ends_soon(int(pid_file.read_text()))


def test_a_child_that_stays_behind_does_not_hold_up_the_case() -> None:
    begin = time.monotonic()
    assert label_map_of(call("detach"), block(), "right").counts[1] > 0
    assert time.monotonic() - begin < 30


def test_ten_megabytes_of_chatter_neither_block_nor_stay() -> None:
    assert label_map_of(call("chatter"), block(), "right").counts[1] > 0


def test_a_signal_is_named(tmp_path: Path) -> None:
    code = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"
    ending = run_limited(call("x"), [sys.executable, "-c", code], tmp_path)
    assert ending.code == -signal.SIGKILL
    words = (sys.executable, "-c", code, "{ct}", "{labels}")
    with pytest.raises(CaseRejected, match=r"E-SEG-03 fake failed: it was ended by signal 9\."):
        label_map_of(CommandCall(words, "fake", 60.0), block(), "right")


def test_no_shell_looks_at_the_words(tmp_path: Path) -> None:
    target = tmp_path / "made"
    ending = run_limited(call("x"), ["echo", f"$(touch {target})", ";", "touch", str(target)], tmp_path)
    assert ending.code == 0
    assert not target.exists()


def test_placeholders_are_parts_of_words_and_replaced_once() -> None:
    values = {"ct": "/t/{labels}/ct.nii.gz", "labels": "/t/labels.nii.gz", "side": "left"}
    words = filled_in(("--in={ct}", "{labels}", "{side}_leg", "{other}"), values)
    assert words == ["--in=/t/{labels}/ct.nii.gz", "/t/labels.nii.gz", "left_leg", "{other}"]


@pytest.mark.parametrize(
    ("said", "quoted"),
    [
        (b"", ""),
        (b"\n \n", ""),
        (b"one\ntwo\n\n", "two"),
        (b"10%\r50%\rdone", "done"),
        (b"RuntimeError: no weights in /opt/site/w", "RuntimeError: no weights in …"),
        (b"cannot open 'C:\\Site Data\\x.bin' now", "cannot open … now"),
        (b"\x1b[1;31mred\x1b[0m \x00\x07bell", "red bell"),
        (b"\xff\xfe bytes", "�� bytes"),
        (b"x" * 500, "x" * 160),
    ],
)
def test_the_last_line_is_fit_to_be_quoted(said: bytes, quoted: str) -> None:
    assert last_words(said) == quoted
