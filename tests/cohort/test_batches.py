"""The plan of a cohort: stable batches, lists that change only when something did, what the engine is told."""

from __future__ import annotations

import json
import os
import shlex
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.cohort import batches
from pipeline.cohort.batches import (
    BatchCase,
    PlanInputs,
    batch_of,
    bucket_count,
    default_batch_size,
    load_batch,
    load_plan,
    look_at,
    source_signature,
    write_plan,
)
from pipeline.cohort.model import CaseLimits, CohortRequest, ListedCase, Plan
from pipeline.cohort.place import CohortPlace
from pipeline.cohort.resources import batch_resources
from pipeline.errors import ConfigError

LONG_AGO_NS = 1_000_000_000 * 10**9


def sources(root: Path, *names: str) -> tuple[ListedCase, ...]:
    for name in names:
        (root / name).mkdir(parents=True, exist_ok=True)
        (root / name / "labels.nrrd").write_text(name)
    return tuple(ListedCase(name, root / name) for name in names)


def inputs(cases: tuple[ListedCase, ...], buckets: int = 0, **more: object) -> PlanInputs:
    request = CohortRequest("/data/cases", "demo", ("sweep.flexion_step_deg=5",), 1, CaseLimits(0, 60.5), buckets)
    return replace(PlanInputs(request, "k" * 64, cases, "ct2lut"), **more)  # type: ignore[arg-type]


def finished(place: CohortPlace, plan: Plan) -> None:
    """As if every batch had run, long ago by some other clock's reckoning."""
    place.done("any").parent.mkdir(exist_ok=True)
    for name in plan.batches:
        place.done(name).write_text("done")
        os.utime(place.case_list(name), ns=(LONG_AGO_NS, LONG_AGO_NS))


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def waiting(place: CohortPlace, plan: Plan) -> set[str]:
    """Batches whose list was written again; they have no result, whatever the clock says."""
    again = {name for name in plan.batches if place.case_list(name).stat().st_mtime_ns != LONG_AGO_NS}
    assert again == {name for name in plan.batches if not place.done(name).exists()}
    return again


# Signatures


def test_a_signature_is_that_of_names_sizes_and_times(tmp_path: Path) -> None:
    (case,) = sources(tmp_path, "P1")
    (case.folder / "ct").mkdir()
    (case.folder / "ct" / "1.dcm").write_text("12345")
    seen = [source_signature(case.folder)]
    assert source_signature(case.folder) == seen[0]
    os.utime(case.folder / "ct" / "1.dcm", ns=(1, LONG_AGO_NS))
    seen.append(source_signature(case.folder))
    (case.folder / "ct" / "1.dcm").rename(case.folder / "1.dcm")
    seen.append(source_signature(case.folder))
    (case.folder / "1.dcm").write_text("123456")
    os.utime(case.folder / "1.dcm", ns=(1, LONG_AGO_NS))
    seen.append(source_signature(case.folder))
    (case.folder / "1.dcm").unlink()
    seen.append(source_signature(case.folder))
    assert len(set(seen)) == len(seen)


def test_a_signature_does_not_depend_on_where_the_case_lies(tmp_path: Path) -> None:
    (one,) = sources(tmp_path / "a", "P1")
    os.utime(one.folder / "labels.nrrd", ns=(1, LONG_AGO_NS))
    before = source_signature(one.folder)
    (tmp_path / "link").symlink_to(one.folder)
    assert source_signature(tmp_path / "link") == before
    one.folder.rename(tmp_path / "P2")
    assert source_signature(tmp_path / "P2") == before


def test_hidden_files_do_not_count(tmp_path: Path) -> None:
    (case,) = sources(tmp_path, "P1")
    before = look_at(case.folder)
    (case.folder / ".nfs0001").write_text("x")
    (case.folder / ".cache").mkdir()
    assert look_at(case.folder) == before
    assert before.size == 2


def test_what_cannot_be_looked_at_goes_in_as_that(tmp_path: Path) -> None:
    (case,) = sources(tmp_path, "P1")
    seen = [source_signature(tmp_path / "absent"), source_signature(case.folder)]
    (case.folder / "nowhere").symlink_to("absent")
    seen.append(source_signature(case.folder))
    (case.folder / "loop").symlink_to(".")
    seen.append(source_signature(case.folder))
    Path(os.fsdecode(os.fsencode(case.folder) + b"/\xff")).write_text("")
    seen.append(source_signature(case.folder))
    seen.append(source_signature(case.folder / "labels.nrrd"))
    assert len(set(seen)) == len(seen)
    assert look_at(tmp_path / "absent").size == 0


def test_a_folder_that_may_not_be_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (case,) = sources(tmp_path, "P1")
    before = source_signature(case.folder)

    def denied(folder: str) -> None:
        raise PermissionError(13, "denied", folder)

    monkeypatch.setattr(os, "scandir", denied)
    assert source_signature(case.folder) != before


