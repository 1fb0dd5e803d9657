"""Damaged stages are set aside, sound ones stay, and the next run mends the case."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.commands.repair import Verified, repair_case, verified_lines, verify_all
from pipeline.engine.inspection import verify_case
from pipeline.engine.lock import case_lock
from pipeline.engine.outcome import CaseJob
from pipeline.errors import ConfigError, EnvironmentFault
from tests.engine.toy_flow import FLOW, artifact_bytes, leftovers, make_case, run, states

CLOSING = "To make it again type: ct2lut run P1 (with the cases, results and protocol as before)"


@pytest.fixture
def job(tmp_path: Path) -> CaseJob:
    made = make_case(tmp_path)
    assert run(made)[0].word == "PASS"
    return made


def alter(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"6", b"7", 1))


def forge_key(stage: Path) -> None:
    """A record that is whole by its own hash, and whose key is of other ingredients."""
    from pipeline.engine.manifest import decode_manifest, encode_manifest  # noqa: PLC0415

    manifest = decode_manifest((stage / "stage.json").read_bytes())
    object.__setattr__(manifest, "key", "0" * 64)
    (stage / "stage.json").write_bytes(encode_manifest(manifest))  # type: ignore[arg-type]


def become_link(stage: Path) -> None:
    away = stage.parent.parent / "away"
    stage.rename(away)
    stage.symlink_to(away)


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "altered": (lambda stage: alter(stage / "multiples.json"), "output multiples.json altered on disk"),
    "missing": (lambda stage: (stage / "parts/0/value.txt").unlink(), "output parts/0/value.txt missing on disk"),
    "record altered": (lambda stage: alter(stage / "stage.json"), "record stage.json altered on disk"),
    "record gone": (lambda stage: (stage / "stage.json").unlink(), "without its record stage.json"),
    "forged": (forge_key, "its key is not that of its recorded ingredients"),
    "link": (become_link, "20_multiply is not a folder"),
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_a_damaged_stage_is_set_aside_and_made_again_as_it_was(job: CaseJob, kind: str) -> None:
    before = artifact_bytes(job.results)
    damage, reason = DAMAGES[kind]
    damage(job.results / "20_multiply")
    assert repair_case(job.results, FLOW) == (
        f"20_multiply: {reason}; set aside, the next run makes it again",
        "Every other stage stays as it is, and is made again only if what it reads comes out different.",
        CLOSING,
    )
    (kept,) = leftovers(job.results)
    assert kept.startswith(".quarantine-20_multiply-")
    assert states(run(job)[0]) == ["cached", "ran", "cached"]
    assert artifact_bytes(job.results) == before
    assert verify_case(job.results, FLOW) == ()
    assert repair_case(job.results, FLOW) == ("P1: every recorded file is as it was written; nothing to repair",)


def test_a_sound_case_is_left_as_it_is(job: CaseJob) -> None:
    before = {path: path.stat().st_mtime_ns for path in job.results.rglob("*") if path.name != ".lock"}
    assert repair_case(job.results, FLOW) == ("P1: every recorded file is as it was written; nothing to repair",)
    assert {path: path.stat().st_mtime_ns for path in job.results.rglob("*") if path.name != ".lock"} == before


def test_a_stage_that_is_only_out_of_date_is_not_set_aside(job: CaseJob) -> None:
    from tests.engine.toy_flow import GatherParams  # noqa: PLC0415

    run(job, FLOW[:1], {"gather": GatherParams(keep=1)})
    lines = repair_case(job.results, FLOW)
    text = "made from another numbers than the one that is there now; kept, the next run makes it again"
    assert lines == (f"20_multiply: {text}", CLOSING)
    assert leftovers(job.results) == []


def test_what_a_killed_run_had_moved_away_comes_back(job: CaseJob) -> None:
    stage = job.results / "20_multiply"
    stage.rename(stage.with_name(f".20_multiply.old-{'0' * 32}"))
    assert repair_case(job.results, FLOW) == ("P1: every recorded file is as it was written; nothing to repair",)
    assert stage.is_dir()


@pytest.mark.parametrize(("content", "state"), [(None, "is missing"), (b"{", "cannot be understood")])
def test_the_record_of_the_run_is_not_guessed(job: CaseJob, content: bytes | None, state: str) -> None:
    record = job.results / "run.json"
    record.write_bytes(content) if content else record.unlink()
    line = f"run.json: {state}; how the last run ended is not known, the next run writes it"
    assert repair_case(job.results, FLOW) == (line, CLOSING)
    assert record.exists() == bool(content)
    assert states(run(job)[0]) == ["cached"] * 3


def test_a_running_case_is_neither_repaired_nor_judged(job: CaseJob) -> None:
    alter(job.results / "20_multiply/multiples.json")
    with case_lock(job.results):
        with pytest.raises(EnvironmentFault, match=r"E-LOCK-01 Case P1 is already running since .*nothing was changed"):
            repair_case(job.results, FLOW)
        (found,) = verify_all(job.results.parent, FLOW)
        assert found == Verified("P1", (), running=True)
    assert verified_lines(found) == ("P1: is running; look again when it has ended",)
    assert leftovers(job.results) == []


def test_a_case_without_results_is_told_and_not_made(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"E-CLN-02 P9 has no results here\."):
        repair_case(tmp_path / "P9", FLOW)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ConfigError, match=r"E-CLN-01 The results folder does not exist\."):
        list(verify_all(tmp_path / "nowhere", FLOW))


def test_all_cases_are_compared_and_one_that_cannot_be_read_does_not_stop_it(
    job: CaseJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = job.results.parent
    for name in ("P2", "P3"):
        shutil.copytree(job.results, results / name)
    (results / "P4").symlink_to(job.results)
    (results / "cohort.files").mkdir()
    alter(results / "P3/20_multiply/multiples.json")

    def verify(folder: Path, flow: object) -> tuple[str, ...]:
        if folder.name == "P1":
            raise EnvironmentFault("E-ENV-03", "Verifying the results failed.", "Check the disk.")
        return verify_case(folder, FLOW)

    monkeypatch.setattr("pipeline.commands.repair.verify_case", verify)
    lines = [line for found in verify_all(results, FLOW) for line in verified_lines(found)]
    assert lines == [
        "P1: E-ENV-03 Verifying the results failed.",
        "P2: every recorded file is as it was written",
        "P3: 20_multiply: output multiples.json altered on disk",
    ]
