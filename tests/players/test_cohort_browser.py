"""The overview in a real browser: sorting, searching, filtering, nothing asked of the network, quick at 5,000 cases.

``.venv/bin/python -P -m pytest tests/players/test_cohort_browser.py``
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.adapters.thumbnails import strip_jpeg
from pipeline.report.cohort_page import COLUMNS, STATES, CaseRow, Links, Number, cohort_html
from tests.players.browser import CHROMIUM, Browser

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="Chromium is not installed: the overview is tried in no browser"
)

#: Milliseconds that a letter in the search box may take; a busy machine of two cores takes a few times the usual.
QUICK_MS = 100.0
MANY = 5_000
STRIP = "0" * 32 + ".jpg"
#: Until every row is back, a part of them with each frame.
ALL_BACK = """new Promise(done => {
    const look = () => document.querySelector("tr[hidden]") ? requestAnimationFrame(look) : done(1);
    look();
})"""
#: Of the forty cases one that has numbers, in the middle.
FAR = next(i for i in range(20, 41) if STATES[i % len(STATES)] == "PASS")
DRAWN = "new Promise(done => requestAnimationFrame(() => setTimeout(() => done(performance.now()))))"


def cohort(count: int) -> list[CaseRow]:
    """P1, P2 ...: all states in turn, numbers that fall as the case numbers rise, one without any number."""
    rows = []
    for i in range(1, count + 1):
        state = STATES[i % len(STATES)]
        numbers = tuple(Number(name, f"The {name}", "mm", 200.0 - i % 100, over=False) for name in COLUMNS)
        finished = state in ("PASS", "REVIEW")
        reasons = () if state == "PASS" else (f"Reason {i % 10} of the state, in words as long as they usually are.",)
        part = ("LEFT" if i % 2 else "RIGHT") + " knee"
        report, pictures = (f"P{i}/90_package/report.html", STRIP) if finished else ("", "")
        rows.append(CaseRow(f"P{i}", state, part, reasons, "", numbers if finished else (), report, pictures))
    return rows


def written(folder: Path, rows: list[CaseRow]) -> Path:
    """The page with its thumbnails, in a folder with a blank in its name."""
    page = folder / "my results" / "index.html"
    (page.parent / "index.files").mkdir(parents=True)
    panels = [np.full((96, 96, 3), shade, np.uint8) for shade in (40, 90, 140, 190)]
    (page.parent / "index.files" / STRIP).write_bytes(strip_jpeg(panels))
    page.write_bytes(cohort_html(rows, Links(".", "index.files")))
    return page


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    """A browser with the page of forty cases, of which one has a number far from the others."""
    rows = cohort(40)
    usual = rows[FAR - 1]
    far = replace(usual, numbers=tuple(replace(one, value=750.0) for one in usual.numbers))
    with Browser(tmp_path / "profile") as one:
        one.open(written(tmp_path, [*rows[: FAR - 1], far, *rows[FAR:]]), (1600, 900))
        yield one
        assert one.complaints() == []


def shown(browser: Browser) -> list[str]:
    """Names of the cases on the page, from top to bottom."""
    names = browser.run("[...document.querySelectorAll('tbody tr')].filter(r => !r.hidden).map(r => r.dataset.case)")
    return list(names)


def press_head(browser: Browser, index: int) -> str:
    """Press the head of a column; what it then says of the order."""
    head = f"document.querySelectorAll('thead th')[{index}]"
    browser.run(f"{head}.querySelector('button').click()")
    return str(browser.run(f"{head}.getAttribute('aria-sort')"))


def search(browser: Browser, words: str) -> None:
    """Type into the search box."""
    box = "document.querySelector('[type=search]')"
    browser.run(f"{box}.value = ''; {box}.focus()")
    browser.call("Input.insertText", text=words)


def test_cases_that_need_somebody_stand_first(browser: Browser) -> None:
    states = browser.run("[...document.querySelectorAll('tbody tr')].map(row => row.dataset.state)")
    assert [STATES.index(state) for state in states] == sorted(STATES.index(state) for state in states)
    assert browser.run("document.querySelector('[aria-sort=ascending]').textContent").startswith("Verdict")


def test_a_head_sorts_by_name_as_people_count(browser: Browser) -> None:
    assert press_head(browser, 0) == "ascending"
    assert shown(browser) == [f"P{i}" for i in range(1, 41)]
    assert press_head(browser, 0) == "descending"
    assert shown(browser) == [f"P{i}" for i in range(40, 0, -1)]
    assert browser.run("document.querySelectorAll('[aria-sort=ascending], [aria-sort=descending]').length") == 1


def test_numbers_sort_with_the_worst_first_and_what_has_none_last(browser: Browser) -> None:
    finished = [i for i in range(1, 41) if STATES[i % len(STATES)] in ("PASS", "REVIEW") and i != FAR]
    assert press_head(browser, 4) == "descending"
    assert shown(browser)[: len(finished) + 1] == [f"P{i}" for i in [FAR, *finished]]
    assert press_head(browser, 4) == "ascending"
    assert shown(browser)[: len(finished) + 1] == [f"P{i}" for i in [*finished[::-1], FAR]]
    assert press_head(browser, 1) == "ascending"


def test_a_head_sorts_by_keyboard(browser: Browser) -> None:
    browser.run("document.querySelector('thead button').focus()")
    for kind in ("keyDown", "keyUp"):
        browser.call(
            "Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", windowsVirtualKeyCode=13, text="\r"
        )
    assert shown(browser)[:3] == ["P1", "P2", "P3"]


def test_search_finds_names_sides_and_reasons(browser: Browser) -> None:
    search(browser, "p7")
    assert shown(browser) == ["P7"]
    assert browser.run("document.querySelector('output').textContent") == "1 of 40 shown"
    search(browser, " rejected  LEFT ")
    assert shown(browser) == [f"P{i}" for i in range(1, 41, 2) if STATES[i % len(STATES)] == "REJECTED"]
    search(browser, "as they usually are")
    assert len(shown(browser)) == sum(STATES[i % len(STATES)] != "PASS" for i in range(1, 41))
    search(browser, "<nothing>")
    assert shown(browser) == []
    browser.run("document.querySelector('[type=search]').select()")
    browser.call("Input.insertText", text="")
    for kind in ("keyDown", "keyUp"):
        browser.call("Input.dispatchKeyEvent", type=kind, key="Backspace", code="Backspace", windowsVirtualKeyCode=8)
    assert len(shown(browser)) == 40
    assert browser.run("document.querySelector('output').textContent") == ""


def test_chips_filter_and_count(browser: Browser) -> None:
    def press(chip: str) -> None:
        browser.run(f"document.querySelector('.chip[{chip}]').click()")

    review = {f"P{i}" for i in range(1, 41) if STATES[i % len(STATES)] == "REVIEW"}
    failed = {f"P{i}" for i in range(1, 41) if STATES[i % len(STATES)] == "ERROR"}
    assert browser.run("document.querySelector('.chip[data-state=REVIEW] b').textContent") == str(len(review))
    press("data-state=REVIEW")
    assert set(shown(browser)) == review
    press("data-state=ERROR")
    assert set(shown(browser)) == review | failed
    press("data-state=REVIEW")
    press("data-state=ERROR")
    press("data-unusual")
    assert shown(browser) == [f"P{FAR}"]
    assert "Unusually high" in browser.run("document.querySelector('tr:not([hidden]) .unusual').textContent")


def test_thumbnails_are_shown(browser: Browser) -> None:
    browser.run("document.querySelector('tbody img').scrollIntoView({block: 'center'})")
    picture = "document.querySelector('tbody img')"
    size = browser.run(
        f"{picture}.decode().then(() => [{picture}.naturalWidth, {picture}.naturalHeight, {picture}.complete])"
    )
    assert size == [396, 96, True]
    assert browser.run("document.querySelector('tbody img').alt").startswith("Case P")


def test_the_name_opens_the_report(browser: Browser) -> None:
    name, link = browser.run(
        "(() => { const a = document.querySelector('tbody a'); return [a.textContent, a.href] })()"
    )
    assert link.endswith(f"/my%20results/{name}/90_package/report.html")


def test_nothing_else_may_run_or_be_fetched(browser: Browser) -> None:
    script = "const s = document.createElement('script'); s.textContent = 'window.ran = 1'; document.body.append(s);"
    assert browser.run(f"(() => {{ {script} return window.ran ?? null }})()") is None
    assert browser.run("fetch('index.html').then(() => 'loaded', () => 'refused')") == "refused"
    refused = [event for event in browser.events if "Content Security Policy" in str(event)]
    assert len(refused) >= 2
    browser.events = [event for event in browser.events if event not in refused]


def test_without_script_the_whole_list_is_there(tmp_path: Path) -> None:
    with Browser(tmp_path / "profile") as browser:
        browser.open(written(tmp_path, cohort(40)), script=False)
        assert len(shown(browser)) == 40
        assert browser.run("[...document.querySelectorAll('button, input')].every(one => one.disabled)")


def milliseconds(browser: Browser, action: str) -> float:
    """Time from an action to the frame that shows what it did."""
    drawn = "requestAnimationFrame(() => setTimeout(() => done(performance.now() - since)))"
    return float(browser.run(f"new Promise(done => {{ const since = performance.now(); {action}; {drawn} }})"))


def test_five_thousand_cases_are_quick(tmp_path: Path) -> None:
    with Browser(tmp_path / "profile") as browser:
        browser.open(written(tmp_path, cohort(MANY)), (1600, 900))
        browser.run(DRAWN)
        box = "document.querySelector('[type=search]')"
        typed = ("p", "p4", "p49", "p499", "p49", "p4", "", "reason 3", "left", "")
        letters = [f"{box}.value = '{words}'; {box}.dispatchEvent(new Event('input'))" for words in typed]
        searched = [milliseconds(browser, letter) for letter in letters]
        assert float(np.median(searched)) < QUICK_MS, searched
        browser.run(ALL_BACK)
        assert len(shown(browser)) == MANY
        ordered = [
            milliseconds(browser, f"document.querySelectorAll('thead button')[{i}].click()") for i in (0, 2, 2, 1)
        ]
        assert float(np.median(ordered)) < 10 * QUICK_MS, ordered
        assert not browser.said("Runtime.exceptionThrown")
