"""A real cohort of phantoms, killed on the way and resumed by the same command: ``python -m tests.cohort.real``."""

from __future__ import annotations

import argparse
import os
import secrets
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.cohort.place import CohortPlace
from tests.cohort.checks import problems_of
from tests.cohort.cohort_cases import CohortCases
from tests.cohort.figures import CaseSpan, Span, case_spans, ended_ids, repeats, working_ids
from tests.cohort.marked_processes import VARIABLE, engines, kill, kill_all, outlived, standing_still

#: As for patients, with fewer attitudes, triangles and frames of the film, and with meshes judged as coarse voxels
#: allow: all stages, a whole report and a whole package in about 20 CPU seconds.
FAST = (
    "sweep.flexion_step_deg=10.0",
    "contact.triangles=15000",
    "mesh.volume_tolerance_fraction=0.08",
    "qa.limits.max_volume_error_percent=8.0",
    "qa.pictures.motion_poses=3",
    "qa.pictures.flexions_deg=[0,60,120]",
    "qa.pictures.panel_px=200",
)
#: For the tests of every day: half of that again.
FASTER = (
    *FAST,
    "contact.triangles=8000",
    "mesh.triangles=3000",
    "mesh.triangles_of={femur: 6000, tibia: 6000}",
    "sweep.flexion_max_deg=30.0",
    "sweep.varus_min_deg=-2.0",
    "sweep.varus_max_deg=2.0",
    "sweep.varus_step_deg=2.0",
    "sweep.scan_shift_mm=1.0",
    "qa.pictures.flexions_deg=[0,30]",
)
#: Shares of the cases that have a result when each kill falls.
MOMENTS = (0.20, 0.45, 0.70)
SLOTS = 2
LOOK_S = 0.2


@dataclass(frozen=True)
class Order:
    """What to try.

    Attributes
    ----------
    cases : CohortCases
    kills : int
        How often to kill on the way, 0 to 3.
    work : Path
        ``cases`` and ``results`` are made in it; the results are not there yet.
    settings : tuple of str
        ``stage.key=value``.
    first_kill : int
        Which of the ways to kill comes first.
    limit_s : float
        The command hangs when one call of it takes longer.
    """

    cases: CohortCases
    kills: int
    work: Path
    settings: tuple[str, ...] = FAST
    first_kill: int = 0
    limit_s: float = 4 * 3600.0

    @property
    def place(self) -> CohortPlace:
        return CohortPlace(self.work / "results")

    @property
    def command(self) -> list[str]:
        """What is typed each time."""
        program = str(Path(sys.executable).with_name("ct2lut"))
        places = ["--cases", str(self.work / "cases"), "--results", str(self.place.results)]
        settings = [word for one in self.settings for word in ("--set", one)]
        return [program, "cohort", *places, "--protocol", "demo", "--jobs", "1", "--at-once", str(SLOTS), *settings]


def _not_at_all(_: Trial, __: int) -> bool:
    return False


@dataclass
class Trial:
    """A cohort on its way."""

    order: Order
    mark: str = field(default_factory=lambda: secrets.token_hex(8))
    calls: list[Span] = field(default_factory=list)
    all_killed: list[float] = field(default_factory=list)
    code: int | None = None
    said: str = ""
    outlived: tuple[str, ...] = ()

    def call(self, share: float = 1.0, how: Callable[[Trial, int], bool] = _not_at_all) -> None:
        """Type the command and wait for its end, or kill it once this share of the cases has a result."""
        begin = time.time()
        with (self.order.work / "said.txt").open("w+") as said, self._started(said.fileno()) as process:
            while process.poll() is None and not (self._done() >= share and how(self, process.pid)):
                time.sleep(LOOK_S)
                if time.time() > begin + self.order.limit_s:
                    raise TimeoutError(f"the command has not ended after {self.order.limit_s:.0f} s")
            self.code = process.wait()
            said.seek(0)
            self.said = said.read()
        self.calls.append(Span(begin, time.time()))

    def _done(self) -> float:
        return len(ended_ids(self.order.place)) / self.order.cases.count

    @contextmanager
    def _started(self, said: int) -> Iterator[subprocess.Popen[bytes]]:
        environment = {**os.environ, VARIABLE: self.mark}
        process = subprocess.Popen(
            self.order.command, env=environment, stdout=said, stderr=said, process_group=0, cwd=self.order.work
        )
        try:
            yield process
        finally:
            with suppress(ProcessLookupError):
                process.kill()
            process.wait()


def _wrapper(_: Trial, pid: int) -> bool:
    kill(pid)
    return True


def _wrapper_and_engine(trial: Trial, pid: int) -> bool:
    found = engines(trial.mark)
    if not found:
        raise RuntimeError("the workflow engine was not found among the processes")
    kill(pid, *found)
    return True


