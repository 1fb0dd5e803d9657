"""The sign-off of the report in a real browser: the file that it saves is one that ``ct2lut review`` takes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import date, datetime
from pathlib import Path
from typing import Any

import pytest

from pipeline.commands.review import decode_review
from pipeline.report.build import Page, report_html
from pipeline.report.settings import PictureSettings
from pipeline.report.sign_off import review_facts
from pipeline.report.verdict import judge
from tests.players.browser import CHROMIUM, NO_WEBGL, Browser
from tests.report.sample import sample_evidence

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: the sign-off is tried in none")

PAGE = Page(sample_evidence("left", "CASE-7"), judge((), (), {}), [], (), PictureSettings())
FILE = "CASE-7_review.json"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the sample, alone in a folder."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_bytes(report_html(PAGE))
    return path


@pytest.fixture
def browser(page: Path, tmp_path: Path) -> Iterator[Browser]:
    """A browser without WebGL, which the sign-off does not need; it saves into the test's own folder."""
    with Browser(tmp_path / "profile", *NO_WEBGL) as one:
        folder = str(tmp_path)
        one.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=folder, eventsEnabled=True)
        one.open(page)
        yield one


def fill(browser: Browser, **fields: str) -> None:
    """What a person types and chooses."""
    for name, value in fields.items():
        if name == "decision":
            browser.run(f"document.querySelector('#sign-off input[value={value}]').click()")
        else:
            browser.run(f"document.querySelector('#sign-off [name={name}]').value = {json.dumps(value)}")


def press_save(browser: Browser) -> str:
    """What is said after it."""
    browser.run("document.querySelector('#sign-off button').click()")
    return str(browser.run("document.querySelector('#sign-off [role=status]').textContent"))


def downloaded(browser: Browser, folder: Path) -> Any:
    """The saved file, once it is whole."""
    while not any(one["state"] == "completed" for one in browser.said("Browser.downloadProgress")):
        browser.run("new Promise(done => setTimeout(() => done(1), 20))")
    return json.loads((folder / FILE).read_text())


def test_a_decision_is_saved_as_a_file_that_the_command_takes(browser: Browser, tmp_path: Path) -> None:
    remark = 'Δ is tilted; "see" </script> \\ \u2028 picture 2'
    fill(browser, decision="accept_with_remark", initials="Äö", remark=remark, date="2031-02-03")
    assert press_save(browser) == f"The browser saves it as {FILE}, in its folder for downloads."
    saved = downloaded(browser, tmp_path)
    typed = {"decision": "accept_with_remark", "initials": "Äö", "remark": remark, "date": "2031-02-03"}
    assert saved == {**review_facts(PAGE.evidence, PAGE.verdict), **typed}
    review = decode_review((tmp_path / FILE).read_bytes())
    assert (review.case_id, review.side, review.remark) == ("CASE-7", "left", remark)
    assert browser.complaints("file:", "data:", "blob:") == []


def test_the_browser_fills_in_the_date(browser: Browser, tmp_path: Path) -> None:
    fill(browser, decision="accept", initials="AB")
    before = datetime.now().astimezone().date()
    press_save(browser)
    filled_in = date.fromisoformat(downloaded(browser, tmp_path)["date"])
    assert before <= filled_in <= datetime.now().astimezone().date()


def test_what_is_missing_is_said_and_nothing_is_saved(browser: Browser, tmp_path: Path) -> None:
    fill(browser, date="")
    assert press_save(browser) == (
        "Choose accept, accept with remark, or reject. Give your initials, at most ten letters. Give the date."
    )
    fill(browser, decision="reject", initials="AB", date="2031-02-03")
    assert press_save(browser) == "Write a remark: what is wrong, or what to mind."
    fill(browser, initials="<b>")
    assert "Give your initials" in press_save(browser)
    assert not browser.said("Browser.downloadWillBegin")
    assert not (tmp_path / FILE).exists()


def displayed(browser: Browser) -> list[bool]:
    """Whether the form is seen, and whether the lines to fill in by hand are."""
    return [
        browser.run(f"getComputedStyle(document.querySelector('#sign-off {one}')).display !== 'none'")
        for one in (".on-screen", ".by-hand")
    ]


def test_on_paper_and_without_script_there_are_lines_to_fill_in(browser: Browser, page: Path, tmp_path: Path) -> None:
    assert displayed(browser) == [True, False]
    browser.call("Emulation.setEmulatedMedia", media="print")
    assert displayed(browser) == [False, True]
    with Browser(tmp_path / "other", *NO_WEBGL) as one:
        one.open(page, script=False)
        assert displayed(one) == [False, True]


def test_the_form_is_reached_and_used_by_keys_alone(browser: Browser, tmp_path: Path) -> None:
    browser.run("document.querySelector('#sign-off input[value=accept]').focus()")
    keys = [(" ", "Space", 32), ("\t", "Tab", 9), ("\t", "Tab", 9), ("A", "KeyA", 65), ("B", "KeyB", 66)]
    for key, code, number in keys:
        name = "Tab" if key == "\t" else key
        typed = {} if key == "\t" else {"text": key}
        browser.call(
            "Input.dispatchKeyEvent", type="keyDown", key=name, code=code, windowsVirtualKeyCode=number, **typed
        )
        browser.call("Input.dispatchKeyEvent", type="keyUp", key=name, code=code, windowsVirtualKeyCode=number)
    assert browser.run("document.activeElement.name") == "initials"
    browser.run("document.querySelector('#sign-off button').focus()")
    for kind in ("keyDown", "keyUp"):
        text = {"text": "\r"} if kind == "keyDown" else {}
        browser.call("Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", windowsVirtualKeyCode=13, **text)
    saved = downloaded(browser, tmp_path)
    assert (saved["decision"], saved["initials"]) == ("accept", "AB")
