"""Progress: what counts as done and running, how long it will take, and what is told."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.cohort import progress
from pipeline.cohort.model import CaseEnd
from pipeline.cohort.place import CohortPlace
from pipeline.cohort.progress import Progress, Reporter, Watcher, cohort_line, ended_line, ended_lines, progress_line
from pipeline.engine.lock import case_lock
from tests.cohort.cohort_sample import REFUSED, Batches, lost, planned, refused

IDS = ("P1", "P2", "P3", "P4", "P5", "P6")


class Clock:
    """Stands still until it is moved."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


class Cohort:
    """Six cases in two batches."""

    def __init__(self, root: Path, clock: Clock) -> None:
        self.place, self.plan = planned(root, IDS, buckets=2)
        assert len(self.plan.batches) == 2
        self.batches, self.clock = Batches(self.place, self.plan), clock

    def watcher(self) -> Watcher:
        return Watcher(self.place, self.plan, self.clock)


@pytest.fixture
def cohort(tmp_path: Path, clock: Clock) -> Cohort:
    return Cohort(tmp_path, clock)


def test_words_are_counted_and_each_end_is_told_once(cohort: Cohort) -> None:
    watcher = cohort.watcher()
    assert watcher.look() == Progress(6)
    crash = CaseEnd("P4", "ERROR", "E-BUG-01")
    cohort.batches.run(CaseEnd("P1", "PASS", seconds=9), CaseEnd("P2", "REVIEW"), refused("P3"), crash)
    cohort.clock.now += 5
    found = watcher.look()
    assert (found.total, found.done, found.elapsed_s) == (6, 4, 5.0)
    assert (found.passed, found.review, found.rejected, found.failed) == (1, 1, 1, 1)
    assert sorted(end.case_id for end in found.ended) == ["P1", "P2", "P3", "P4"]
    assert watcher.look() == replace(found, ended=())


def test_what_ended_before_is_done_and_not_told(cohort: Cohort) -> None:
    cohort.batches.run(CaseEnd("P1", "PASS"))
    assert cohort.watcher().look() == Progress(6, 1, 1)


def test_events_of_another_request_do_not_count(cohort: Cohort) -> None:
    watcher = cohort.watcher()
    cohort.batches.add("P1", cohort.batches.line("P1", "ended", end=CaseEnd("P1", "PASS"), key="0" * 16))
    cohort.batches.add("P1", cohort.batches.line("P1", "ended", end=CaseEnd("Q9", "PASS")).replace(b'"P1"', b'"Q9"'))
    assert watcher.look() == Progress(6)


def test_a_case_that_begins_again_is_no_longer_done(cohort: Cohort) -> None:
    watcher = cohort.watcher()
    cohort.batches.run(CaseEnd("P1", "PASS"))
    assert watcher.look().done == 1
    cohort.batches.start("P1")
    assert watcher.look().done == 0
    cohort.batches.end(CaseEnd("P1", "REVIEW"))
    assert watcher.look().review == 1


def test_a_fault_of_the_machine_is_told_and_is_no_result(cohort: Cohort) -> None:
    watcher = cohort.watcher()
    cohort.batches.run(lost("P1"))
    found = watcher.look()
    assert (found.done, found.failed, [end.case_id for end in found.ended]) == (0, 0, ["P1"])


def test_half_a_line_is_read_when_it_is_whole(cohort: Cohort) -> None:
    watcher = cohort.watcher()
    line = cohort.batches.line("P1", "ended", end=CaseEnd("P1", "PASS"))
    cohort.batches.add("P1", line[:40])
    assert watcher.look().done == 0
    cohort.batches.add("P1", line[40:])
    assert watcher.look().done == 1


def test_torn_and_foreign_lines_are_passed_over(cohort: Cohort) -> None:
    watcher = cohort.watcher()
    for data in (b'{"ts": "2031', b"\n[]\n", b"\xff\xfe\n", b'{"end": {"word": 1}}\n'):
        cohort.batches.add("P1", data)
    cohort.batches.run(CaseEnd("P1", "PASS"))
    assert watcher.look().done == 1


def test_a_ledger_that_was_replaced_is_read_from_its_start(cohort: Cohort) -> None:
    cohort.batches.run(refused("P1"))
    watcher = cohort.watcher()
    cohort.batches.ledger("P1").write_bytes(cohort.batches.line("P1", "ended", end=CaseEnd("P1", "PASS")))
    assert watcher.look().passed == 1


