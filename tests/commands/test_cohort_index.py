"""The overview of a results folder: what is read from disk, what is read again; one broken case is one line."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pipeline.commands import cohort_case, cohort_index
from pipeline.commands.cohort_case import CaseOnDisk, read_row
from pipeline.commands.cohort_index import Overview, Places, overview_lines, write_overview
from pipeline.engine.lock import case_lock
from pipeline.engine.outcome import RunRecord, save_record
from pipeline.engine.stage import Finding, Severity
from pipeline.engine.store import fingerprint, read_file
from pipeline.errors import ConfigError
from pipeline.flow import FLOW
from pipeline.records import Verdict
from pipeline.report.cohort_page import COLUMNS, CaseRow
from pipeline.report.sign_off import DECIDED
from tests.report.cohort_sample import metrics, sheets, write_finished, write_run, write_stage, write_stopped
from tests.toy_flow import TOY_FLOW

PASSED = Verdict("PASS", (), metrics(1.0))
REASONS = ("The first reason.", "The second reason.", "The third reason.")
REVIEW = Verdict("REVIEW", REASONS, metrics(2.0))
REFUSED = ("E-SIDE-01", "The side is not given.", "Add side: right or side: left to case.yaml.")


@pytest.fixture
def places(tmp_path: Path) -> Places:
    """Results of P1, which passed, and P2, which needs a look."""
    results = tmp_path / "results"
    write_finished(results, "P1", PASSED, "left")
    write_finished(results, "P2", REVIEW)
    return Places(results, results / "index.html")


def update(places: Places) -> Overview:
    return write_overview(places, FLOW)


def row(places: Places, case_id: str) -> CaseRow:
    return next(one for one in update(places).rows if one.case_id == case_id)


def picture(places: Places, shown: CaseRow) -> np.ndarray[Any, np.dtype[np.int64]]:
    """(height, width, 3) thumbnails of a case, RGB."""
    found = cv2.imread(str(places.pictures / shown.pictures))
    assert found is not None
    return found[..., ::-1].astype(np.int64)


def written(places: Places) -> dict[str, tuple[int, bytes]]:
    """Name -> (time of change, content) of the page and all that is beside it."""
    files = [places.page, places.index, *places.pictures.iterdir()]
    return {path.name: (path.stat().st_mtime_ns, path.read_bytes()) for path in files}


def test_a_finished_case_has_verdict_side_numbers_report_and_pictures(places: Places) -> None:
    first = row(places, "P1")
    assert (first.state, first.body_part, first.reasons, first.action) == ("PASS", "LEFT knee", (), "")
    assert [(one.name, one.value) for one in first.numbers] == [(name, 1.0) for name in COLUMNS]
    assert first.report == "P1/90_package/report.html"
    strip = picture(places, first)
    # the red of a made sheet tells which it is and which column, the green which row
    reds, greens = strip[48, 48::100, 0], strip[48, 48::100, 1]
    np.testing.assert_allclose(reds, [0, 40, 80 + 3 * 20, 120], atol=6)
    np.testing.assert_allclose(greens, [0, 0, 20, 0], atol=6)


def test_a_case_for_review_says_why(places: Places) -> None:
    second = row(places, "P2")
    assert (second.state, second.body_part, second.reasons) == ("REVIEW", "RIGHT knee", REASONS)


def test_reasons_that_have_no_room_are_counted(places: Places) -> None:
    write_finished(places.results, "P3", REVIEW)
    findings = [
        Finding("W-QA-03", Severity.REVIEW, words) for words in (*REASONS, "A fourth.", "A fourth.", "A fifth.")
    ]
    write_run(places.results, "P3", "REVIEW", [*findings, Finding("N-QA-01", Severity.NOTE, "A note.")])
    assert row(places, "P3").reasons == (*REASONS, "And 2 more in the report.")


@pytest.mark.parametrize("word", ["REJECTED", "ERROR"])
def test_a_stopped_case_says_why_and_what_to_do(places: Places, word: str) -> None:
    write_stopped(places.results, "P3", word, REFUSED)  # type: ignore[arg-type]  # a list of literals
    third = row(places, "P3")
    assert (third.state, third.reasons, third.action) == (word, ("E-SIDE-01  The side is not given.",), REFUSED[2])
    assert (third.body_part, third.report, third.pictures, third.numbers) == ("", "", "", ())


@pytest.mark.parametrize(("ran", "side"), [(0, ""), (1, ""), (2, "LEFT knee"), (5, "LEFT knee")])
def test_a_side_of_an_earlier_run_is_never_shown(places: Places, ran: int, side: str) -> None:
    write_stopped(places.results, "P1", "REJECTED", REFUSED, ran)
    first = row(places, "P1")
    assert (first.body_part, first.report, first.pictures, first.numbers) == (side, "", "", ())


def test_a_case_that_runs_and_one_that_was_stopped(places: Places) -> None:
    for name in ("P3", "P4", "P5"):
        (places.results / name).mkdir()
    save_record(places.results / "P3", RunRecord("running", None))
    save_record(places.results / "P4", RunRecord("interrupted", None))
    shutil.copytree(places.results / "P1" / "10_intake", places.results / "P4" / "10_intake")
    with case_lock(places.results / "P3"):
        states = {one.case_id: (one.state, one.reasons) for one in update(places).rows}
    assert states["P3"] == ("RUNNING", ("0 of 9 stages have a result.",))
    assert states["P4"] == ("NOT FINISHED", ("1 of 9 stages have a result.",))
    assert states["P5"] == ("NOT FINISHED", ("0 of 9 stages have a result.",))
    assert row(places, "P3").state == "NOT FINISHED"


def test_a_finished_case_that_is_locked_for_a_moment_stays_finished(places: Places) -> None:
    with case_lock(places.results / "P1"):
        assert row(places, "P1").state == "PASS"


def review(case_id: str, facts: bytes) -> dict[str, Any]:
    """A reader's decision on a made case, as the page of its report saves it."""
    return {
        "schema": {"name": "ct2lut-review", "version": "1.0"},
        "notice": "",
        "joint": "knee",
        "software": "ct2lut",
        "side": "left",
        "verdict": "PASS",
        "remark": "",
        "case_id": case_id,
        "decision": "accept",
        "initials": "AB",
        "date": "2031-02-03",
        "result": {one.name: fingerprint(facts).sha256 for one in DECIDED},
    }


