"""Cohorts on a real SLURM: submitted, retried, requeued, cancelled, resumed; each case is done once."""

from __future__ import annotations

import csv
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.cohort.place import CohortPlace
from tests.cluster import slurm
from tests.cluster.conftest import LayOut
from tests.cluster.slurm import NODES, Cluster, cluster
from tests.cluster.stub_cohort import BATCHES, CASES, CHECKOUT, MEMORY_MB, STUB, Behaviour, until
from tests.cohort.checks import problems_of
from tests.cohort.cohort_cases import CohortCases
from tests.cohort.real import FAST

WHY_NOT = slurm.obstacle()
pytestmark = pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))

SHIPPED = CHECKOUT / "pipeline" / "workflows" / "profiles" / "slurm" / "config.yaml"
GUIDE = CHECKOUT / "docs" / "cluster.md"
REJECTED = 10
ONCE = {case: ["PASS"] for case in CASES}


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    with cluster(tmp_path_factory.mktemp("slurm")) as made:
        yield made


@pytest.fixture
def site(machine: Cluster) -> Iterator[Cluster]:
    """The cluster as another test found it: with its nodes, and no job."""
    yield machine
    machine.mend()
    machine.forget()


@pytest.fixture
def profile(tmp_path: Path) -> str:
    """The profile of a site that is in a hurry, made as the guide says: a copy with lines of its own."""
    text = SHIPPED.read_text()
    hurried = re.sub(
        r"(?m)^(slurm-init-seconds-before-status-checks|seconds-between-status-checks): 20$", r"\1: 1", text
    )
    assert hurried.count(": 1\n") == 2
    (tmp_path / "profile").mkdir()
    (tmp_path / "profile" / "config.yaml").write_text(f"{hurried}default-resources: [slurm_partition=knees]\n")
    return str(tmp_path / "profile")


def test_the_profile_as_it_is(site: Cluster, lay_out: LayOut) -> None:
    before = set(site.jobs())
    cohort = lay_out(Behaviour())
    cohort.finish("slurm")
    assert cohort.words() == ONCE
    own = {job: state for job, state in site.jobs().items() if job not in before}
    assert sorted(own.values()) == ["COMPLETED"] * len(BATCHES)
    assert {job for batch in BATCHES for _, job in cohort.attempts(batch)} == set(own)
    assert {site.partition(job) for job in own} == {"main"}
    assert {site.node(job) for job in own} == set(NODES)
    assert not list(cohort.place.workflow.glob("slurm-*.out"))


def test_a_refusal_is_a_result_and_a_fault_of_the_machine_is_tried_again(
    site: Cluster, profile: str, lay_out: LayOut
) -> None:
    cohort = lay_out(Behaviour(refused=("K003",), faulty=("b2",)))
    cohort.finish(profile)
    assert cohort.words() == {**ONCE, "K003": ["REJECTED"]}
    (first, failed), (second, mended) = cohort.attempts("b2")
    assert (first, second) == (1, 2)
    assert (site.jobs()[failed], site.jobs()[mended]) == ("FAILED", "COMPLETED")
    assert (site.memory_mb(failed), site.memory_mb(mended)) == (MEMORY_MB, 2 * MEMORY_MB)
    assert [cohort.attempts(batch)[0][0] for batch in BATCHES] == [1] * len(BATCHES)
    assert {len(cohort.attempts(batch)) for batch in BATCHES if batch != "b2"} == {1}
    assert site.partition(mended) == "knees"


def test_a_node_that_is_lost(site: Cluster, profile: str, lay_out: LayOut) -> None:
    """SLURM itself starts its jobs on another one, under the same numbers; the engine only waits."""
    cohort = lay_out(Behaviour(seconds=2.0))
    driver = cohort.drive(profile)
    cohort.until_some_are_done()
    on = {batch: site.node(cohort.attempts(batch)[0][1]) for batch in cohort.running()}
    lost = next(iter(on.values()))
    done = cohort.words()
    site.lose_node(lost)
    assert len(done) <= len(cohort.words()) < len(CASES)
    cohort.wait(driver)
    assert cohort.words() == ONCE
    for batch, node in on.items():
        attempts = cohort.attempts(batch)
        assert len(set(attempts)) == 1, attempts
        again = int(node == lost)
        assert (len(attempts), site.starts(attempts[0][1])) == (1 + again, again)
        assert site.node(attempts[0][1]) != lost


def test_all_nodes_are_lost_and_come_back(site: Cluster, profile: str, lay_out: LayOut) -> None:
    cohort = lay_out(Behaviour(seconds=2.0))
    driver = cohort.drive(profile)
    cohort.until_some_are_done()
    for node in NODES:
        site.lose_node(node)
    left = cohort.words()
    assert len(left) < len(CASES)
    site.mend()
    cohort.wait(driver)
    assert cohort.words() == ONCE