def test_only_new_bytes_are_read(cohort: Cohort, monkeypatch: pytest.MonkeyPatch) -> None:
    cohort.batches.run(*(CaseEnd(name, "PASS") for name in IDS))
    watcher = cohort.watcher()
    read: list[tuple[str, int]] = []
    original = progress._bytes_from

    def watched(path: Path, begin: int) -> bytes:
        read.append((path.name, begin))
        return original(path, begin)

    monkeypatch.setattr(progress, "_bytes_from", watched)
    watcher.look()
    assert read == []
    ledger = cohort.batches.ledger("P2")
    size = ledger.stat().st_size
    cohort.batches.start("P2")
    watcher.look()
    assert read == [(ledger.name, size)]


def test_ends_of_several_batches_are_told_in_their_order(cohort: Cohort) -> None:
    watcher = cohort.watcher()
    names = [ids[0] for ids in cohort.plan.batches.values()]
    for second, name in ((2, names[0]), (1, names[1])):
        line = cohort.batches.line(name, "ended", end=CaseEnd(name, "PASS"))
        cohort.batches.add(name, line.replace(b"04:05:06", b"04:05:0%d" % second))
    assert [end.case_id for end in watcher.look().ended] == names[::-1]


def test_running_is_what_began_and_holds_its_lock(cohort: Cohort) -> None:
    watcher = cohort.watcher()
    cohort.batches.start("P1")
    cohort.batches.start("P2")
    with case_lock(cohort.place.results / "P1"), case_lock(cohort.place.results / "P3"):
        assert watcher.look().running == ("P1",)
    assert watcher.look().running == ()


def test_the_word_of_another_machine_counts_unless_it_is_old(cohort: Cohort) -> None:
    cohort.batches.add("P1", cohort.batches.line("P1", "started", host="node-7"))
    watcher = cohort.watcher()
    cohort.batches.add("P2", cohort.batches.line("P2", "started", host="node-8"))
    assert watcher.look().running == ("P2",)
    cohort.batches.add("P1", cohort.batches.line("P1", "started", host="node-9"))
    assert watcher.look().running == ("P1", "P2")


def test_time_left_is_known_after_two_computed_cases(cohort: Cohort) -> None:
    watcher = cohort.watcher()
    cohort.batches.run(refused("P1", 1.0), CaseEnd("P2", "PASS", seconds=60.0))
    assert watcher.look().left_s is None
    cohort.batches.start("P4")
    with case_lock(cohort.place.results / "P4"):
        cohort.batches.run(CaseEnd("P3", "PASS", seconds=20.0))
        # three are left, one of them at work and half-way, 40 s each, one at a time
        assert watcher.look().left_s == pytest.approx(2.5 * 40.0)


def test_time_left_is_divided_by_the_cases_at_work(cohort: Cohort) -> None:
    watcher = cohort.watcher()
    cohort.batches.run(CaseEnd("P1", "PASS", seconds=30.0), CaseEnd("P2", "PASS", seconds=30.0))
    cohort.batches.start("P3")
    cohort.batches.start("P4")
    with case_lock(cohort.place.results / "P3"), case_lock(cohort.place.results / "P4"):
        assert watcher.look().left_s == pytest.approx((4 - 1) * 30.0 / 2)


def test_no_time_is_left_when_all_is_done(cohort: Cohort) -> None:
    watcher = cohort.watcher()
    cohort.batches.run(*(CaseEnd(name, "PASS", seconds=30.0) for name in IDS))
    assert watcher.look().left_s is None


def test_a_results_folder_without_ledgers_is_a_cohort_without_progress(cohort: Cohort) -> None:
    cohort.place.ledger("any").parent.rmdir()
    assert cohort.watcher().look() == Progress(6)


@pytest.mark.parametrize(
    ("shown", "line"),
    [
        (Progress(200), "0 of 200 done"),
        (
            Progress(200, 57, 50, 4, 2, 1, ("P058", "P061"), left_s=41 * 60.0),
            "57 of 200 done (50 PASS, 4 REVIEW, 3 failed), 2 running: P058 P061, about 41 min left",
        ),
        (Progress(9, 1, 1, running=tuple("abcdef")), "1 of 9 done (1 PASS), 6 running: a b c d and 2 more"),
        (Progress(9, left_s=0.2), "0 of 9 done, about 1 s left"),
        (Progress(9, left_s=7200.0), "0 of 9 done, about 2 h left"),
        (Progress(9, left_s=86400.0 * 3), "0 of 9 done, about 3 days left"),
    ],
)
def test_the_line_of_progress(shown: Progress, line: str) -> None:
    assert progress_line(shown) == line


