"""A batch: what is a result, what is tried again, when it stops early; the processes of its cases are played."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.cohort import batch as under_test
from pipeline.cohort.batch import BACK_OFF_S, Batch, run_batch
from pipeline.cohort.batches import PlanInputs, load_batch, write_plan
from pipeline.cohort.case_process import CaseWork
from pipeline.cohort.ledger import Event, event_key, events
from pipeline.cohort.model import CaseEnd, CohortRequest, ListedCase
from pipeline.cohort.place import CohortPlace
from pipeline.engine.lock import hold
from pipeline.errors import ConfigError, EnvironmentFault

IDS = ("P1", "P2", "P3", "P4", "P5")
NAME = "bucket-0000"
PASS = CaseEnd("", "PASS")
REFUSED = CaseEnd("", "REJECTED", "E-SIDE-01", "The side is not given.", "Add it.")
FULL = CaseEnd("", "ERROR", "E-ENV-01", "The disk is full.", "Free space.", transient=True)
Play = Callable[[dict[str, CaseEnd]], list[str]]


@pytest.fixture
def place(tmp_path: Path) -> CohortPlace:
    """A cohort of five cases in one batch."""
    cases = tuple(ListedCase(name, tmp_path / "cases" / name) for name in IDS)
    for case in cases:
        case.folder.mkdir(parents=True)
    found = CohortPlace(tmp_path / "results")
    request = CohortRequest(str(tmp_path / "cases"), "demo", buckets=1)
    write_plan(found, PlanInputs(request, "key", cases, "ct2lut"))
    return found


@pytest.fixture
def play(monkeypatch: pytest.MonkeyPatch) -> Play:
    """Lets cases end as told, PASS by default; gives the list of those that were run, which grows."""

    def prepare(ends: dict[str, CaseEnd]) -> list[str]:
        ran: list[str] = []

        def run_case(case: ListedCase, work: CaseWork) -> CaseEnd:
            ran.append(case.case_id)
            told = ends.get(case.case_id, PASS)
            return CaseEnd(case.case_id, told.word, told.code, told.problem, told.action, 1.0, 10.0, told.transient)

        monkeypatch.setattr(under_test, "run_case", run_case)
        return ran

    return prepare


def history(place: CohortPlace) -> list[Event]:
    return list(events(place.ledger(NAME).read_bytes()))


def test_a_refused_case_is_a_result(place: CohortPlace, play: Play) -> None:
    ran = play({"P2": REFUSED})
    ends = run_batch(Batch(place, NAME, ("ct2lut",)))
    assert [(end.case_id, end.word) for end in ends] == [(name, "REJECTED" if name == "P2" else "PASS") for name in IDS]
    assert ran == list(IDS)
    assert place.done(NAME).read_text().splitlines()[:3] == ["id,word,code", "P1,PASS,", "P2,REJECTED,E-SIDE-01"]


def test_the_ledger_says_what_began_and_how_it_ended(place: CohortPlace, play: Play) -> None:
    play({"P2": REFUSED})
    run_batch(Batch(place, NAME, ("ct2lut",)))
    told = history(place)
    assert [(event.id, event.what) for event in told[:4]] == [
        ("P1", "started"),
        ("P1", "ended"),
        ("P2", "started"),
        ("P2", "ended"),
    ]
    listed = {one.case.case_id: one for one in load_batch(place, NAME)}
    assert all(event.key == event_key("key", listed[event.id].signature, 1) for event in told)
    assert told[3].end == CaseEnd("P2", "REJECTED", "E-SIDE-01", REFUSED.problem, "Add it.", 1.0, 10.0)


def test_a_fault_of_the_machine_is_no_result(place: CohortPlace, play: Play) -> None:
    ran = play({"P2": FULL})
    with pytest.raises(EnvironmentFault, match=r"E-BAT-02 No result yet of P2: E-ENV-01  The disk is full\."):
        run_batch(Batch(place, NAME, ("ct2lut",)))
    assert ran == list(IDS)
    assert not place.done(NAME).exists()


@pytest.mark.fault("S06")
def test_three_equal_faults_stop_the_batch(place: CohortPlace, play: Play) -> None:
    ran = play({"P2": FULL, "P3": FULL, "P4": FULL})
    with pytest.raises(EnvironmentFault, match="No result yet of P2, P3, P4"):
        run_batch(Batch(place, NAME, ("ct2lut",)))
    assert ran == ["P1", "P2", "P3", "P4"]


def test_faults_of_different_kinds_do_not(place: CohortPlace, play: Play) -> None:
    other = CaseEnd("", "ERROR", "E-JOB-03", "It was killed.", "Run it again.", transient=True)
    ran = play({"P2": FULL, "P3": other, "P4": FULL})
    with pytest.raises(EnvironmentFault, match="No result yet of P2, P3, P4"):
        run_batch(Batch(place, NAME, ("ct2lut",)))
    assert ran == list(IDS)


@pytest.mark.fault("S06")
def test_nothing_is_begun_on_a_full_disk(place: CohortPlace, play: Play, monkeypatch: pytest.MonkeyPatch) -> None:
    ran = play({})
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=499_000_000))
    with pytest.raises(EnvironmentFault, match=r"E-BAT-01 The results disk has 499 MB left"):
        run_batch(Batch(place, NAME, ("ct2lut",)))
    assert ran == []


@pytest.mark.parametrize(
    ("attempt", "pause"), [(1, []), (2, [BACK_OFF_S[0]]), (3, [BACK_OFF_S[1]]), (9, [BACK_OFF_S[1]])]
)
def test_a_later_attempt_waits_first(place: CohortPlace, play: Play, attempt: int, pause: list[float]) -> None:
    play({})
    waited: list[float] = []
    run_batch(Batch(place, NAME, ("ct2lut",), attempt, waited.append))
    assert waited == pause
    assert {event.attempt for event in history(place)} == {attempt}


@pytest.mark.fault("S09")
def test_a_second_run_of_a_batch_waits_for_the_first(place: CohortPlace, play: Play) -> None:
    ran = play({})
    lock = place.batch_lock(NAME)
    lock.parent.mkdir(parents=True, exist_ok=True)
    second = threading.Thread(target=run_batch, args=(Batch(place, NAME, ("ct2lut",)),))
    with hold(lock):
        second.start()
        second.join(0.3)
        waiting, before = second.is_alive(), list(ran)
    second.join(10)
    assert (waiting, before) == (True, [])
    assert ran == list(IDS)
    assert place.done(NAME).exists()


def test_a_batch_whose_list_changed_meanwhile_is_not_done(
    place: CohortPlace, play: Play, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when it outlived its engine, and the same command was given again with one case more."""
    play({})
    lists = iter([load_batch(place, NAME), load_batch(place, NAME)[:-1]])
    monkeypatch.setattr(under_test, "load_batch", lambda *_: next(lists))
    with pytest.raises(EnvironmentFault, match="E-BAT-03 The list of bucket-0000 changed"):
        run_batch(Batch(place, NAME, ("ct2lut",)))
    assert not place.done(NAME).exists()


def test_what_a_killed_run_left_of_its_result_goes_and_nothing_of_others(place: CohortPlace, play: Play) -> None:
    play({})
    done = place.done(NAME)
    left, other = (done.with_name(f".{name}.partial-{'0' * 32}") for name in (done.name, "bucket-0001.csv"))
    done.parent.mkdir(parents=True, exist_ok=True)
    left.touch()
    other.touch()
    run_batch(Batch(place, NAME, ("ct2lut",)))
    assert sorted(path.name for path in done.parent.iterdir()) == sorted([done.name, other.name])


def test_a_batch_that_is_not_there(place: CohortPlace, play: Play) -> None:
    play({})
    with pytest.raises(ConfigError, match="E-PLN"):
        run_batch(Batch(place, "bucket-0007", ("ct2lut",)))