def test_a_decision_of_a_reader_stands_with_its_case(places: Places) -> None:
    folder = places.results / "P1"
    facts = (folder / "20_segment" / "case.json").read_bytes()
    assert row(places, "P1").review == ""
    (folder / "review.json").write_text(json.dumps(review("P1", facts)))
    assert row(places, "P1").review == "accepted by AB on 2031-02-03"
    assert '<span class="review">accepted by AB on 2031-02-03</span>' in places.page.read_text()
    (folder / "review.json").write_text(json.dumps(review("P1", b"other")))
    assert "of an OLDER result" in row(places, "P1").review
    (folder / "review.json").write_text("{")
    assert (row(places, "P1").review, row(places, "P1").state) == ("its file is damaged", "PASS")


@pytest.mark.parametrize(
    ("ran", "page", "report"), [(3, "report.html", "P1/report.html"), (3, "old.html", ""), (None, "report.html", "")]
)
def test_a_stopped_case_links_only_the_page_that_tells_why(
    places: Places, ran: int | None, page: str, report: str
) -> None:
    (places.results / "P1" / page).write_text("why")
    write_stopped(places.results, "P1", "ERROR", REFUSED, ran)
    assert row(places, "P1").report == report


def _spoil_json(folder: Path) -> None:
    (folder / "run.json").write_text('{"state": "fini')


def _spoil_kind(folder: Path) -> None:
    (folder / "run.json").unlink()
    (folder / "run.json").mkdir()


def _spoil_link(folder: Path) -> None:
    (folder / "run.json").unlink()
    (folder / "run.json").symlink_to("/etc/passwd")


def _spoil_name(folder: Path) -> None:
    write_run(folder.parent, "P1", "PASS")
    shutil.copy(folder.parent / "P1" / "run.json", folder / "run.json")


def _spoil_verdict(folder: Path) -> None:
    path = folder / "80_qa" / "verdict.json"
    path.write_text(path.read_text().replace("first", "worst"))


def _spoil_record(folder: Path) -> None:
    path = folder / "80_qa" / "stage.json"
    path.write_text(path.read_text().replace('"seconds": 1.0', '"seconds": 2.0'))


def _spoil_side(folder: Path) -> None:
    path = folder / "20_segment" / "case.json"
    path.write_text(path.read_text().replace("right", "left"))


def _spoil_picture(folder: Path) -> None:
    shutil.rmtree(folder)
    write_finished(folder.parent, folder.name, REVIEW, images=sheets(3))  # of its own: shared ones may be there already
    (folder / "80_qa" / "report" / "images" / "bones.png").write_bytes(sheets()["slices"])


