"""The page of all cases: inert, complete, in order, and unusual numbers told by an independent reckoning."""

from __future__ import annotations

import base64
import hashlib
import re
import statistics
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from pipeline.report.cohort_page import COLUMNS, STATES, CaseRow, Links, Number, cohort_html, unusual_numbers

HOSTILE = "\"'><script>alert(1)</script><img src=x onerror=alert(2)>{{ 7 * 7 }}{% raw %}&lt;$x$"
LINKS = Links(".", "index.files")
FIRST = next(iter(COLUMNS))


def number(value: float, name: str = FIRST, *, over: bool = False) -> Number:
    return Number(name, "Volume of surface", "%", value, over)


def finished(case_id: str, *values: float, joint: str = "knee") -> CaseRow:
    """A case that passed, its numbers those of the first columns."""
    numbers = tuple(number(value, name) for name, value in zip(COLUMNS, values, strict=False))
    return CaseRow(case_id, "PASS", f"LEFT {joint}", (), "", numbers, f"{case_id}/90_package/report.html", "a.jpg")


def page(*rows: CaseRow) -> str:
    return cohort_html(rows, LINKS).decode()


def tags(text: str) -> list[tuple[str, list[str]]]:
    """Every tag that a parser sees, with the names of its attributes."""
    found: list[tuple[str, list[str]]] = []

    class Parser(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            found.append((tag, [name for name, _ in attrs]))

    Parser().feed(text)
    return found


def cells(text: str) -> dict[str, list[tuple[str, str]]]:
    """Case -> the class and the text of each number on the page."""
    lines = re.findall(r'<tr[^>]* data-case="([^"]*)"[^>]*>(.*?)</tr>', text, re.DOTALL)
    return {name: re.findall(r'<td class="(n[^"]*)">(.*?)</td>', line) for name, line in lines}


def test_the_same_lines_in_any_order_are_the_same_bytes() -> None:
    rows = [finished(f"P{i}", i) for i in range(12)]
    assert cohort_html(rows, LINKS) == cohort_html(rows[::-1], LINKS)


def test_the_page_runs_its_own_script_and_nothing_else() -> None:
    text = page(finished("P1", 1.0))
    scripts = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    assert len(scripts) == 1
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy
    allowed = base64.b64encode(hashlib.sha256(scripts[0].encode()).digest()).decode()
    told = policy[1].replace("&#39;", "'")
    assert "default-src 'none'" in told
    assert "img-src 'self' data:" in told
    assert re.findall(r"script-src [^;]*", told) == [f"script-src 'sha256-{allowed}'"]
    assert not re.search(r"https?://|@import|url\(| on[a-z]+=", text)


def test_every_text_is_escaped() -> None:
    numbers = (Number(FIRST, HOSTILE, HOSTILE, 1.0, over=True),)
    row = CaseRow(HOSTILE, "REVIEW", HOSTILE, (HOSTILE, HOSTILE), HOSTILE, numbers, HOSTILE, HOSTILE)
    usual = [replace(finished(f"P{i}", 100.0 + i), body_part=HOSTILE) for i in range(9)]
    text = page(row, *usual)
    assert "Unusually low" in text
    assert text.count("<script>") == text.count("<script") == 1
    assert "<img src=x" not in text
    assert not {name for _, names in tags(text) for name in names if name.startswith("on")}
    assert [tag for tag, _ in tags(text)].count("img") == 1 + len(usual)
    assert text.count("&lt;script&gt;alert(1)&lt;/script&gt;") >= 8
    assert "{{ 7 * 7 }}{% raw %}&amp;lt;$x$" in text


def test_what_needs_somebody_stands_first_and_names_count_as_people_do() -> None:
    rows = [CaseRow(f"{state[:2]}{i}", state) for i in (10, 9, 1) for state in STATES[::-1]]
    names = re.findall(r'data-case="([^"]*)"', page(*rows))
    assert names == [f"{state[:2]}{i}" for state in STATES for i in (1, 9, 10)]


def test_counts_are_those_of_the_cases() -> None:
    text = page(*(CaseRow(f"R{i}", "REJECTED") for i in range(3)), CaseRow("E", "ERROR"), finished("P", 1.0))
    chips = dict(re.findall(r'data-state="([A-Z ]+)" aria-pressed="false">[A-Z ]+ <b>(\d+)</b>', text))
    assert chips == {"ERROR": "1", "REJECTED": "3", "PASS": "1"}
    assert "<h1>Overview of 5 cases</h1>" in text
    assert "data-unusual aria-pressed" not in text


def test_a_folder_without_cases_says_so() -> None:
    text = page()
    assert "There are no results in this folder yet." in text
    assert "<table" not in text


def test_reasons_action_side_and_links_stand_in_the_line() -> None:
    row = CaseRow(
        "P 1", "REVIEW", "RIGHT knee", ("One.", "Two."), "Do this.", (), "P 1/90_package/report.html", "ab.jpg"
    )
    text = cohort_html([row], Links("../my results", "over view.files")).decode()
    assert '<a href="../my%20results/P%201/90_package/report.html">P 1</a>' in text
    assert 'src="over%20view.files/ab.jpg"' in text
    assert '<p>One.</p><p>Two.</p><p class="action">Do this.</p>' in text
    assert "<span>RIGHT knee</span>" in text


def test_a_case_without_report_or_pictures_links_nothing() -> None:
    text = page(CaseRow("P1", "REJECTED", reasons=("E-SIDE-01  The side is not given.",)))
    assert "<a " not in text
    assert "<img" not in text


def test_columns_are_those_that_some_case_has() -> None:
    text = page(finished("P1", 1.0, 2.0), finished("P2", 3.0))
    assert re.findall(r'<th data-by="number".*?disabled>(.*?) <i>', text) == [*COLUMNS.values()][:2]
    assert cells(text) == {"P1": [("n", "1"), ("n", "2")], "P2": [("n", "3"), ("n", "")]}


def test_a_number_beyond_its_limit_is_marked() -> None:
    row = replace(finished("P1"), numbers=(number(2.5, over=True),))
    assert cells(page(row))["P1"] == [("n over", "2.5")]


VALUES = [1.0, 1.1, 0.9, 1.2, 0.8, 1.05, 0.95, 3.0, -2.0, 1.4]


def test_unusual_is_told_by_the_median_deviation() -> None:
    found = unusual_numbers([finished(f"P{i}", value) for i, value in enumerate(VALUES)])
    middle = statistics.median(VALUES)
    scores = [0.6745 * (value - middle) / statistics.median(abs(v - middle) for v in VALUES) for value in VALUES]
    assert {case_id: one.way for (case_id, _), one in found.items()} == {
        f"P{i}": "high" if score > 0 else "low" for i, score in enumerate(scores) if abs(score) > 3.5
    }
    assert set(found) == {("P7", FIRST), ("P8", FIRST)}
    assert {(one.median, one.cases) for one in found.values()} == {(middle, len(VALUES))}


@pytest.mark.parametrize(("factor", "offset"), [(1000.0, 0.0), (1.0, 50.0), (0.001, -3.0)])
def test_unusual_does_not_depend_on_the_unit(factor: float, offset: float) -> None:
    found = unusual_numbers([finished(f"P{i}", factor * value + offset) for i, value in enumerate(VALUES)])
    assert {case_id for case_id, _ in found} == {"P7", "P8"}


@pytest.mark.parametrize("values", [VALUES[3:], [1.0] * 6 + [5.0, 7.0, 9.0], []])
def test_few_cases_or_equal_numbers_have_nothing_unusual(values: list[float]) -> None:
    assert unusual_numbers([finished(f"P{i}", value) for i, value in enumerate(values)]) == {}


def test_joints_are_not_compared_with_one_another() -> None:
    knees = [finished(f"K{i}", value) for i, value in enumerate(VALUES[:7])]
    elbows = [finished(f"E{i}", 50.0 + value, joint="elbow") for i, value in enumerate(VALUES[:7])]
    assert unusual_numbers([*knees, *elbows]) == {}
    found = unusual_numbers([*knees, *elbows, finished("K7", 50.0)])
    assert {case_id for case_id, _ in found} == {"K7"}


def test_what_is_unusual_is_said_in_words() -> None:
    text = page(*(finished(f"P{i}", value) for i, value in enumerate(VALUES)))
    assert "Unusually high: volume of surface 3 % (half of 10 cases are below 1.02)." in text
    assert cells(text)["P7"] == [("n high", "3")]
    assert cells(text)["P8"] == [("n low", "-2")]
    assert "unusual numbers <b>2</b>" in text
