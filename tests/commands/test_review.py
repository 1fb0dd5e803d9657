"""``ct2lut review``: a decision is kept only with the result that was read, and status says when that is gone."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipeline import cli
from pipeline.commands.review import (
    LARGEST_BYTES,
    REVIEW_FILE,
    ReviewedCase,
    decode_review,
    encode_review,
    review_line,
    store_review,
)
from pipeline.engine.lock import case_lock
from pipeline.engine.manifest import InputRecord, Manifest, Recipe, encode_manifest
from pipeline.engine.runlog import LOG_FILE
from pipeline.errors import ConfigError, EnvironmentFault, ExitCode
from pipeline.flow import FLOW
from pipeline.records import Verdict
from pipeline.report.sign_off import DECIDED, review_facts
from tests.report.sample import sample_evidence

VERDICT = Verdict("PASS", (), ())
PACKAGE = FLOW[-1]
EVIDENCE = sample_evidence("left", "P001")
ACCEPTED = {"decision": "accept", "initials": "AB", "remark": "", "date": "2031-02-03"}


def saved(**changes: Any) -> dict[str, Any]:
    """What the page saves."""
    return {**review_facts(EVIDENCE, VERDICT), **ACCEPTED, **changes}


def written(folder: Path, body: object) -> Path:
    path = folder / "P001_review.json"
    path.write_text(json.dumps(body))
    return path


def packaged(results: Path, verdict: Verdict = VERDICT) -> ReviewedCase:
    """A case whose package was made from the sample and a verdict."""
    content = (EVIDENCE.facts, EVIDENCE.anatomy, EVIDENCE.smooth, verdict)
    marks = review_facts(EVIDENCE, verdict)["result"]
    # as a run reads them back from disk and finds them again
    for artifact, value in zip(DECIDED, content, strict=True):
        assert artifact.encode(artifact.decode(artifact.encode(value))) == artifact.encode(value)
    inputs = {name: InputRecord(mark, 1) for name, mark in marks.items()}
    recipe = Recipe("package", {}, inputs, {}, {}, {})
    folder = results / "P001" / PACKAGE.folder
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "stage.json").write_bytes(encode_manifest(Manifest(recipe.key, recipe, {}, (), 1.0, {})))
    return ReviewedCase("P001", results / "P001", PACKAGE)


def test_the_package_is_made_from_all_that_is_decided_on() -> None:
    assert set(DECIDED) <= set(PACKAGE.reads)


def test_a_review_is_kept_and_said(tmp_path: Path) -> None:
    case = packaged(tmp_path)
    assert review_line(case) is None
    kept = store_review(case, written(tmp_path, saved(decision="reject", remark="The tibia is cut off.")))
    assert (kept.decision, kept.remark) == ("reject", "The tibia is cut off.")
    stored = (case.folder / REVIEW_FILE).read_bytes()
    assert decode_review(stored) == kept
    assert encode_review(kept) == stored
    assert review_line(case) == "review: rejected by AB on 2031-02-03"
    assert json.loads((case.folder / LOG_FILE).read_text())["msg"] == "review: rejected by AB on 2031-02-03"


def test_a_later_review_replaces_an_earlier(tmp_path: Path) -> None:
    case = packaged(tmp_path)
    store_review(case, written(tmp_path, saved()))
    store_review(case, written(tmp_path, saved(decision="accept_with_remark", remark="x", initials="CD")))
    assert review_line(case) == "review: accepted with a remark by CD on 2031-02-03"
    assert len((case.folder / LOG_FILE).read_text().splitlines()) == 2
    assert sorted(path.name for path in case.folder.iterdir()) == [".lock", "90_package", LOG_FILE, REVIEW_FILE]


def test_a_result_that_changed_makes_the_review_an_old_one(tmp_path: Path) -> None:
    case = packaged(tmp_path)
    store_review(case, written(tmp_path, saved()))
    packaged(tmp_path, Verdict("REVIEW", ("Look.",), ()))
    older = "review: accepted by AB on 2031-02-03, of an OLDER result: read the report again"
    assert review_line(case) == older
    (case.folder / PACKAGE.folder / "stage.json").unlink()
    assert review_line(case) == older


def test_a_damaged_review_is_said(tmp_path: Path) -> None:
    case = packaged(tmp_path)
    (case.folder / REVIEW_FILE).write_text("{")
    assert review_line(case) == "review: its file is damaged"
    (case.folder / REVIEW_FILE).unlink()
    (case.folder / REVIEW_FILE).mkdir()
    assert review_line(case) == "review: its file is damaged"


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ({}, r"^E-REV-02 The file \"P001_review.json\" is not a review of this program \(schema: Field required\)"),
        ([], r"^E-REV-02 .*is not a review"),
        (saved(schema={"name": "ct2lut-review", "version": "2.0"}), r"^E-REV-02 .*schema\.version"),
        (saved(decision="maybe"), r"^E-REV-02 .*decision"),
        (saved(decision="reject"), r"^E-REV-02 .*a remark is missing"),
        (saved(decision="accept_with_remark", remark=" \n"), r"^E-REV-02 .*a remark is missing"),
        (saved(initials=" "), r"^E-REV-02 .*initials"),
        (saved(date="yesterday"), r"^E-REV-02 .*date"),
        (saved(remark="x" * 2001), r"^E-REV-02 .*remark"),
        (saved(more="x"), r"^E-REV-02 .*more"),
        (saved(result={"smooth_table": "x"}), r"^E-REV-02 .*result\.smooth_table"),
        (saved(remark="x" * LARGEST_BYTES), r"^E-REV-02 .*it has more than 100000 bytes"),
        (saved(case_id="P002"), r"^E-REV-03 This is the review of \"P002\", not of P001\."),
        (saved(result={}), r"^E-REV-04 The review is of another result of P001"),
        (saved(result=review_facts(EVIDENCE, Verdict("REVIEW", (), ()))["result"]), r"^E-REV-04 "),
        (saved(result={**review_facts(EVIDENCE, VERDICT)["result"], "more": "0" * 64}), r"^E-REV-04 "),
    ],
)
def test_what_is_no_review_of_this_result_is_refused(tmp_path: Path, body: object, message: str) -> None:
    case = packaged(tmp_path)
    path = written(tmp_path, body)
    with pytest.raises(ConfigError, match=message) as caught:
        store_review(case, path)
    assert caught.value.exit_code == ExitCode.USAGE
    assert str(tmp_path) not in str(caught.value)
    assert not (case.folder / REVIEW_FILE).exists()


def test_another_table_of_the_same_case_is_another_result(tmp_path: Path) -> None:
    table = EVIDENCE.smooth
    other = replace(
        EVIDENCE, smooth=replace(table, poses=replace(table.poses, lateral_mm=table.poses.lateral_mm + 1e-9))
    )
    body = {**review_facts(other, VERDICT), **ACCEPTED}
    with pytest.raises(ConfigError, match=r"^E-REV-04 "):
        store_review(packaged(tmp_path), written(tmp_path, body))


def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    case = packaged(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    for name, words in (("none.json", "No such file or directory"), ("pipe", "not a regular file")):
        with pytest.raises(ConfigError, match=rf"^E-REV-02 The file \"{name}\" cannot be read: {words}\."):
            store_review(case, tmp_path / name)


def test_without_a_result_there_is_nothing_to_review(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^E-REV-01 P001 has no finished result to review\. Run it first"):
        store_review(ReviewedCase("P001", tmp_path / "P001", PACKAGE), written(tmp_path, saved()))
    assert not (tmp_path / "P001").exists()


def test_a_review_waits_for_a_run(tmp_path: Path) -> None:
    case = packaged(tmp_path)
    with case_lock(case.folder), pytest.raises(EnvironmentFault, match="E-LOCK-01"):
        store_review(case, written(tmp_path, saved()))


def test_the_command_keeps_it_and_status_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    packaged(tmp_path)
    file = written(tmp_path, saved(initials="A\u202eB"))
    assert cli.execute(["review", "P001", str(file), "--results", str(tmp_path)]) == ExitCode.PASS
    assert capsys.readouterr().out == "P001: accepted by A\\u202eB on 2031-02-03\n"
    assert cli.execute(["status", "P001", "--results", str(tmp_path)]) == ExitCode.PASS
    assert capsys.readouterr().out.splitlines()[-1] == "review: accepted by A\\u202eB on 2031-02-03"
    assert cli.execute(["review", "../P001", str(file), "--results", str(tmp_path)]) == ExitCode.USAGE
    assert capsys.readouterr().err.startswith("E-ID-01")