def _spoil_version(folder: Path) -> None:
    write_stage(folder / "80_qa", {"verdict.json": b"{}"}, (folder / "20_segment" / "case.json").read_bytes())


SPOILT: dict[str, tuple[Callable[[Path], object], str]] = {
    "run.json is damaged": (_spoil_json, "run.json is damaged"),
    "run.json is a folder": (_spoil_kind, "run.json: not a file"),
    "run.json is a link": (_spoil_link, "run.json: not a file"),
    "of another case": (_spoil_name, "they were made for a case of another name"),
    "verdict altered": (_spoil_verdict, "80_qa/verdict.json is missing or was altered"),
    "record altered": (_spoil_record, "80_qa: record stage.json altered on disk"),
    "another version": (_spoil_version, "verdict.json was made by another version of the program"),
    "side altered": (_spoil_side, "20_segment/case.json is not the one that the report was made from"),
    "picture altered": (_spoil_picture, "80_qa/report/images/bones.png is missing or was altered"),
    "no stage": (lambda folder: shutil.rmtree(folder / "80_qa"), "80_qa: no result yet"),
    "no verdict": (
        lambda folder: (folder / "80_qa" / "verdict.json").unlink(),
        "80_qa/verdict.json is missing or was altered",
    ),
    "no facts": (lambda folder: (folder / "20_segment" / "case.json").unlink(), "is not the one that the report"),
}


@pytest.mark.parametrize("way", SPOILT)
def test_a_spoilt_case_is_a_line_that_says_so_and_spoils_no_other(places: Places, way: str) -> None:
    spoil, words = SPOILT[way]
    spoil(places.results / "P2")
    overview = update(places)
    assert [one.state for one in overview.rows] == ["PASS", "UNREADABLE"]
    assert words in overview.rows[1].reasons[0]
    assert "ct2lut run P2" in overview.rows[1].action
    assert (overview.rows[1].report, overview.rows[1].body_part, overview.rows[1].pictures) == ("", "", "")
    assert str(places.results.parent) not in places.page.read_text() + places.index.read_text()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_folder_that_may_not_be_read_is_a_line_that_says_so(places: Places) -> None:
    (places.results / "P2").chmod(0)
    try:
        assert row(places, "P2").reasons == ("These results cannot be used (run.json: Permission denied).",)
    finally:
        (places.results / "P2").chmod(0o750)


def test_a_read_that_fails_is_a_line_that_says_so(places: Places, monkeypatch: pytest.MonkeyPatch) -> None:

    def failing(path: Path) -> bytes:
        if path.parent.name == "P2":
            raise PermissionError(13, "Permission denied", str(path))
        return read_file(path)

    monkeypatch.setattr(cohort_case, "read_file", failing)
    assert row(places, "P2").reasons == ("These results cannot be used (run.json: Permission denied).",)
    assert row(places, "P1").state == "PASS"


def test_a_missing_picture_is_a_plate_and_no_pictures_no_strip(places: Places) -> None:
    write_finished(
        places.results, "P3", PASSED, images={name: data for name, data in sheets().items() if name != "bones"}
    )
    write_finished(places.results, "P4", PASSED, images={})
    assert np.median(picture(places, row(places, "P3"))[:, 100:196]) == pytest.approx(240, abs=3)
    assert row(places, "P4").pictures == ""


def test_texts_of_a_damaged_record_do_nothing(places: Places) -> None:
    hostile = "<script>alert(1)</script><img src=x onerror=alert(2)>\"'{{ 7 * 7 }}"
    write_stopped(places.results, "P3", "REJECTED", (hostile, hostile, hostile))
    update(places)
    text = places.page.read_text()
    assert text.count("<script") == 1
    assert "<img src=x" not in text
    assert text.count("&lt;script&gt;alert(1)&lt;/script&gt;") == 3


def test_nothing_is_read_or_written_again_without_a_change(places: Places) -> None:
    assert update(places).read == 2
    before = written(places)
    again = update(places)
    assert (again.read, again.gone) == (0, 0)
    assert written(places) == before


def test_only_what_changed_is_read_again(places: Places, monkeypatch: pytest.MonkeyPatch) -> None:
    update(places)
    write_finished(places.results, "P2", replace(REVIEW, reasons=("Another reason.",)))
    write_finished(places.results, "P3", PASSED)
    seen: list[str] = []

    def watched(case: CaseOnDisk, pictures: Path) -> CaseRow:
        seen.append(case.name)
        return read_row(case, pictures)

    monkeypatch.setattr(cohort_index, "read_row", watched)
    overview = update(places)
    assert sorted(seen) == ["P2", "P3"]
    assert overview.read == 2
    assert [one.reasons for one in overview.rows] == [(), ("Another reason.",), ()]


