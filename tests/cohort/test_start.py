"""From an order to a cohort at work: what is planned, remembered, followed; the engine is played."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline import config
from pipeline.cohort import start
from pipeline.cohort.batches import load_batch, load_plan
from pipeline.cohort.driver import Engine, EngineEnd
from pipeline.cohort.key import plan_key
from pipeline.cohort.model import CaseEnd, CaseLimits, CohortRequest
from pipeline.cohort.place import CohortPlace
from pipeline.cohort.start import Order, Screen, last_order, plan_cohort, run_cohort
from pipeline.engine.store import make_folder
from pipeline.errors import ConfigError, EnvironmentFault, ExitCode
from tests.cohort.cohort_sample import Batches, lost, refused
from tests.toy_flow import TOY_FLOW, write_toy_configs

Play = Callable[[list[CaseEnd], EngineEnd], None]
DONE = EngineEnd(ok=True, said="")


@pytest.fixture
def order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Order:
    """Three cases."""
    monkeypatch.setattr(config, "CONFIGS", write_toy_configs(tmp_path / "configs"))
    for name in ("P1", "P2", "P3"):
        (tmp_path / "cases" / name).mkdir(parents=True)
    return Order(CohortRequest(str(tmp_path / "cases"), "clinical", limits=CaseLimits(2000, 600.0)))


@pytest.fixture
def place(tmp_path: Path) -> CohortPlace:
    return CohortPlace(tmp_path / "results")


@pytest.fixture
def play(place: CohortPlace, monkeypatch: pytest.MonkeyPatch) -> Play:
    """Plays an engine whose batches end so."""
    monkeypatch.setattr(start, "find_engine", lambda profile, at_once: Engine(profile, at_once, Path("snakemake")))

    def prepare(ends: list[CaseEnd], end: EngineEnd) -> None:
        def run_engine(there: CohortPlace, engine: Engine, tick: Callable[[], None]) -> EngineEnd:
            make_folder(there.ledger("any").parent)
            Batches(there, load_plan(there)).run(*ends)
            tick()
            return end

        monkeypatch.setattr(start, "run_engine", run_engine)

    return prepare


def test_an_order_is_remembered_word_for_word(order: Order, place: CohortPlace) -> None:
    full = replace(order, at_once=3, batch_size=7, profile="slurm", program="apptainer exec x.sif ct2lut")
    plan_cohort(full, place, TOY_FLOW)
    assert last_order(place) == full


@pytest.mark.parametrize("content", [None, "{}", "no json"])
def test_nothing_to_go_on_with(place: CohortPlace, content: str | None) -> None:
    if content is not None:
        make_folder(place.files)
        (place.files / "order.json").write_text(content)
    with pytest.raises(ConfigError, match="E-COH-02 No cohort was begun"):
        last_order(place)


def test_a_wrong_setting_is_refused_before_anything_is_planned(order: Order, place: CohortPlace) -> None:
    wrong = replace(order, request=replace(order.request, overrides=("qa.wrod=fine",)))
    with pytest.raises(ConfigError, match="E-CFG-01"):
        plan_cohort(wrong, place, TOY_FLOW)
    assert not place.plan.exists()


def test_the_key_changes_with_what_decides_results_and_with_nothing_else(order: Order) -> None:
    request = order.request
    key = plan_key(request, TOY_FLOW)
    assert plan_key(replace(request, cases="elsewhere", jobs=7, buckets=3), TOY_FLOW) == key
    assert plan_key(replace(request, overrides=("qa.word=other",)), TOY_FLOW) != key
    assert plan_key(replace(request, limits=CaseLimits(1000, 600.0)), TOY_FLOW) != key
    assert plan_key(request, TOY_FLOW[:1]) != key


def test_many_cases_share_batches_and_a_longer_list_keeps_them(
    order: Order, place: CohortPlace, tmp_path: Path
) -> None:
    for number in range(40):
        (tmp_path / "cases" / f"Q{number}").mkdir()
    first = plan_cohort(replace(order, batch_size=10), place, TOY_FLOW)
    (tmp_path / "cases" / "R1").mkdir()
    second = plan_cohort(replace(order, batch_size=10), place, TOY_FLOW)
    assert first.request.buckets == second.request.buckets == 5
    changed = [name for name, ids in second.batches.items() if first.batches.get(name) != ids]
    assert len(changed) == 1
    assert "R1" in second.batches[changed[0]]


def test_the_end_of_a_cohort(order: Order, place: CohortPlace, play: Play) -> None:
    play([refused("P1"), refused("P2"), refused("P3")], DONE)
    shown: list[str] = []
    summary = run_cohort(order, place, TOY_FLOW, Screen(shown.append, terminal=False))
    assert summary.exit_code == ExitCode.REJECTED
    text = "".join(shown)
    assert "[3/3] P" in text
    assert text.endswith("3 of 3 done (3 failed)\n")
    assert place.summary.read_text(encoding="utf-8-sig").count("E-SIDE-01") == 3


def test_cases_that_the_machine_kept_from_a_result(order: Order, place: CohortPlace, play: Play) -> None:
    play([refused("P1"), lost("P2"), refused("P3")], EngineEnd(ok=False, said="Batch P2 failed."))
    shown: list[str] = []
    summary = run_cohort(order, place, TOY_FLOW, Screen(shown.append, terminal=False))
    assert (summary.exit_code, summary.unfinished) == (ExitCode.ENVIRONMENT, 1)
    assert shown[-1] == "The workflow engine left cases without a result: Batch P2 failed.\n"


def test_an_engine_that_fails_by_itself_is_told(order: Order, place: CohortPlace, play: Play) -> None:
    play([refused(name) for name in ("P1", "P2", "P3")], EngineEnd(ok=False, said="The summary failed."))
    with pytest.raises(EnvironmentFault, match=r"E-COH-01 The workflow engine failed: The summary failed\."):
        run_cohort(order, place, TOY_FLOW, Screen(lambda _: None, terminal=False))


def test_failed_cases_are_tried_again_when_asked(order: Order, place: CohortPlace, play: Play) -> None:
    play([refused("P1")], DONE)
    run_cohort(order, place, TOY_FLOW, Screen(lambda _: None, terminal=False))
    plan_cohort(order, place, TOY_FLOW)
    assert [load_batch(place, name)[0].tries for name in ("P1", "P2")] == [1, 1]
    plan_cohort(order, place, TOY_FLOW, retry_failed=True)
    assert [load_batch(place, name)[0].tries for name in ("P1", "P2")] == [2, 1]


def test_a_driver_at_work_is_followed_before_anything_is_planned(
    order: Order, place: CohortPlace, play: Play, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    play([refused(name) for name in ("P1", "P2", "P3")], DONE)
    plan_cohort(order, place, TOY_FLOW)
    (tmp_path / "cases" / "P4").mkdir()
    known: list[int] = []
    monkeypatch.setattr(start, "is_driven", lambda _: True)
    monkeypatch.setattr(start, "wait_for_driver", lambda there, tick: known.append(len(load_plan(there).batches)))
    shown: list[str] = []
    run_cohort(order, place, TOY_FLOW, Screen(shown.append, terminal=False))
    assert known == [3]
    assert len(load_plan(place).batches) == 4
    assert shown[0].startswith("The cohort is at work already.")