def test_a_daemon_that_dies_and_comes_back_in_time_costs_nothing(site: Cluster, profile: str, lay_out: LayOut) -> None:
    cohort = lay_out(Behaviour(seconds=1.0))
    driver = cohort.drive(profile)
    cohort.until_some_are_done()
    for node in NODES:
        site.kill_node_daemon(node)
        site.start_node(node)
    cohort.wait(driver)
    assert cohort.words() == ONCE
    assert [len(cohort.attempts(batch)) for batch in BATCHES] == [1] * len(BATCHES)


def test_a_driver_that_is_killed(site: Cluster, profile: str, lay_out: LayOut) -> None:
    """Its jobs go on; the same command submits the batches again, and these wait for the first ones."""
    cohort = lay_out(Behaviour(seconds=1.0))
    driver = cohort.drive(profile)
    cohort.until_some_are_done()
    left = cohort.running()
    cohort.kill_driver(driver)
    assert any(site.jobs()[cohort.attempts(batch)[0][1]] == "RUNNING" for batch in left)
    cohort.finish(profile)
    assert cohort.words() == ONCE


def test_a_job_that_somebody_cancels(site: Cluster, profile: str, lay_out: LayOut) -> None:
    cohort = lay_out(Behaviour(seconds=1.0))
    driver = cohort.drive(profile)
    cohort.until_some_are_done()
    batch = cohort.running()[0]
    (_, job), *_ = cohort.attempts(batch)
    site.cancel(job)
    cohort.wait(driver)
    assert cohort.words() == ONCE
    assert site.jobs()[job] == "CANCELLED"
    assert [number for number, _ in cohort.attempts(batch)] == [1, 2]


def test_ctrl_c_cancels_the_jobs(site: Cluster, profile: str, lay_out: LayOut) -> None:
    cohort = lay_out(Behaviour(seconds=1.0))
    driver = cohort.drive(profile)
    cohort.until_some_are_done()
    driver.send_signal(signal.SIGINT)
    assert driver.wait(90) == 130
    until(lambda: not site.waiting(), "no job is left")
    assert len(cohort.words()) < len(CASES)
    cohort.finish(profile)
    assert cohort.words() == ONCE


def test_the_array_of_the_guide(
    site: Cluster, lay_out: LayOut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the workflow engine, word for word as in docs/cluster.md; only the planning is the stub's."""
    cohort = lay_out(Behaviour(refused=("K003",)))
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "ct2lut").write_text(f'#!/bin/sh\nexec {shlex.join([sys.executable, "-I", "-S", str(STUB)])} "$@"\n')
    (programs / "ct2lut").chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    monkeypatch.setenv("RESULTS", str(cohort.place.results))
    script, commands = re.findall(r"<!-- tried -->\n\n((?:(?:    .*)?\n)+)", GUIDE.read_text())
    (tmp_path / "batch.sh").write_text(re.sub(r"(?m)^    ", "", script))
    typed = re.sub(r"(?m)^    ", "", commands)
    done = subprocess.run(["/bin/sh", "-eu"], input=typed, cwd=tmp_path, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    until(lambda: not site.waiting(), "no job is left")
    assert cohort.words() == {**ONCE, "K003": ["REJECTED"]}
    with cohort.place.summary.open(newline="") as file:
        assert [row[0] for row in csv.reader(file)] == list(CASES)


def test_twenty_knees(site: Cluster, profile: str, tmp_path: Path) -> None:
    """The program itself, 18 phantom knees and two broken ones; the second time nothing is left to do."""
    cases, results = CohortCases(20, 2), tmp_path / "results"
    cases.write(tmp_path / "cases", processes=1)
    places = ("--cases", str(tmp_path / "cases"), "--results", str(results))
    settings = tuple(word for one in FAST for word in ("--set", one))
    command = ("cohort", *places, "--protocol", "demo", "--batch-size", "4", "--profile", profile, *settings)
    before = site.jobs()
    code, said = _ct2lut(*command)
    assert code == REJECTED, said
    after = site.jobs()
    own = {job: state for job, state in after.items() if job not in before}
    assert len(own) == len(list((results / "cohort.files" / "workflow" / "batches").iterdir()))
    assert set(own.values()) == {"COMPLETED"}, said
    assert {site.node(job) for job in own} == set(NODES)
    assert problems_of(CohortPlace(results), cases, code) == []
    assert _ct2lut(*command)[0] == REJECTED
    assert site.jobs() == after


def _ct2lut(*words: str) -> tuple[int, str]:
    """Exit code of the program, and what it says."""
    program = str(Path(sys.executable).with_name("ct2lut"))
    done = subprocess.run(
        [program, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False, timeout=3000
    )
    return done.returncode, done.stdout
