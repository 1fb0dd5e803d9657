"""The report in a real browser: the model moves, nothing is asked of the network, and without WebGL it is still a page.

``.venv/bin/python -P -m pytest tests/players/test_browser.py``
"""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.geometry.mesh import transformed
from pipeline.kinematics.table import Status
from pipeline.report.build import Page, report_html
from pipeline.report.evidence import Evidence
from pipeline.report.settings import PictureSettings
from pipeline.report.verdict import judge
from tests.players.browser import CHROMIUM, NEXT_FRAME, NO_WEBGL, SOFTWARE_WEBGL, Browser
from tests.report.sample import frame_of, only_one_attitude, revolved, sample_evidence, with_status

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: the report is tried in no browser")

#: A plateau with vertices all over, so that its colours can tell where it is touched.
PLATEAU = revolved([(-100.0, 12.0), (-35.0, 30.0), *((-20.0 - 1e-3 * r, r) for r in range(33, 0, -2))])


def evidence() -> Evidence:
    """The sample, without a pose at flexion 90 deg, varus 4 deg."""
    made = with_status(sample_evidence("left", "CASE-7"), (9, 2), Status.SLID_OFF)
    return replace(made, meshes={**made.meshes, "tibia": transformed(PLATEAU, frame_of("left"))})


def written(folder: Path, shown: Evidence) -> Path:
    """The page of the evidence, alone in a folder."""
    page = folder / "moved alone.html"
    page.write_bytes(report_html(Page(shown, judge((), (), {}), [], (), PictureSettings())))
    return page


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """One browser that draws WebGL, with the page of the sample."""
    with Browser(tmp_path_factory.mktemp("profile"), *SOFTWARE_WEBGL) as one:
        one.open(written(tmp_path_factory.mktemp("page"), evidence()))
        yield one


@pytest.fixture(autouse=True)
def _at_rest(request: pytest.FixtureRequest) -> None:
    """The page as it was when it was opened."""
    if "browser" in request.fixturenames:
        one: Browser = request.getfixturevalue("browser")
        for name, on in (("axes", True), ("clear", False), ("contact", False)):
            one.run(f"document.querySelector('input[name={name}]').checked = {str(on).lower()}")
        put(one, flexion=0, varus=0)
        one.run("document.querySelector('button[data-azimuth=\"90\"]').click()")
        one.run("document.querySelector('.viewer canvas').scrollIntoView()")


def put(browser: Browser, **values: float) -> None:
    """Move sliders as a hand does, and wait until it is drawn."""
    for name, value in values.items():
        slider = f"document.querySelector('input[name={name}]')"
        browser.run(f"{slider}.value = {value}; {slider}.dispatchEvent(new Event('input'))")
    browser.run(NEXT_FRAME)


def pixels(browser: Browser) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """(height, width, 4) what the canvas shows."""
    answer = browser.run(
        "(() => { const c = document.querySelector('.viewer canvas');"
        "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        "let s = ''; for (let i = 0; i < d.length; i += 8192) s += String.fromCharCode(...d.subarray(i, i + 8192));"
        "return [c.height, c.width, btoa(s)] })()"
    )
    return np.frombuffer(base64.b64decode(answer[2]), np.uint8).reshape(answer[0], answer[1], 4)


def share(image: np.ndarray[Any, np.dtype[np.uint8]], color: tuple[int, int, int], within: int = 6) -> float:
    """Part of the pixels that have about the hue of a colour, bright or dark."""
    parts = image[..., :3].astype(float)
    size = np.linalg.norm(parts, axis=-1)
    cosine = parts @ (np.array(color) / np.linalg.norm(color)) / np.maximum(size, 1.0)
    shown = (size > 60.0) & (parts.max(axis=-1) < 250.0)
    return float(np.mean(shown & (cosine > np.cos(np.radians(within)))))


def text(browser: Browser, selector: str) -> str:
    """Text of an element."""
    return str(browser.run(f"document.querySelector('.viewer {selector}').textContent"))