def test_a_look_has_an_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (case,) = sources(tmp_path, "P1")
    for number in range(20):
        (case.folder / f"{number}").write_text("1234567890")
    monkeypatch.setattr(batches, "MAX_FILES", 5)
    assert 0 < look_at(case.folder).size <= 50


# Batches


@pytest.mark.parametrize(
    ("cases", "cluster", "size"),
    [
        (1, False, 1),
        (2000, False, 1),
        (2001, False, 50),
        (1, True, 1),
        (20, True, 1),
        (1000, True, 10),
        (9999, True, 50),
    ],
)
def test_default_batch_size(cases: int, *, cluster: bool, size: int) -> None:
    assert default_batch_size(cases, cluster=cluster) == size


def test_number_of_batches() -> None:
    assert bucket_count(5000, 1) == 0
    assert bucket_count(100, 50) == 2
    assert bucket_count(101, 50) == 3
    assert bucket_count(3, 50) == 1


def test_the_number_of_batches_stays_while_a_cohort_grows() -> None:
    assert [bucket_count(cases, 50, before=4) for cases in (99, 100, 201, 400, 401)] == [2, 4, 4, 4, 9]
    assert bucket_count(200, 1, before=4) == 0


@given(st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", fullmatch=True), st.integers(1, 20_000))
def test_the_name_of_a_batch_depends_on_the_case_alone(case_id: str, buckets: int) -> None:
    name = batch_of(case_id, buckets)
    assert name == batch_of(case_id, buckets)
    assert 0 <= int(name.removeprefix("bucket-")) < buckets
    assert batch_of(case_id, 0) == case_id


def test_batches_are_even_and_known() -> None:
    sizes = Counter(batch_of(f"P{number:04d}", 40) for number in range(2000))
    assert len(sizes) == 40
    assert max(sizes.values()) < 2 * 50
    # `printf P0001 | sha1sum` modulo 40: no later version may deal the cases anew
    assert batch_of("P0001", 40) == f"bucket-{0x40048DAAEA7974222C5D7C48EE36C45C83ED8E7B % 40:04d}"


# Plans


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    place, cases = CohortPlace(tmp_path / "r"), sources(tmp_path / 'cases, "a"\r\n;', "P2", "0012", "P1")
    plan = write_plan(place, inputs(cases, 2))
    assert load_plan(place) == plan
    assert plan.request == inputs(cases, 2).request
    assert sorted(case for ids in plan.batches.values() for case in ids) == ["0012", "P1", "P2"]
    for name, ids in plan.batches.items():
        batch = load_batch(place, name)
        assert batch == tuple(
            BatchCase(case, source_signature(case.folder), 1)
            for case in sorted(cases, key=lambda case: case.case_id)
            if case.case_id in ids
        )


def test_each_case_is_a_batch_where_there_are_no_buckets(tmp_path: Path) -> None:
    plan = write_plan(CohortPlace(tmp_path), inputs(sources(tmp_path / "c", "P2", "P1")))
    assert plan.batches == {"P1": ("P1",), "P2": ("P2",)}


def test_the_engine_is_told_what_its_file_asks_for(tmp_path: Path) -> None:
    results = tmp_path / "it's $HOME {x}"
    place, cases = CohortPlace(results), sources(tmp_path / "c", "P1", "P2")
    asked = inputs(cases, program="apptainer exec 'my image.sif' ct2lut", threads=4, retries=1)
    write_plan(place, asked)
    config = json.loads((place.workflow / "config.json").read_text())
    resources = batch_resources([2], asked.request)
    assert shlex.split(config.pop("results")) == [str(results)]
    assert config == {
        "key": asked.key,
        "program": asked.program,
        "threads": 4,
        "retries": 1,
        "batches": {name: {"mem_mb": resources.mem_mb, "minutes": resources.minutes} for name in ("P1", "P2")},
    }


def test_a_job_has_a_core_also_where_a_case_takes_what_there_is(tmp_path: Path) -> None:
    place = CohortPlace(tmp_path)
    write_plan(place, inputs(sources(tmp_path / "c", "P1"), threads=0))
    assert json.loads((place.workflow / "config.json").read_text())["threads"] == 1


def test_nothing_is_written_when_nothing_changed(tmp_path: Path) -> None:
    place, asked = CohortPlace(tmp_path / "r"), inputs(sources(tmp_path / "c", "P1", "P2", "P3"), 2)
    finished(place, write_plan(place, asked))
    before = {path: path.stat().st_mtime_ns for path in place.files.rglob("*") if path.is_file()}
    assert waiting(place, write_plan(place, asked)) == set()
    assert {path: path.stat().st_mtime_ns for path in place.files.rglob("*") if path.is_file()} == before


@pytest.mark.fault("S12")
def test_a_case_more_or_a_changed_file_runs_one_batch_again(tmp_path: Path) -> None:
    place, cases = CohortPlace(tmp_path / "r"), sources(tmp_path / "c", *(f"P{number}" for number in range(40)))
    plan = write_plan(place, inputs(cases, 8))
    finished(place, plan)
    plan = write_plan(place, inputs((*cases, *sources(tmp_path / "c", "P99")), 8))
    assert waiting(place, plan) == {batch_of("P99", 8)}
    finished(place, plan)
    (tmp_path / "c" / "P7" / "labels.nrrd").write_text("corrected")
    plan = write_plan(place, inputs((*cases, *sources(tmp_path / "c", "P99")), 8))
    assert batch_of("P7", 8) in waiting(place, plan)


def test_cases_that_are_asked_for_again(tmp_path: Path) -> None:
    place, cases = CohortPlace(tmp_path / "r"), sources(tmp_path / "c", "P1", "P2")
    for tries in (2, 3):
        finished(place, write_plan(place, inputs(cases)))
        plan = write_plan(place, inputs(cases, retry=frozenset({"P2", "unknown"})))
        assert waiting(place, plan) == {"P2"}
        assert [load_batch(place, name)[0].tries for name in ("P1", "P2")] == [1, tries]
    assert waiting(place, write_plan(place, inputs(cases))) == {"P2"}


def test_batches_that_are_no_more(tmp_path: Path) -> None:
    place, cases = CohortPlace(tmp_path / "r"), sources(tmp_path / "c", "P1", "P2")
    finished(place, write_plan(place, inputs(cases)))
    place.ledger("P2").parent.mkdir()
    place.ledger("P2").write_text("{}\n")
    left = place.case_list("x").with_name(f".P9.csv.partial-{'0' * 32}")
    left.write_text("")
    (place.done("P2").parent / ".snakemake_timestamp").write_text("")
    assert write_plan(place, inputs(cases[:1])).batches == {"P1": ("P1",)}
    assert names(place.case_list("x").parent) == ["P1.csv"]
    assert names(place.done("x").parent) == [".snakemake_timestamp", "P1.csv"]
    assert place.ledger("P2").exists()
    with pytest.raises(ConfigError, match=r"E-PLN-03 The list of the batch P2 is not there"):
        load_batch(place, "P2")


def test_a_plan_that_was_interrupted_is_made_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place, cases = CohortPlace(tmp_path / "r"), sources(tmp_path / "c", "P1", "P2", "P3")
    finished(place, write_plan(place, inputs(cases)))
    (tmp_path / "c" / "P2" / "labels.nrrd").write_text("corrected")

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(batches, "replace_file", killed)
        with pytest.raises(KeyboardInterrupt, match=r"^$"):
            write_plan(place, inputs(cases))
    assert not place.done("P2").exists()
    assert waiting(place, write_plan(place, inputs(cases))) == {"P2"}


def test_unsafe_ids_and_odd_paths(tmp_path: Path) -> None:
    place = CohortPlace(tmp_path / "r")
    with pytest.raises(ConfigError, match=r"E-ID-01 "):
        write_plan(place, inputs((ListedCase("../x", tmp_path),)))
    with pytest.raises(ConfigError, match=r"E-PLN-04 .* characters that are not text"):
        write_plan(place, inputs((ListedCase("P1", tmp_path / "\udcff"),)))
    with pytest.raises(ConfigError, match=r"E-PLN-04 "):
        write_plan(CohortPlace(tmp_path / "\udcff"), inputs(()))
    assert names(tmp_path) == []


def test_no_plan_and_damaged_plans(tmp_path: Path) -> None:
    place = CohortPlace(tmp_path / "r")
    with pytest.raises(ConfigError, match=r"E-PLN-01 There is no cohort in this results folder yet"):
        load_plan(place)
    write_plan(place, inputs(sources(tmp_path / "c", "P1")))
    good = place.plan.read_text()
    for text in ("", "{", "[]", good[:-20], good.replace('"format": 1', '"format": 2'), good.replace('"P1"', '"../x"')):
        assert text != good
        place.plan.write_text(text)
        with pytest.raises(ConfigError, match=r"E-PLN-02 .* damaged or was made by another version"):
            load_plan(place)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "id,folder,signature,tries\n",
        "id,folder\nP1,/c/P1\n",
        "id,folder,signature,tries\nP1,/c/P1,s\n",
        "id,folder,signature,tries\n../x,/c/P1,s,1\n",
        "id,folder,signature,tries\nP1,/c/P1,s,many\n",
        'id,folder,signature,tries\nP1,"/c/P1,s,1\n',
    ],
)
def test_damaged_lists(tmp_path: Path, text: str) -> None:
    place, asked = CohortPlace(tmp_path / "r"), inputs(sources(tmp_path / "c", "P1"))
    write_plan(place, asked)
    place.case_list("P1").write_text(text)
    with pytest.raises(ConfigError, match=r"E-PLN-03 The list of the batch P1 .* damaged"):
        load_batch(place, "P1")
    write_plan(place, asked)
    assert load_batch(place, "P1")[0].case == asked.cases[0]


def test_the_name_of_a_batch_is_no_path(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"E-ID-01 "):
        load_batch(CohortPlace(tmp_path), "../../etc/passwd")
