"""A film holds its frames in order, is the same every time, and says what it cannot hold."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.adapters import movie
from pipeline.adapters.movie import webm, with_fixed_track
from pipeline.adapters.pictures import Image, blank
from tests.source_code import CHECKOUT

SHAPES = [(32, 48), (480, 640)]
COLORS = [(230, 40, 40), (40, 200, 40), (40, 40, 220), (250, 250, 250), (120, 120, 120)]


def frames(shape: tuple[int, int] = (32, 48)) -> list[Image]:
    """Pictures of one colour each."""
    return [blank(shape[1], shape[0], color) for color in COLORS]


def read(film: bytes, folder: Path) -> tuple[list[Image], float]:
    """Frames of a film, RGB, and how many there are in a second."""
    path = folder / "read.webm"
    path.write_bytes(film)
    capture = cv2.VideoCapture(str(path))
    found = []
    while True:
        done, image = capture.read()
        if not done:
            break
        found.append(np.asarray(image[..., ::-1], dtype=np.uint8))
    rate = capture.get(cv2.CAP_PROP_FPS)
    capture.release()
    return found, rate


@pytest.mark.parametrize("shape", SHAPES)
def test_every_frame_comes_back_in_its_place(shape: tuple[int, int], tmp_path: Path) -> None:
    found, rate = read(webm(frames(shape), 12.0), tmp_path)
    assert rate == pytest.approx(12.0)
    assert [image.shape for image in found] == [(*shape, 3)] * len(COLORS)
    for image, color in zip(found, COLORS, strict=True):
        assert np.abs(image.reshape(-1, 3).mean(axis=0) - color).max() < 12


def test_it_is_a_webm_of_vp8() -> None:
    film = webm(frames(), 12.0)
    assert film[:4] == b"\x1a\x45\xdf\xa3"
    assert b"webm" in film[:48]
    assert b"V_VP8" in film


def test_the_same_frames_give_the_same_bytes_in_another_process_and_later() -> None:
    code = (
        "import hashlib; from pipeline.adapters.movie import webm; from tests.adapters.test_movie import frames;"
        "print(hashlib.sha256(webm(frames((480, 640)), 12.0)).hexdigest())"
    )
    runs = [
        subprocess.run([sys.executable, "-c", code], cwd=CHECKOUT, capture_output=True, text=True, check=True)
        for _ in range(2)
    ]
    assert runs[0].stdout == runs[1].stdout
    assert [run.stderr for run in runs] == ["", ""]


def test_only_the_random_number_of_the_track_is_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fixed = webm(frames(), 12.0)
    monkeypatch.setattr(movie, "with_fixed_track", lambda film: film)
    raw, other = webm(frames(), 12.0), webm(frames(), 12.0)
    assert raw != other
    assert with_fixed_track(raw) == with_fixed_track(other) == fixed
    changed = [i for i, (a, b) in enumerate(zip(raw, fixed, strict=True)) if a != b]
    assert len(changed) <= 16
    assert max(changed) < raw.index(b"\x1f\x43\xb6\x75")
    for one, same in zip(read(raw, tmp_path)[0], read(fixed, tmp_path)[0], strict=True):
        np.testing.assert_array_equal(one, same)


def test_both_mentions_of_the_track_name_the_same() -> None:
    film = webm(frames(), 12.0)
    names = re.findall(rb"(?:\x73\xc5|\x63\xc5)\x88(.{8})", film, re.DOTALL)
    assert names == [bytes([0, 0, 0, 0, 0, 0, 0, 1])] * 2


def test_frames_themselves_are_never_changed() -> None:
    head, body = b"\x73\xc5\x88ABCDEFGH", b"\x1f\x43\xb6\x75\x73\xc5\x88ABCDEFGH"
    assert with_fixed_track(head + body) == b"\x73\xc5\x88" + bytes(7) + b"\x01" + body
    assert with_fixed_track(b"no film at all") == b"no film at all"


def test_nothing_is_left_behind_or_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    webm(frames(), 12.0)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")
    os.write(2, b"still heard\n")
    assert capfd.readouterr().err == "still heard\n"


@pytest.mark.parametrize(
    ("shown", "problem"),
    [
        ([], "at least one frame"),
        ([blank(47, 32)], r"even height and width, got \(32, 47, 3\)"),
        ([blank(48, 31)], r"even height and width, got \(31, 48, 3\)"),
        ([np.zeros((32, 48), np.uint8)], r"expected frames \(H, W, 3\)"),
        ([blank(48, 32), blank(48, 34)], r"expected every frame \(32, 48, 3\) of uint8, got \(34, 48, 3\)"),
        ([np.zeros((32, 48, 3))], "got .* of float64"),
    ],
)
def test_frames_that_would_be_left_out_are_refused(shown: list[Image], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        webm(shown, 12.0)


def test_a_film_cut_short_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    write = movie._write

    def stop_early(path: Path, shown: list[Image], rate: float) -> None:
        write(path, shown[:-2], rate)

    monkeypatch.setattr(movie, "_write", stop_early)
    with pytest.raises(ValueError, match="only 3 of the 5 frames of a film were written; the disk may be full"):
        webm(frames(), 12.0)


def test_a_machine_without_the_encoder_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(movie, "CODEC", "nope")
    with pytest.raises(ValueError, match="OpenCV on this machine cannot write a film in WebM"):
        webm(frames(), 12.0)
