"""The profiles of clusters: their keys; that of other clusters with a queue of a few lines."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.cluster import local_queue
from tests.cluster.conftest import LayOut
from tests.cluster.slurm import WANTED
from tests.cluster.stub_cohort import BATCHES, CASES, CHECKOUT, MEMORY_MB, MINUTES, Behaviour

PROFILES = CHECKOUT / "pipeline" / "workflows" / "profiles"
ENGINE = CHECKOUT / ".venv-cohort" / "bin" / "snakemake"
pytestmark = pytest.mark.skipif(not ENGINE.exists(), reason="the engine is not installed (make setup-cohort)")


EXECUTORS = {"slurm": "slurm", "generic": "cluster-generic", "kubernetes": "kubernetes"}
with_cluster = pytest.mark.skipif(not os.environ.get(WANTED), reason="it takes minutes: type make test-cluster")
#: Prints one JSON object a profile: the options that it comes to.
PARSE = """
import json, sys
from snakemake.cli import parse_args
for profile in sys.argv[1:]:
    try:
        told = vars(parse_args(["--profile", profile, "--workflow-profile", "none"])[1])
    except SystemExit as end:
        told = {"exit": end.code}
    print(json.dumps(told, default=str))
"""


@pytest.fixture
def queue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The site's three commands, and the folder of the queue behind them."""
    folder, programs = tmp_path / "queue", tmp_path / "bin"
    folder.mkdir()
    programs.mkdir()
    for name in ("submit", "status", "cancel"):
        words = shlex.join([sys.executable, "-I", "-S", str(Path(local_queue.__file__)), str(folder), name])
        (programs / f"ct2lut-{name}").write_text(f'#!/bin/sh\nexec {words} "$@"\n')
        (programs / f"ct2lut-{name}").chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    yield folder
    local_queue.cancel(folder, [path.stem for path in folder.glob("*.pid")])


def generic(folder: Path, seconds: int) -> str:
    """The profile `generic`, asking after its jobs every so many seconds."""
    told = yaml.safe_load((PROFILES / "generic" / "config.yaml").read_text())
    folder.mkdir()
    (folder / "config.yaml").write_text(yaml.safe_dump({**told, "seconds-between-status-checks": seconds}))
    return str(folder)


@with_cluster
def test_a_queue_of_a_site(queue: Path, lay_out: LayOut, tmp_path: Path) -> None:
    """Submitted with what it asks for, a fault tried again with more, a refusal kept."""
    cohort = lay_out(Behaviour(refused=("K003",), faulty=("b2",)))
    cohort.finish(generic(tmp_path / "profile", 1))
    assert cohort.words() == {case: ["REJECTED" if case == "K003" else "PASS"] for case in CASES}
    assert [number for number, _ in cohort.attempts("b2")] == [1, 2]
    asked = sorted(path.read_text() for path in queue.glob("*.asked"))
    again = f"{2 * MEMORY_MB} {2 * MINUTES} 1"
    assert asked == sorted([f"{MEMORY_MB} {MINUTES} 1"] * len(BATCHES) + [again])


@with_cluster
def test_ctrl_c_cancels_the_jobs_of_a_queue(queue: Path, lay_out: LayOut, tmp_path: Path) -> None:
    """While the engine asks after its jobs it would not cancel those that it asks after, so here it does not ask."""
    cohort = lay_out(Behaviour(seconds=30.0))
    driver = cohort.drive(generic(tmp_path / "profile", 40))
    cohort.until_begun()
    driver.send_signal(signal.SIGINT)
    assert driver.wait(100) == 130
    jobs = [path.stem for path in queue.glob("*.pid")]
    assert jobs
    assert {local_queue.status(queue, job) for job in jobs} == {"failed"}
    assert cohort.words() == {}


def test_every_key_is_an_option_of_the_engine(tmp_path: Path) -> None:
    """The engine's own parser takes our profiles, and would not take a key that it does not know."""
    wrong = tmp_path / "wrong"
    shutil.copytree(PROFILES / "slurm", wrong)
    with (wrong / "config.yaml").open("a") as file:
        file.write("no-such-key: 1\n")
    *ours, broken = _parsed(*(PROFILES / name for name in EXECUTORS), wrong)
    assert {name: told["executor"] for name, told in zip(EXECUTORS, ours, strict=True)} == EXECUTORS
    assert {told["jobs"] for told in ours} == {100}
    assert all(told["keep_going"] and told["rerun_incomplete"] and told["latency_wait"] == 120 for told in ours)
    assert ours[0]["slurm_status_command"] == "squeue"
    assert ours[2]["kubernetes_persistent_volumes"] == ["knees:/data"]
    assert broken == {"exit": 2}


def _parsed(*profiles: Path) -> list[dict[str, object]]:
    """What the engine makes of profiles, without doing anything."""
    command = [str(ENGINE.with_name("python")), "-c", PARSE, *map(str, profiles)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]