def _everything(trial: Trial, _: int) -> bool:
    """Only while a case is at work: between two of them a kill would try nothing."""
    with standing_still(trial.mark):
        if not working_ids(trial.order.place):
            return False
        kill_all(trial.mark)
    trial.all_killed.append(time.time())
    return True


KILLS: tuple[tuple[str, Callable[[Trial, int], bool]], ...] = (
    ("the command alone", _wrapper),
    ("the command and the engine", _wrapper_and_engine),
    ("every process", _everything),
)


def run(order: Order) -> Trial:
    """Make the cases, run the cohort, kill it on the way; nothing of it lives afterwards.

    Raises
    ------
    FileExistsError
        When there are results already.
    """
    order.place.results.mkdir(parents=True)
    order.cases.write(order.work / "cases")
    trial = Trial(order)
    try:
        for number in range(order.kills):
            name, how = KILLS[(order.first_kill + number) % len(KILLS)]
            trial.call(MOMENTS[number], how)
            if trial.code != -9:
                raise RuntimeError(f"{name}: the command ended with {trial.code} before it was killed\n{trial.said}")
        trial.call()
        trial.outlived = outlived(trial.mark)
        return trial
    finally:
        trial.all_killed.append(time.time())
        kill_all(trial.mark)


def overhead_percent(trial: Trial, calls: Sequence[Span]) -> float:
    """Part of the time of all slots, while the command was at work, in which no case was: percent."""
    spans = case_spans(trial.order.place, trial.all_killed)
    busy = sum(one.span.overlap(call) for one in spans for call in calls)
    return 100.0 * (1.0 - busy / (SLOTS * sum(call.seconds for call in calls)))


def figures(trial: Trial) -> Iterator[str]:
    """What was measured, a line each."""
    place, cases = trial.order.place, trial.order.cases
    spans = case_spans(place, trial.all_killed)
    told = repeats(place.results, cases.ids)
    again = [one for one in spans if one.known]
    lost = [one for one in spans if one.killed]
    yield f"cases {cases.count}, of them broken {cases.broken}; times killed {trial.order.kills}"
    yield f"wall time {sum(call.seconds for call in trial.calls):.0f} s in {len(trial.calls)} calls"
    yield f"time of the cases' own processes {sum(one.span.seconds for one in spans):.0f} s"
    yield f"overhead {overhead_percent(trial, trial.calls):.1f} % of {SLOTS} slots; " + ", ".join(
        f"call {number} ({call.seconds:.0f} s) {overhead_percent(trial, [call]):.1f} %"
        for number, call in enumerate(trial.calls, 1)
    )
    last = trial.calls[-1]
    inside = [one.span for one in spans if one.span.overlap(last)]
    if inside:
        yield (
            f"last call: {min(one.begin for one in inside) - last.begin:.1f} s before its first case, "
            f"{last.end - max(one.end for one in inside):.1f} s after its last"
        )
    yield f"processes of cases {len(spans)}; found finished {len(again)} in {_seconds(again)}; killed {len(lost)}"
    yield f"stages computed {told.computed}; computed twice {len(told.computed_twice)}"
    yield f"stages that were killed and begun again {len(told.begun_twice)}: {', '.join(told.begun_twice) or 'none'}"
    yield f"refusals told again {len(told.refused_twice)}"


def _seconds(spans: Sequence[CaseSpan]) -> str:
    return f"{sum(one.span.seconds for one in spans):.1f} s"


def _say(*lines: str) -> None:
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stdout.flush()


def main(arguments: Sequence[str] | None = None) -> int:
    """Try it, print figures and problems; 1 when something is not as it must be."""
    parser = argparse.ArgumentParser(prog="python -m tests.cohort.real", description=__doc__)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--broken", type=int, default=20)
    parser.add_argument("--kills", type=int, default=3, choices=range(len(KILLS) + 1))
    parser.add_argument("--work", type=Path, required=True, help="a folder without results")
    parser.add_argument("--most-overhead", type=float, default=100.0, help="percent")
    parser.add_argument("--faster", action="store_true", help="fewer attitudes still: to try this module itself")
    given = parser.parse_args(arguments)
    settings = FASTER if given.faster else FAST
    order = Order(CohortCases(given.cases, given.broken), given.kills, given.work.resolve(), settings)
    trial = run(order)
    _say(trial.said, *figures(trial))
    problems = problems_of(order.place, order.cases, trial.code)
    problems += [f"outlived the command: {words}" for words in trial.outlived]
    if (share := overhead_percent(trial, trial.calls)) > given.most_overhead:
        problems.append(f"overhead {share:.1f} %, expected at most {given.most_overhead:g} %")
    _say(*(problems or ["everything is as it must be"]))
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