def test_cases_that_are_gone_vanish_with_their_pictures(places: Places) -> None:
    write_finished(places.results, "P3", PASSED, images=sheets(7))
    update(places)
    assert len(list(places.pictures.iterdir())) == 2  # P1 and P2 look the same
    shutil.rmtree(places.results / "P3")
    overview = update(places)
    assert ([one.case_id for one in overview.rows], overview.gone) == (["P1", "P2"], 1)
    assert [path.name for path in places.pictures.iterdir()] == [overview.rows[0].pictures]
    assert "P3" not in places.page.read_text() + places.index.read_text()


def test_only_our_own_pictures_are_cleared_away(places: Places) -> None:
    update(places)
    (places.pictures / "notes.txt").write_text("mine")
    (places.pictures / f"{'0' * 32}.jpg").write_bytes(b"old")
    update(places)
    assert (places.pictures / "notes.txt").exists()
    assert not (places.pictures / f"{'0' * 32}.jpg").exists()


@pytest.mark.parametrize("damage", [b"", b"{", b"[]", b'{"format": 1, "software": "x", "entries": {}}', None])
def test_a_damaged_index_is_made_anew(places: Places, damage: bytes | None) -> None:
    update(places)
    before = {name: data for name, (_, data) in written(places).items()}
    places.index.unlink()
    if damage is not None:
        places.index.write_bytes(damage)
    assert update(places).read == 2
    assert {name: data for name, (_, data) in written(places).items()} == before


def test_an_altered_page_or_lost_pictures_come_back(places: Places) -> None:
    update(places)
    before = {name: data for name, (_, data) in written(places).items()}
    places.page.write_text("other")
    shutil.rmtree(places.pictures)
    update(places)
    assert {name: data for name, (_, data) in written(places).items()} == before


def test_results_moved_as_a_whole_are_the_same_bytes(places: Places, tmp_path: Path) -> None:
    update(places)
    before = {name: data for name, (_, data) in written(places).items()}
    moved = Places(tmp_path / "elsewhere", tmp_path / "elsewhere" / "index.html")
    shutil.copytree(places.results, moved.results)
    assert update(moved).read == 0
    assert {name: data for name, (_, data) in written(moved).items()} == before


def test_a_page_elsewhere_links_to_the_results(places: Places, tmp_path: Path) -> None:
    page = tmp_path / "web" / "morning list.html"
    update(Places(places.results, page))
    text = page.read_text()
    assert 'href="../results/P1/90_package/report.html"' in text
    assert 'src="morning%20list.files/' in text
    assert page.with_suffix(".json").is_file()
    assert sorted(path.name for path in places.results.iterdir()) == ["P1", "P2"]


def test_what_lies_beside_cases_is_no_case(places: Places) -> None:
    update(places)
    (places.results / ".hidden").mkdir()
    (places.results / "not a case").mkdir()
    (places.results / "P9").write_text("a file")
    assert [one.case_id for one in update(places).rows] == ["P1", "P2"]


def test_an_empty_folder_is_a_page(tmp_path: Path) -> None:
    overview = update(Places(tmp_path, tmp_path / "index.html"))
    assert overview.rows == ()
    assert "There are no results" in (tmp_path / "index.html").read_text()


def test_a_flow_without_a_verdict_has_states_only(tmp_path: Path) -> None:
    (tmp_path / "P1").mkdir()
    write_run(tmp_path, "P1", "PASS")
    overview = write_overview(Places(tmp_path, tmp_path / "index.html"), TOY_FLOW)
    assert overview.rows == (CaseRow("P1", "PASS"),)


@pytest.mark.parametrize(
    ("results", "page", "message"),
    [
        ("nowhere", "index.html", r"^E-OVW-01 The results folder does not exist\."),
        (".", "index.json", r"^E-OVW-02 The page cannot be called index\.json"),
    ],
)
def test_wrong_places_are_refused(tmp_path: Path, results: str, page: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        update(Places(tmp_path / results, tmp_path / page))
    assert str(tmp_path) not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_the_screen_says_what_was_done() -> None:
    rows = (CaseRow("P1", "PASS"),)
    assert overview_lines(Overview(rows, 1, 0), Path("a/index.html")) == ["1 case, 1 read again", "page: a/index.html"]
    assert overview_lines(Overview(rows * 3, 0, 2), Path("p.html"))[0] == "3 cases, 0 read again, 2 gone"
