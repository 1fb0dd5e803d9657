"""A result is used only when it is proven to be the one this run would make; the first reason is said."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.engine import cache
from pipeline.engine.code_digest import Code, code_of, package_versions
from pipeline.engine.inspection import plan_case, verify_case
from pipeline.engine.manifest import FORMAT, Manifest, decode_manifest, sha256_of_json
from pipeline.engine.outcome import CaseJob
from pipeline.engine.records import canonical_json
from pipeline.engine.stage import Stage, StrictParams
from tests.engine.toy_flow import (
    DEFAULTS,
    FLOW,
    GATHER,
    MULTIPLY,
    TOTAL,
    GatherParams,
    Grid,
    MultiplyParams,
    artifact_bytes,
    make_case,
    reasons,
    run,
    states,
)


@pytest.fixture
def job(tmp_path: Path) -> CaseJob:
    job = make_case(tmp_path)
    run(job)
    return job


def assert_reruns(
    job: CaseJob,
    stage: str,
    reason: str,
    settings: Mapping[str, StrictParams] | None = None,
    flow: Sequence[Stage] = FLOW,
) -> None:
    """The plan and the run agree on that reason, and after the run all is up to date."""
    plan = {row.stage: row for row in plan_case(job, flow, {**DEFAULTS, **(settings or {})})}
    assert (plan[stage].action, plan[stage].reason) == ("run", reason)
    outcome, _ = run(job, flow, settings)
    assert reasons(outcome)[stage] == reason
    assert states(run(job, flow, settings)[0]) == ["cached"] * 3
    assert {row.action for row in plan_case(job, flow, {**DEFAULTS, **(settings or {})})} == {"skip"}
    assert verify_case(job.results, flow) == ()


def test_input(job: CaseJob) -> None:
    (job.source / "numbers.txt").write_text("4 5")
    outcome, _ = run(job)
    assert reasons(outcome) == {
        "gather": "input case folder changed",
        "multiply": "input numbers changed",
        "total": "input multiples changed",
    }


def test_a_renamed_input_file_is_another_input(job: CaseJob) -> None:
    (job.source / "copy.txt").write_bytes((job.source / "numbers.txt").read_bytes())
    assert_reruns(job, "gather", "input case folder changed")


def test_setting(job: CaseJob) -> None:
    assert_reruns(job, "gather", "setting keep 5 -> 2", {"gather": GatherParams(keep=2)})


def test_nested_setting_with_old_and_new_value(job: CaseJob) -> None:
    settings = {"multiply": MultiplyParams(grid=Grid(step_deg=1.0))}
    assert_reruns(job, "multiply", "setting grid.step_deg 2.0 -> 1.0", settings)


def test_code(job: CaseJob, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        cache, "code_of", lambda stage, earlier: Code({**code_of(stage).meaning, "toy.formulas": "new"}, {})
    )
    assert_reruns(job, "gather", "code changed (toy.formulas)")


def test_package_version(job: CaseJob, monkeypatch: pytest.MonkeyPatch) -> None:
    now = package_versions()
    monkeypatch.setattr(cache, "package_versions", lambda: {**now, "numpy": "99.0"})
    assert_reruns(job, "total", f"package numpy {now['numpy']} -> 99.0")


def test_schema_of_what_it_writes_and_of_what_it_reads(job: CaseJob) -> None:
    newer = replace(GATHER.writes[0], schema=2)
    flow = (replace(GATHER, writes=(newer,)), replace(MULTIPLY, reads=(newer,)), TOTAL)
    plan = plan_case(job, flow, DEFAULTS)
    assert [row.reason for row in plan] == ["result of an older format"] * 2 + ["20_multiply may change"]
    assert_reruns(job, "gather", "result of an older format", flow=flow)


def rewrite_manifest(path: Path, change: Callable[[dict[str, object]], None]) -> None:
    """Change a manifest and give it a right hash of its own again."""
    body = json.loads(path.read_text())
    del body["sha256"]
    change(body)
    path.write_bytes(canonical_json({**body, "sha256": sha256_of_json(body)}))


@pytest.mark.parametrize(("shift", "word"), [(-1, "an older"), (1, "a newer")])
def test_layout_of_another_release(job: CaseJob, shift: int, word: str) -> None:
    rewrite_manifest(job.results / "20_multiply/stage.json", lambda body: body.update(format=FORMAT + shift))
    assert_reruns(job, "multiply", f"result of {word} format")


def test_a_key_that_was_made_up(job: CaseJob) -> None:
    rewrite_manifest(job.results / "20_multiply/stage.json", lambda body: body.update(key="0" * 64))
    assert verify_case(job.results, FLOW) == ("20_multiply: its key is not that of its recorded ingredients",)
    assert reasons(run(job)[0])["multiply"] == "result of an older format"


def alter(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def link(path: Path) -> None:
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")


def fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize("name", ["multiples.json", "parts/1/value.txt", "findings.json"])
@pytest.mark.parametrize(
    ("damage", "word"),
    [(alter, "altered"), (truncate, "altered"), (Path.unlink, "missing"), (link, "missing"), (fifo, "missing")],
)
def test_a_damaged_output_is_set_aside_and_made_again(
    job: CaseJob, name: str, damage: Callable[[Path], None], word: str
) -> None:
    before = artifact_bytes(job.results)
    damage(job.results / "20_multiply" / name)
    assert verify_case(job.results, FLOW) == (f"20_multiply: output {name} {word} on disk",)
    outcome, _ = run(job)
    assert states(outcome) == ["cached", "ran", "cached"]
    assert reasons(outcome)["multiply"] == f"output {name} {word} on disk"
    assert artifact_bytes(job.results) == before
    assert len(list(job.results.glob(".quarantine-20_multiply-*"))) == 1


def test_every_byte_of_a_manifest_counts(job: CaseJob) -> None:
    good = (job.results / "10_gather" / "stage.json").read_bytes()
    flipped = (good[:place] + bytes([good[place] ^ 1]) + good[place + 1 :] for place in range(len(good)))
    served = [data for data in flipped if isinstance(decode_manifest(data), Manifest)]
    assert all(json.loads(data) == json.loads(good) for data in served), "only white space may differ"


@pytest.mark.parametrize("data", [b"", b"[]", b"null", b"{}", b'{"sha256": 1}', b"\xff", b"[" * 100_000])
def test_a_manifest_that_is_none_is_set_aside(job: CaseJob, data: bytes) -> None:
    (job.results / "10_gather" / "stage.json").write_bytes(data)
    assert_reruns(job, "gather", "record stage.json altered on disk")


def test_a_result_of_another_case_or_stage_is_not_used(job: CaseJob, tmp_path: Path) -> None:
    other = make_case(tmp_path / "other", "7 8 9")
    run(other)
    shutil.rmtree(job.results / "20_multiply")
    shutil.copytree(other.results / "20_multiply", job.results / "20_multiply")
    assert_reruns(job, "multiply", "input numbers changed")
    shutil.rmtree(job.results / "20_multiply")
    shutil.copytree(job.results / "10_gather", job.results / "20_multiply")
    assert_reruns(job, "multiply", "result of another stage, gather")


def test_a_planted_link_instead_of_a_stage_folder_is_not_followed(job: CaseJob, tmp_path: Path) -> None:
    (job.results / "20_multiply").rename(tmp_path / "victim")
    (job.results / "20_multiply").symlink_to(tmp_path / "victim")
    outcome, _ = run(job)
    assert reasons(outcome)["multiply"] == "20_multiply is not a folder"
    assert not (job.results / "20_multiply").is_symlink()
    assert (tmp_path / "victim" / "stage.json").is_file()