def test_a_slider_moves_the_lower_bone_and_not_the_upper(browser: Browser) -> None:
    straight = pixels(browser)
    put(browser, flexion=60)
    bent = pixels(browser)
    changed = (straight != bent).any(axis=-1)
    height = changed.shape[0]
    assert changed[height // 2 :].mean() > 0.03
    assert not changed[80 : height // 3, changed.shape[1] // 2 - 20 : changed.shape[1] // 2 + 20].any()
    put(browser, flexion=0)
    np.testing.assert_array_equal(pixels(browser), straight)
    assert text(browser, "output[name=flexion]") == "0.0°"


def test_the_picture_is_not_blank_without_its_words(browser: Browser) -> None:
    image = pixels(browser)
    assert (image[..., :3] < 250).any(axis=-1).mean() > 0.05
    assert (image[..., 3] == 255).all()


def test_keys_move_the_sliders(browser: Browser) -> None:
    browser.run("document.querySelector('input[name=flexion]').focus()")
    for kind in ("keyDown", "keyUp"):
        browser.call("Input.dispatchKeyEvent", type=kind, key="ArrowRight", code="ArrowRight", windowsVirtualKeyCode=39)
    assert text(browser, "output[name=flexion]") == "1.0°"


def test_plus_and_minus_zoom_and_the_page_says_so(browser: Browser) -> None:
    canvas = "document.querySelector('.viewer canvas')"
    browser.run(f"{canvas}.focus()")
    drawn = [pixels(browser)]
    for key in "+-":
        browser.call("Input.dispatchKeyEvent", type="keyDown", key=key, text=key)
        browser.call("Input.dispatchKeyEvent", type="keyUp", key=key)
        browser.run(NEXT_FRAME)
        drawn.append(pixels(browser))
    assert (drawn[1] != drawn[0]).any(axis=-1).mean() > 0.01
    np.testing.assert_array_equal(drawn[2], drawn[0])
    assert browser.run(f"{canvas}.getAttribute('aria-label')").endswith("arrow keys turn it, + and - zoom")


def test_every_control_is_reached_by_the_tab_key_and_has_a_name(browser: Browser) -> None:
    controls = (
        "[...document.querySelectorAll('.viewer :is(canvas, input, button), #sign-off :is(input, textarea, button)')]"
    )
    shown = f"{controls}.filter(one => one.checkVisibility())"
    browser.run(f"{shown}.forEach((one, k) => {{ one.id = 'control' + k }}); {shown}[0].focus()")
    reached = [browser.run("document.activeElement.id")]
    for _ in range(40):
        for kind in ("keyDown", "keyUp"):
            browser.call("Input.dispatchKeyEvent", type=kind, key="Tab", code="Tab", windowsVirtualKeyCode=9)
        reached.append(browser.run("document.activeElement.id"))
    # of the three decisions, which are one control, the tab key reaches one; a date has several fields of its own
    count = browser.run(f"{shown}.length")
    assert {f"control{k}" for k in range(count)} - set(reached) <= {
        browser.run(f"{shown}.filter(one => one.type === 'radio')[{k}].id") for k in range(3)
    }
    tree = browser.call("Accessibility.getFullAXTree")["nodes"]
    named = {"button", "slider", "checkbox", "radio", "textbox", "img", "Date"}
    nodes = [one for one in tree if not one["ignored"] and one["role"]["value"] in named]
    assert len(nodes) >= count
    assert [one for one in nodes if not one["name"]["value"].strip()] == []


def test_an_attitude_without_a_pose_is_said_and_grey(browser: Browser) -> None:
    put(browser, flexion=85, varus=2)
    words = text(browser, "[role=status]")
    assert words == "No stable pose here: slid off. Grey: flexion 85.0°, varus 0.0°, the nearest with one."
    grey = share(pixels(browser), (155, 155, 155), 1)
    put(browser, flexion=75)
    assert text(browser, "[role=status]") == ""
    assert grey > share(pixels(browser), (155, 155, 155), 1) + 0.02


def test_views_and_toggles_change_the_picture(browser: Browser) -> None:
    seen = [pixels(browser)]
    for view in ('data-azimuth="0"', 'data-azimuth="270"', 'data-azimuth="180"', 'data-elevation="90"'):
        browser.run(f"document.querySelector('button[{view}]').click()")
        seen.append(pixels(browser))
    for name in ("axes", "clear", "contact"):
        browser.run(f"document.querySelector('input[name={name}]').click()")
        seen.append(pixels(browser))
    for one, other in pairwise(seen):
        assert (one != other).any(axis=-1).mean() > 0.001


def test_contact_colours_mark_what_is_near(browser: Browser) -> None:
    browser.run("document.querySelector('button[data-elevation=\"90\"]').click()")
    before = pixels(browser).astype(int)
    browser.run("document.querySelector('input[name=contact]').click()")
    browser.run(NEXT_FRAME)
    darker = (before - pixels(browser)).mean(axis=-1) > 40
    assert 0.002 < darker.mean() < 0.05
    columns = np.flatnonzero(darker.any(axis=0)) - darker.shape[1] / 2
    assert columns.min() < -30  # below both condyles
    assert columns.max() > 30
    assert browser.run("document.querySelector('.viewer .scale').hidden") is False


def test_play_bends_the_joint_until_it_is_stopped(browser: Browser) -> None:
    play = "document.querySelector('button.play')"
    browser.run(f"{play}.click()")
    browser.run("new Promise(done => setTimeout(() => done(1), 400))")
    assert text(browser, "button.play") == "Stop"
    assert float(text(browser, "output[name=flexion]").removesuffix("°")) > 2.0
    browser.run(f"{play}.click()")
    at = text(browser, "output[name=flexion]")
    browser.run(NEXT_FRAME)
    assert (text(browser, "button.play"), text(browser, "output[name=flexion]")) == ("Play", at)


def test_dragging_turns_what_is_seen_with_the_hand(browser: Browser) -> None:
    browser.run("document.querySelector('button[data-azimuth=\"0\"]').click()")
    before = pixels(browser)
    left, top = browser.run(
        "(() => { const box = document.querySelector('.viewer canvas').getBoundingClientRect();"
        "return [box.x + box.width / 2, box.y + box.height / 2] })()"
    )
    for kind, x in (("mousePressed", left), ("mouseMoved", left + 40), ("mouseReleased", left + 40)):
        browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=top, button="left", buttons=1, clickCount=1)
    browser.run(NEXT_FRAME)
    assert (pixels(browser) != before).any(axis=-1).mean() > 0.01


def test_nothing_else_may_run(browser: Browser) -> None:
    script = "const s = document.createElement('script'); s.textContent = 'window.ran = 1'; document.body.append(s);"
    assert browser.run(f"(() => {{ {script} return window.ran ?? null }})()") is None
    assert browser.run("fetch('data:text/plain,x').then(() => 'loaded', () => 'refused')") == "refused"
    browser.events = [event for event in browser.events if "Content Security Policy" not in str(event)]


def test_nothing_is_asked_for_and_nothing_is_complained_of(browser: Browser) -> None:
    assert browser.complaints() == []


@pytest.mark.parametrize("kind", ["script", "webgl"])
def test_without_script_or_webgl_the_page_says_so_in_one_sentence(tmp_path: Path, kind: str) -> None:
    flags = NO_WEBGL if kind == "webgl" else SOFTWARE_WEBGL
    with Browser(tmp_path / "profile", *flags) as browser:
        browser.open(written(tmp_path, evidence()), script=kind != "script")
        assert browser.run("document.querySelector('.viewer .off').hidden") is False
        assert browser.run("document.querySelector('.viewer .on').hidden") is True
        assert "needs a browser with JavaScript and WebGL 2" in text(browser, ".off")
        assert not browser.said("Runtime.exceptionThrown")


def test_one_attitude_is_shown_without_a_choice(tmp_path: Path) -> None:
    with Browser(tmp_path / "profile", *SOFTWARE_WEBGL) as browser:
        browser.open(written(tmp_path, only_one_attitude(sample_evidence())))
        assert browser.run("document.querySelector('.viewer .on').hidden") is False
        assert browser.run("[...document.querySelectorAll('.viewer [type=range]')].every(one => one.disabled)") is True
        assert (pixels(browser)[..., :3] < 250).any(axis=-1).mean() > 0.05
        assert not browser.said("Runtime.exceptionThrown")


def test_on_a_phone_nothing_but_a_wide_table_is_wider_than_the_screen(tmp_path: Path) -> None:
    with Browser(tmp_path / "profile", *NO_WEBGL) as one:
        one.open(written(tmp_path, evidence()), size=(390, 800))
        assert one.run("innerWidth") == 390
        assert one.run("document.documentElement.scrollWidth") <= 390
        wide = "[...document.querySelectorAll('table')].some(one => one.scrollWidth > one.clientWidth)"
        assert one.run(wide), "no table has to be scrolled: this test shows nothing"
