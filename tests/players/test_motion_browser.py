"""The film of the report in a real browser: it plays from inside the page, and asks nothing of the network.

``.venv/bin/python -P -m pytest tests/players/test_motion_browser.py``
"""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.report.build import Page, report_html
from pipeline.report.figures import Drawn, drawn
from pipeline.report.motion import FRAMES_PER_SECOND, MOTION
from pipeline.report.settings import Limits, PictureSettings
from pipeline.report.verdict import judge
from tests.players.browser import CHROMIUM, SOFTWARE_WEBGL, Browser
from tests.report.sample import sample_evidence

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: the film is tried in no browser")

SETTINGS = PictureSettings(panel_px=150, motion_poses=7)
FRAMES = 13
FILM = "document.querySelector('.motion video')"
#: The film loaded, or refused.
READY = (
    f"new Promise(done => {{ const film = {FILM};film.oncanplaythrough = film.onerror = () => done(1); film.load() }})"
)
#: The film paused at a time, once the browser has drawn it.
SEEK = (
    "new Promise(done => {{ const film = {film}; film.pause();"
    "film.onseeked = () => requestAnimationFrame(() => requestAnimationFrame(() => done(film.currentTime)));"
    "film.currentTime = {seconds} }})"
)


def written(folder: Path, film: Drawn) -> Path:
    """A page that shows this film, alone in a folder."""
    page = folder / "moved alone.html"
    page.write_bytes(report_html(Page(sample_evidence(), judge((), (), {}), [film], (), SETTINGS)))
    return page


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A browser that shows the page of the sample with its film ready to play."""
    film = drawn(MOTION, sample_evidence(), SETTINGS, Limits())
    with Browser(tmp_path_factory.mktemp("profile"), *SOFTWARE_WEBGL) as one:
        one.open(written(tmp_path_factory.mktemp("page"), film))
        one.run(f"{FILM}.scrollIntoView()")
        one.run(READY)
        assert one.run(f"{FILM}.error?.message ?? ''") == ""
        yield one


def pixels(browser: Browser, seconds: float) -> np.ndarray[Any, np.dtype[np.int64]]:
    """(height, width, 3) the film at a time, drawn on a canvas."""
    browser.run(SEEK.format(film=FILM, seconds=seconds))
    height, width, data = browser.run(
        f"(() => {{ const film = {FILM}, canvas = document.createElement('canvas');"
        "canvas.width = film.videoWidth; canvas.height = film.videoHeight;"
        "const pen = canvas.getContext('2d'); pen.drawImage(film, 0, 0);"
        "const d = pen.getImageData(0, 0, canvas.width, canvas.height).data;"
        "let s = ''; for (let i = 0; i < d.length; i += 8192) s += String.fromCharCode(...d.subarray(i, i + 8192));"
        "return [canvas.height, canvas.width, btoa(s)] })()"
    )
    image = np.frombuffer(base64.b64decode(data), np.uint8).reshape(height, width, 4)
    return image[..., :3].astype(np.int64)


def test_the_film_is_ready_and_as_long_as_its_frames(browser: Browser) -> None:
    state, duration = browser.run(f"[{FILM}.readyState, {FILM}.duration]")
    assert state == 4
    assert duration == pytest.approx(FRAMES / FRAMES_PER_SECOND, abs=0.01)


def test_a_reader_can_start_and_stop_it_and_it_begins_anew(browser: Browser) -> None:
    assert browser.run(f"[{FILM}.controls, {FILM}.loop, {FILM}.muted, {FILM}.autoplay]") == [True, True, True, False]


def test_the_middle_shows_another_pose_and_the_end_that_of_the_beginning(browser: Browser) -> None:
    half = 0.5 / FRAMES_PER_SECOND
    start, middle, end = (pixels(browser, (index / FRAMES_PER_SECOND) + half) for index in (0, FRAMES // 2, FRAMES - 1))
    assert start.shape[:2] == (browser.run(f"{FILM}.videoHeight"), browser.run(f"{FILM}.videoWidth"))
    assert (start < 200).any(axis=-1).mean() > 0.03
    assert np.mean(np.abs(start - middle).max(axis=-1) > 40) > 0.03
    assert np.mean(np.abs(start - end).max(axis=-1) > 40) < 0.001


def test_it_plays(browser: Browser) -> None:
    browser.run(SEEK.format(film=FILM, seconds=0.0))
    seconds = browser.run(
        f"(async () => {{ const film = {FILM}; await film.play();"
        "await new Promise(done => { film.ontimeupdate = () => film.currentTime > 0.1 && done() });"
        "film.pause(); return film.currentTime })()"
    )
    assert seconds > 0.1


def test_nothing_is_asked_for_and_nothing_is_complained_of(browser: Browser) -> None:
    assert browser.complaints() == []


def test_a_film_that_is_missing_is_a_red_box(browser: Browser, tmp_path: Path) -> None:
    with Browser(tmp_path / "profile", *SOFTWARE_WEBGL) as other:
        other.open(written(tmp_path, Drawn(MOTION, b"", "there is no pose")))
        assert other.run(f"{FILM}") is None
        color, words = other.run(
            "(() => { const box = document.querySelector('.motion .missing');"
            "return [getComputedStyle(box).color, box.innerText] })()"
        )
    assert words == "This film is missing: there is no pose."
    assert color == "rgb(176, 0, 32)"