def test_the_line_of_a_case() -> None:
    at = Progress(200, 57)
    assert ended_line(CaseEnd("P057", "PASS", seconds=23.4), at) == "[ 57/200] P057     PASS        23 s"
    assert ended_line(refused("P058"), at).splitlines() == [
        "[ 57/200] P058     REJECTED     1 s  E-SIDE-01  The side is not given.",
        "          Add side: right or side: left to case.yaml.",
    ]
    assert "(the machine was at fault; it is tried again)" in ended_line(lost("P058"), at)


def test_cases_are_numbered_in_their_order_and_faults_of_the_machine_are_not() -> None:
    ended = (CaseEnd("P1", "PASS"), lost("P2"), CaseEnd("P3", "PASS"))
    numbers = [re.search(r"\d+", text) for text in ended_lines(Progress(9, 5, ended=ended))]
    assert [found.group() for found in numbers if found] == ["4", "4", "5"]


def test_nothing_steers_the_terminal() -> None:
    nasty = CaseEnd("P1", "ERROR", "E-X-01\x1b[2J", "a\nb\r\x07", "c\x9b31m\nd")
    lines = ended_line(nasty, Progress(1, 1)).splitlines()
    assert len(lines) == 2
    assert all(line.isprintable() for line in lines)
    assert progress_line(Progress(1, running=("P\x1b1",))).isprintable()


def reporter(cohort: Cohort, said: list[str], *, terminal: bool) -> Reporter:
    return Reporter(cohort.place, cohort.plan, said.append, terminal=terminal, clock=cohort.clock)


def test_plain_lines_are_one_a_case_and_one_a_minute(cohort: Cohort) -> None:
    said: list[str] = []
    plain = reporter(cohort, said, terminal=False)
    plain.tick()
    for number, name in enumerate(IDS[:4], 1):
        cohort.batches.run(CaseEnd(name, "PASS", seconds=1.0))
        cohort.clock.now += 20.0
        plain.tick()
        assert said[number if number < 4 else -1].startswith((f"[{number}/6] {name}", "4 of 6"))
    cohort.batches.run(refused("P5"))
    plain.close()
    assert [line.partition(" ")[0] for line in said] == ["0", "[1/6]", "[2/6]", "[3/6]", "3", "[4/6]", "[5/6]", "5"]
    assert all(line.endswith("\n") and "\x1b" not in line for line in said)
    assert REFUSED[2] in said[-2]


def test_a_terminal_has_one_line_and_the_failures_above(cohort: Cohort, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "12")
    said: list[str] = []
    drawn = reporter(cohort, said, terminal=True)
    drawn.tick()
    first, second, *_ = max(cohort.plan.batches.values(), key=len)
    cohort.batches.run(CaseEnd(first, "PASS"), refused(second))
    cohort.clock.now += 2.0
    drawn.tick()
    drawn.close()
    wipe = "\r\x1b[2K"
    assert [text.removeprefix(wipe).partition("  ")[0] for text in said] == [
        "0 of 6 done",
        f"[2/6] {second}",
        "2 of 6 done",
        "2 of 6 done (1 PASS, 1 failed)\n",
    ]
    assert all(text.startswith(wipe) for text in said)


def test_looking_takes_no_more_than_its_share(cohort: Cohort, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    plain = reporter(cohort, said, terminal=False)
    looks: list[float] = []
    look = Watcher.look

    def slow(watcher: Watcher) -> Progress:
        looks.append(cohort.clock.now)
        cohort.clock.now += 2.0
        return look(watcher)

    monkeypatch.setattr(Watcher, "look", slow)
    for _ in range(100):
        plain.tick()
        cohort.clock.now += 1.0
    assert looks == [100.0, 142.0, 184.0]


def test_status_tells_how_far_a_cohort_is(tmp_path: Path) -> None:
    assert cohort_line(CohortPlace(tmp_path / "results")) is None
    place, plan = planned(tmp_path, ["P1", "P2", "P3"])
    Batches(place, plan).run(refused("P1"))
    assert cohort_line(place) == "cohort: 1 of 3 done (1 failed)"
